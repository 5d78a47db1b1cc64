"""The fine-stage suite on a real SocketCAN bus (vcan0): see `make test-vcan`."""

import pytest

from tests.conformance.fine_stage_suite import SUITE
from tests.conformance.tool_bench import bring_home, served_fine_stage_bench

pytestmark = pytest.mark.vcan


@pytest.fixture(scope="module")
def stage_on_vcan():
    """One served stage for all checks: to reference it takes seconds of real time."""
    with served_fine_stage_bench(can_interface="vcan0") as bench:
        yield bench


@pytest.mark.parametrize("name", SUITE.checks)
def test_fine_stage_on_vcan(name, stage_on_vcan):
    bring_home(stage_on_vcan.stage)
    SUITE.checks[name](stage_on_vcan)
