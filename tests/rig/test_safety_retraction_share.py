"""A tool that cannot be taken away the whole way: the force guard says how far it was."""

import re

import pytest

from microdrivers.core.errors import MoveCancelled
from tests.rig.guarded_rig import AT_LIMIT_UM, guarded_rig


@pytest.mark.parametrize(
    ("retract_um", "said", "failed"),
    [
        ((400.0, 0.0, 0.0), "the tool was taken away, to x", False),
        ((1000.0, 0.0, 0.0), "the tool was taken away by 7[23] % of retract_um, for no more is free, to x", False),
        ((0.0, 0.0, 500.0), "by 0 % of retract_um, for no more is free, .*; the tool may still press", True),
    ],
)
def test_how_far_it_was_taken_away_is_told(tmp_path, retract_um, said, failed):
    with guarded_rig(tmp_path, stage={"retract_um": retract_um}) as guarded:
        guarded.stage.move_to(z_um=guarded.stage.limits["z"].max)
        with pytest.raises(MoveCancelled):
            guarded.stage.move_to(x_um=AT_LIMIT_UM - 100.0, speed_um_s=20.0)
        guarded.clock.sleep(2.0)
        told = guarded.interventions[-1]
        assert told.rule == "retraction"
        assert re.search(said, told.reason), told.reason
        assert bool(guarded.rig.safety.tripped) is failed
