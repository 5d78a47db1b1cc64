"""The fine-stage suite on a real SocketCAN bus (vcan0): see `make test-vcan`."""

import pytest

from microdrivers.backends.cia402.fine_stage import Cia402FineStage
from microdrivers.core.bus import Bus
from microdrivers.core.clock import SystemClock
from microdrivers.core.errors import BusyError
from tests.conformance.fine_stage_suite import SUITE
from tests.conformance.tool_bench import bring_home, served_fine_stage_bench
from tests.vcan.quick_rig import quick_rig

pytestmark = pytest.mark.vcan


@pytest.fixture(scope="module")
def stage_on_vcan(tmp_path_factory):
    """One served stage for all checks: to reference it takes seconds of real time."""
    with served_fine_stage_bench(can_interface="vcan0", file=quick_rig(tmp_path_factory.mktemp("rig"))) as bench:
        yield bench


@pytest.mark.parametrize("name", SUITE.checks)
def test_fine_stage_on_vcan(name, stage_on_vcan):
    bring_home(stage_on_vcan.stage)
    SUITE.checks[name](stage_on_vcan)


def test_a_second_program_is_refused_the_bus_and_disturbs_nothing(stage_on_vcan):
    stage = stage_on_vcan.stage
    bring_home(stage)
    move = stage.start_move_to(x_um=200.0, speed_um_s=100.0)
    clock = SystemClock()
    second = Cia402FineStage("probe_stage", stage._settings, clock=clock, bus=Bus())
    with pytest.raises(BusyError, match="another program drives CAN bus vcan0"):
        second.open()
    second.close()
    clock.close()
    assert move.wait().on_target
