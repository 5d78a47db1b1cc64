"""The suites of fine stages and force sensors in real time: behind a serial CAN adapter, on Modbus RTU and TCP."""

import pytest
import yaml

from microdrivers.configs import shipped_rig
from tests.conformance import fine_stage_suite, force_suite
from tests.conformance.tool_bench import bring_home, served_fine_stage_bench, served_force_bench

# With the machine to themselves, by `make test-ports`: they run in real time, drives and host watching each other.
pytestmark = pytest.mark.ports

FINE, FORCE = fine_stage_suite.SUITE.checks, force_suite.SUITE.checks


@pytest.fixture(scope="module")
def served_stage():
    """One served stage for all checks: to reference it takes seconds of real time."""
    with served_fine_stage_bench("pty") as bench:
        yield bench


@pytest.mark.parametrize("name", FINE)
def test_fine_stage_behind_a_serial_adapter(name, served_stage):
    bring_home(served_stage.stage)
    FINE[name](served_stage)


@pytest.fixture
def slow_probe_rig(tmp_path):
    """The workstation with its probe at 200 samples/s, which a busy computer keeps up with."""
    data = yaml.safe_load(shipped_rig().read_text(encoding="utf-8"))
    data["devices"]["probe_force"]["rate_hz"] = 200
    file = tmp_path / "slow.yaml"
    file.write_text(yaml.safe_dump(data), encoding="utf-8")
    return file


@pytest.mark.parametrize("name", FORCE)
def test_cia404_sensor_behind_a_serial_adapter(name, slow_probe_rig):
    with served_force_bench("probe_force", "pty", file=slow_probe_rig) as bench:
        FORCE[name](bench)


@pytest.fixture
def modbus_tcp_rig(tmp_path):
    """The workstation with the gripper's module behind a Modbus TCP gateway."""
    data = yaml.safe_load(shipped_rig().read_text(encoding="utf-8"))
    data["devices"]["gripper_force"]["connection"] = {"port": "socket://127.0.0.1:502", "framing": "tcp"}
    file = tmp_path / "gateway.yaml"
    file.write_text(yaml.safe_dump(data), encoding="utf-8")
    return file


@pytest.mark.parametrize("name", ["keeps_raw_tare_and_force_apart", "says_when_it_is_saturated"])
def test_analogue_module_over_modbus_rtu(name):
    with served_force_bench("gripper_force", "pty") as bench:
        FORCE[name](bench)


@pytest.mark.parametrize("name", ["says_when_it_is_saturated"])
def test_analogue_module_over_modbus_tcp(name, modbus_tcp_rig):
    with served_force_bench("gripper_force", "tcp", file=modbus_tcp_rig) as bench:
        FORCE[name](bench)
