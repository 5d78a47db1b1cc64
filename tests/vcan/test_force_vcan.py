"""The force-sensor suite on a real SocketCAN bus (vcan0): see `make test-vcan`."""

import pytest

from tests.conformance.force_suite import SUITE
from tests.conformance.tool_bench import served_force_bench

pytestmark = pytest.mark.vcan


@pytest.mark.parametrize("name", SUITE.checks)
def test_cia404_sensor_on_vcan(name):
    with served_force_bench("probe_force", can_interface="vcan0") as bench:
        SUITE.checks[name](bench)
