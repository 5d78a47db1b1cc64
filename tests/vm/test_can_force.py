"""The force-sensor suite on CAN controllers, and what an interface that is down looks like."""

import pytest

from microdrivers.core.errors import LinkLost
from tests.conformance.force_suite import SUITE
from tests.vm.can_controllers import BITRATE, DEVICES, HOST, bring_up, ip_link, take_down

pytestmark = pytest.mark.vm


@pytest.fixture(autouse=True)
def _on_the_bus():
    for channel in (HOST, DEVICES):
        bring_up(channel)


@pytest.mark.parametrize("name", SUITE.checks)
def test_cia404_sensor_on_controllers(name):
    from tests.conformance.tool_bench import served_force_bench

    with served_force_bench("probe_force", can_interface=DEVICES) as bench:
        SUITE.checks[name](bench)


@pytest.fixture
def sensor():
    from microdrivers.configs import shipped_rig
    from tests.conformance.bench import served

    with served("pty", "probe_force", can_interface=DEVICES, file=shipped_rig()) as (rig, _):
        yield rig.devices["probe_force"]


def test_an_interface_that_goes_down_is_lost_by_name_and_the_remedy_brings_it_back(sensor):
    sensor.read()
    take_down(HOST)
    with pytest.raises(LinkLost, match=f"{HOST}.*down"):
        sensor.read()
    sensor.close()
    with pytest.raises(LinkLost, match=HOST) as caught:
        sensor.open()
    command = f"ip link set {HOST} up type can bitrate {BITRATE}"
    assert command in caught.value.remedy
    ip_link(*command.split()[2:])
    sensor.open()
    assert abs(sensor.read().raw_uN) < sensor.range_uN.max
