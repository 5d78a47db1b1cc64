"""The fine-stage suite on a real SocketCAN bus (vcan0): see `make test-vcan`."""

import pytest

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
