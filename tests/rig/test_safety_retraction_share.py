"""A tool that cannot be taken away the whole way: the force guard says how far it was."""

import re

import pytest

from microdrivers.core.errors import MoveCancelled
from tests.rig.guarded_rig import AT_LIMIT_UM, LIMIT_UN, guarded_rig, press_too_hard


@pytest.mark.parametrize(
    ("retract_um", "said", "failed"),
    [
        ((400.0, 0.0, 0.0), "the tool was taken away, to x [^;]* where probe_force feels -?[0-9.]+ µN$", False),
        (
            (10.0, 0.0, 0.0),
            "was taken away, to x .* where probe_force feels 80[0-9.]* µN; the tool may still press",
            False,
        ),
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


def test_a_specimen_that_comes_after_a_tool_taken_away_by_too_little_is_told(tmp_path):
    with guarded_rig(tmp_path) as guarded:
        press_too_hard(guarded)
        guarded.clock.sleep(1.0)
        guarded.press(0.09 * LIMIT_UN)
        guarded.clock.sleep(0.1)
        assert guarded.rules() == ["force limit", "retraction"]
        guarded.press(0.2 * LIMIT_UN)
        guarded.clock.sleep(0.1)
        assert guarded.rules() == ["force limit", "retraction", "retraction"]
        assert re.search(r"feels \d+\.?\d* µN; the tool may still press", guarded.interventions[-1].reason)
        guarded.stage.retract().wait()
        guarded.press(0.3 * LIMIT_UN)
        guarded.clock.sleep(0.1)
        assert len(guarded.rules()) == 3
