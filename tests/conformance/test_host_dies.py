"""A host that is killed in the middle of a move: its drives stop by themselves, and can be used again."""

import os
import re
import signal
import subprocess
import sys

import pytest
import yaml

from microdrivers.configs import shipped_rig
from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.rig import load_rig_file
from microdrivers.rig.serving import ServedRig

# With the machine to themselves, by `make test-ports`: two processes in real time, drives and host watching each other.
pytestmark = [pytest.mark.ports, pytest.mark.skipif(os.name != "posix", reason="there are no signals")]

HEARTBEAT_MS = 500
HOST_HEARTBEAT = 0x700 + 127
SPEED_UM_S = 50.0
BRAKE_NS = 50 * NS_PER_MS
"""From that speed a drive brakes within 5 ms; its servo follows with a lag."""


@pytest.fixture
def served(tmp_path):
    """The probe's stage behind a serial CAN adapter, and the rig file that leads there."""
    data = yaml.safe_load(shipped_rig().read_text(encoding="utf-8"))
    for section in ("microscope", "probe", "safety"):
        data.pop(section, None)
    stage = data["devices"]["probe_stage"] | {"heartbeat_ms": HEARTBEAT_MS}
    for axis in stage["axes"].values():
        axis["homing_method"] = 37  # where it stands: no time is spent on the way to switches
    data["safety"] = "none"
    data["devices"] = {"probe_stage": stage}
    part, pointing = tmp_path / "part.yaml", tmp_path / "served.yaml"
    part.write_text(yaml.safe_dump(data), encoding="utf-8")
    with ServedRig(load_rig_file(part), seed=3) as serving:
        serving.write(pointing)
        yield serving, pointing


def microdrivers(*arguments):
    """Run a command in a process of its own; returns what it printed."""
    command = [sys.executable, "-m", "microdrivers", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    return done.returncode, done.stdout + done.stderr


class HostWatch:
    """The host's heartbeats, in the emulated bus' own time."""

    def __init__(self, medium):
        self.beats_ns = []
        medium.on_passed = self._hear

    def _hear(self, t_ns, who, frame):
        if who == "host" and frame.id == HOST_HEARTBEAT:
            self.beats_ns.append(t_ns)


def logged(drive, text):
    return [t_ns for t_ns, what in drive.log if what.startswith(text)]


def wait_until(serving, condition, *, longest_s=20.0):
    end_ns = serving.clock.now_ns() + int(longest_s * NS_PER_S)
    while not condition():
        assert serving.clock.now_ns() < end_ns
        serving.clock.sleep(0.02)


def test_drives_stop_within_the_heartbeat_time_out_and_keep_their_reference(served):
    serving, rig_file = served
    emulation = serving.simulation.emulations["probe_stage"]
    drives, watch = emulation.devices, HostWatch(emulation.medium)
    code, said = microdrivers("reference", rig_file, "--device", "probe_stage", "--axes", "z,x,y", "--yes")
    assert code == 0, said
    order = ["move", rig_file, "probe_stage", "--x-um", 600, "--y-um", 600, "--speed-um-s", SPEED_UM_S]
    host = subprocess.Popen([sys.executable, "-m", "microdrivers", *map(str, order)], stdout=subprocess.PIPE)
    try:
        wait_until(serving, lambda: all(logged(drives[axis], "move") for axis in "xy"))
        serving.clock.sleep(2.5 * HEARTBEAT_MS / 1000)
        assert not any(logged(drive, "fault") for drive in drives.values())
    finally:
        killed_ns = serving.clock.now_ns()
        host.send_signal(signal.SIGKILL)
        host.communicate()
    wait_until(serving, lambda: all(logged(drive, "fault 8130") for drive in drives.values()), longest_s=5.0)
    serving.clock.sleep(0.5)

    last_beat_ns = watch.beats_ns[-1]
    assert killed_ns - last_beat_ns <= HEARTBEAT_MS * NS_PER_MS  # it was beating until it was killed
    for axis, drive in drives.items():
        (fault_ns,) = logged(drive, "fault 8130")
        assert fault_ns - last_beat_ns <= HEARTBEAT_MS * NS_PER_MS, axis
        at_stop_um = drive.motion.axis.position_at(fault_ns + BRAKE_NS)
        assert drive.motion.axis.position_at(serving.clock.now_ns()) == pytest.approx(at_stop_um, abs=0.05)
    assert 20.0 < drives["x"].motion.place_at(serving.clock.now_ns()) < 300.0  # it was to go to 600 µm

    code, said = microdrivers("status", rig_file)
    assert code == 0, said
    assert re.search(r"FAULT: axis \w \(node 1[123]\): .*\(error code 8130h\)", said)
    assert f"microdrivers clear-fault {rig_file} probe_stage" in said
    code, said = microdrivers("move", rig_file, "probe_stage", "--x-um", 0)
    assert code == 1
    assert "8130h" in said
    code, said = microdrivers("clear-fault", rig_file, "probe_stage", "--yes")
    assert code == 0, said
    assert "fault cleared" in said
    code, said = microdrivers("move", rig_file, "probe_stage", "--x-um", 10, "--y-um", 10)
    assert code == 0, said
    assert "on target" in said


def test_a_second_program_is_refused_the_adapter_and_disturbs_nothing(served):
    serving, rig_file = served
    drives = serving.simulation.emulations["probe_stage"].devices
    code, said = microdrivers("reference", rig_file, "--device", "probe_stage", "--axes", "z,x,y", "--yes")
    assert code == 0, said
    order = ["move", rig_file, "probe_stage", "--x-um", 400, "--speed-um-s", SPEED_UM_S]
    with subprocess.Popen([sys.executable, "-m", "microdrivers", *map(str, order)], stdout=subprocess.PIPE) as host:
        wait_until(serving, lambda: logged(drives["x"], "move"))
        code, said = microdrivers("stop", rig_file)
        assert code == 1
        assert "NOT REACHED" in said
        assert "another program" in said
        said = host.communicate(timeout=30)[0].decode()
    assert host.returncode == 0, said
    assert "on target" in said
    assert not any(logged(drive, "fault") for drive in drives.values())
    code, said = microdrivers("stop", rig_file)
    assert code == 0, said
    assert re.search(r"probe_stage +told to stop: .*at rest", said)
