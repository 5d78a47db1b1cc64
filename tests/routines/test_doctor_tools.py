"""What the doctor says of force sensors, fine stages and the CAN bus that they share."""

import pytest
import yaml

from microdrivers.backends.cia402.fine_stage import Cia402FineStage
from microdrivers.backends.cia404.sensor import Cia404ForceSensor
from microdrivers.configs import shipped_rig
from microdrivers.core.clock import SimulatedClock
from microdrivers.fakes.can import medium_named
from microdrivers.rig import build_rig
from microdrivers.routines.doctor import diagnose
from tests.fakes.analogue_bench import module_behind

BUS = "CAN socketcan:can0"
switched_off = []
ON_BUS = ("probe_stage", "gripper_stage", "probe_force")


@pytest.fixture
def examine():
    """Diagnose some emulated devices of the workstation; returns what was found by name, buses included."""

    def call(*names, prepare=lambda rig: None, motion=False, file=None, **drivers):
        rig = build_rig(file or shipped_rig(), fake=True, seed=4, clock=SimulatedClock(), devices=names)
        for device in rig.devices.values():
            device.rules = ()  # what the rig forbids has tests of its own
        for name, driver in drivers.items():
            rig.devices[name] = driver(name, rig.simulation.settings_of(name), clock=rig.clock, bus=rig.bus)
        prepare(rig)
        try:
            diagnosis = diagnose(rig, motion=motion)
            for bus in diagnosis.buses:
                bus.figures["true_error_frames"] = medium_named("socketcan:can0").error_frames
        finally:
            while switched_off:
                medium_named("socketcan:can0").attach(switched_off.pop())
            rig.close()
        return {found.name: found for found in (*diagnosis.devices, *diagnosis.buses)}

    return call


def texts(found, level):
    return [f"{finding.what} -> {finding.remedy}" for finding in found.findings if finding.level == level]


def sole_problem(found, name):
    for other, each in found.items():
        assert len(texts(each, "problem")) == (other == name), each.findings
    return texts(found[name], "problem")[0]


def switch_off(node):
    medium_named("socketcan:can0").detach(node)
    switched_off.append(node)


def now_ns(rig):
    return rig.clock.now_ns()


def pressed(sensor, force_uN):
    return lambda rig: rig.simulation.world.pressed.update({sensor: lambda _t_ns: force_uN})


def drive_of(rig, axis):
    return rig.simulation.emulations["probe_stage"].devices[axis]


# ---------------------------------------------------------------------- force sensors


def test_sound_sensors_are_untared_and_that_is_no_trouble(examine):
    found = examine("probe_force", "gripper_force")
    assert [texts(each, "problem") + texts(each, "warning") for each in found.values()] == [[], [], []]
    for name in ("probe_force", "gripper_force"):
        (said,) = [text for text in texts(found[name], "ok") if "UNTARED" in text]
        assert "no zero is taken yet" in said
    assert found["probe_force"].figures["stream_hz"] == pytest.approx(1000, abs=5)
    assert found["probe_force"].figures["line"] == {"lost_frames": 0}
    assert found["gripper_force"].figures["stream_hz"] == pytest.approx(30, abs=1)


@pytest.mark.parametrize(("sensor", "force_uN"), [("probe_force", 5000.0), ("gripper_force", 400.0)])
def test_saturation_is_a_problem_that_begins_at_the_tip(examine, sensor, force_uN):
    problem = sole_problem(examine(sensor, prepare=pressed(sensor, force_uN)), sensor)
    assert "no valid force" in problem
    assert "SATURATED" in problem
    assert "free the tip" in problem


def test_a_sensor_that_is_not_there_is_a_problem_of_its_cable(examine):
    def unplug(rig):
        rig.simulation.emulations["probe_force"].devices["amplifier"].disconnect_sensor(now_ns(rig))

    state, fault = texts(examine("probe_force", prepare=unplug)["probe_force"], "problem")
    assert "DISCONNECTED" in state
    assert "plug and cable" in state
    assert "error code 7300h" in fault
    assert "check the sensor, its cable" in fault


def test_a_broken_wire_that_looks_like_a_force_is_looked_at_twice(examine):
    problem = sole_problem(
        examine("gripper_force", prepare=lambda rig: module_behind("gripper_force").disconnect()), "gripper_force"
    )
    assert "DISCONNECTED" in problem
    assert "plug and cable" in problem


class FallsSilent(Cia404ForceSensor):
    """Its amplifier is switched off in the middle of the stream."""

    def _begin_stream(self, rate_hz):
        super()._begin_stream(rate_hz)
        self.clock.call_at(self.clock.now_ns() + 400_000_000, lambda: switch_off(self.amplifier_node))


def test_a_stream_that_stops_coming_is_stale_and_no_stream(examine):
    def remember(rig):
        FallsSilent.amplifier_node = rig.simulation.emulations["probe_force"].devices["amplifier"].node

    found = examine("probe_force", probe_force=FallsSilent, prepare=remember)["probe_force"]
    (problem,) = [text for text in texts(found, "problem") if "STALE" in text]
    assert "cable and power" in problem
    assert 395 <= found.figures["stream_hz"] <= 401  # what says STALE is no reading
    assert found.figures["stream_stale"] >= 5


# ---------------------------------------------------------------------- fine stages


def test_a_missing_reference_is_a_warning_with_the_order_that_is_safe(examine):
    (warning,) = texts(examine("probe_stage")["probe_stage"], "warning")
    assert "NOT REFERENCED: z, x, y" in warning
    assert "--device probe_stage --axes z,x,y" in warning


def test_an_emulated_stage_moves_as_told(examine):
    found = examine("probe_stage", motion=True)["probe_stage"]
    assert texts(found, "problem") + texts(found, "warning") == []
    for axis in "xyz":
        steps_um = found.figures[f"steps_{axis}_um"]  # from the end of its travel, where its switch is, one way only
        assert [abs(step_um) for step_um in steps_um] == pytest.approx([20, 20], abs=0.3)
        assert sum(steps_um) == pytest.approx(0, abs=0.3)
    assert found.figures["stream_hz"] == pytest.approx(100, abs=2)


def test_a_drive_at_fault_is_named_with_its_code_and_the_command(examine):
    def trip(rig):
        drive_of(rig, "y").inject_fault(now_ns(rig), 0x7121, lasting=True)

    problem = sole_problem(examine("probe_stage", "probe_force", prepare=trip), "probe_stage")
    assert "axis y (node 12): motor blocked (error code 7121h)" in problem
    assert "microdrivers clear-fault" in problem


class LosesADrive(Cia402FineStage):
    """One of its drives is switched off after it was opened."""

    def _identify(self):
        info = super()._identify()
        self.clock.call_at(self.clock.now_ns() + 5_000_000, lambda: switch_off(self.node))
        return info


def test_a_heartbeat_that_has_stopped_is_a_problem_that_names_axis_and_node(examine):
    def remember(rig):
        LosesADrive.node = drive_of(rig, "y").node

    found = examine("probe_stage", "probe_force", probe_stage=LosesADrive, prepare=remember)
    problems = texts(found["probe_stage"], "problem")
    assert any("no heartbeat from axis y (node 12)" in text for text in problems), problems
    assert all("axis y (node 12)" in text and "power" in text for text in problems)
    assert texts(found["probe_force"], "problem") == []


def test_a_missing_drive_hides_no_other_device(examine):
    found = examine("probe_stage", "gripper_stage", prepare=lambda rig: switch_off(drive_of(rig, "x").node))
    problem = sole_problem(found, "probe_stage")
    assert "axis x (node 11)" in problem
    assert "node id switches" in problem
    assert found[BUS].figures["stream_hz"].keys() == {"gripper_stage"}


# ---------------------------------------------------------------------- the bus


def test_the_load_is_measured_while_all_stream(examine):
    loads = []

    class Looks(Cia404ForceSensor):
        """Looks at the emulated bus itself at the end of each stream."""

        def _end_stream(self):
            if self.streaming:
                loads.append(medium_named("socketcan:can0").load(1.0))
            super()._end_stream()

    found = examine(*ON_BUS, probe_force=Looks)
    bus = found[BUS]
    assert texts(bus, "problem") + texts(bus, "warning") == []
    assert bus.devices == [name for name in found if name in ON_BUS]
    assert bus.figures["stream_hz"] == pytest.approx(
        {"probe_force": 1000, "probe_stage": 100, "gripper_stage": 100}, rel=0.02
    )
    assert 0.2 < loads[-1] <= bus.figures["load"] <= 1.25 * loads[-1]  # stuff bits are counted at their most
    assert bus.figures["bitrate"] == 500_000
    assert bus.figures["counters"]["received"] > 3000
    assert not any(count for name, count in bus.figures["counters"].items() if name in ("error_frames", "timeouts"))


def test_a_bus_that_is_nearly_full_is_a_warning(examine, tmp_path):
    data = yaml.safe_load(shipped_rig().read_text(encoding="utf-8"))
    for name in ON_BUS:
        data["devices"][name]["connection"]["bitrate"] = 250_000
    file = tmp_path / "slow.yaml"
    file.write_text(yaml.safe_dump(data), encoding="utf-8")
    bus = examine(*ON_BUS, file=file)[BUS]
    (warning,) = [text for text in texts(bus, "warning") if "load it with" in text]
    assert "of 250 kbit/s" in warning
    assert "raise the bit rate" in warning


def test_error_frames_are_counted_once_for_the_bus(examine):
    def disturb(rig):
        rig.clock.every(0.5, lambda: medium_named("socketcan:can0").inject_error_frame())

    found = examine(*ON_BUS, prepare=disturb)
    for name in ON_BUS:
        assert texts(found[name], "warning") == [] or "NOT REFERENCED" in texts(found[name], "warning")[0]
        assert len(texts(found[name], "warning")) <= 1
    bus = found[BUS]
    (warning,) = texts(bus, "warning")
    assert f"{bus.figures['counters']['error_frames']} error frames" in warning
    assert 0 < bus.figures["counters"]["error_frames"] <= bus.figures["true_error_frames"]
    assert "60 Ω" in warning


def test_a_wrong_bit_rate_is_suspected_for_all_devices_and_the_bus(examine):
    def set_nodes(_rig):
        medium_named("socketcan:can0").bitrate = 250_000

    found = examine("probe_stage", "probe_force", prepare=set_nodes)
    for name in ("probe_stage", "probe_force"):
        (problem,) = texts(found[name], "problem")
        assert "is the bit rate right?" in problem or "bit rate" in problem
    assert "error frames" in texts(found[BUS], "warning")[0]
