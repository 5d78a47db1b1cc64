"""--wire-log of a CAN bus: which frames it holds, how they read, and that they are not replayed."""

import json
import re

import pytest
import yaml

from microdrivers.configs import shipped_rig
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.samples import WireTraffic
from microdrivers.devices.wire_log_format import read_wire_log
from microdrivers.fakes.can import Frame, medium_named
from microdrivers.rig import build_rig, load_rig_file, open_rig
from microdrivers.rig.serving import ServedRig

BUS = "socketcan:can0"
CANDUMP = re.compile(r"(?:[0-9A-F]{3}|[0-9A-F]{8})#(?:[0-9A-F]{2}){0,8}")


def part(tmp_path, *devices):
    """Some devices of the workstation."""
    data = yaml.safe_load(shipped_rig().read_text(encoding="utf-8"))
    for section in ("microscope", "probe"):
        data.pop(section, None)
    data["safety"] = "none"
    data["devices"] = {name: data["devices"][name] for name in devices}
    file = tmp_path / "part.yaml"
    file.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    return file


def frames_of(file, direction=None):
    return [
        record.data.decode()
        for record in read_wire_log(file).records
        if isinstance(record, WireTraffic) and record.device == f"CAN {BUS}" and direction in (None, record.direction)
    ]


def passed_on(medium):
    """What the emulated bus itself noted, in candump's notation."""
    return [(who, f"{frame.id:03X}#{frame.data.hex().upper()}") for _, who, frame in list(medium.log)]


# ---------------------------------------------------------------------- what is written


def test_a_bus_is_logged_once_for_all_its_devices_frame_by_frame(tmp_path):
    """All that passed is in the log, in its order, as one reads it with candump."""
    log = tmp_path / "wire.jsonl"
    file = part(tmp_path, "probe_stage", "probe_force")
    with open_rig(file, fake=True, clock=SimulatedClock(), wire_log=log) as rig:
        rig.devices["probe_stage"].read()
        with rig.devices["probe_force"].stream(1000.0):
            rig.clock.sleep(0.05)
        medium = medium_named(BUS)
    sent, received = frames_of(log, "sent"), frames_of(log, "received")
    assert all(CANDUMP.fullmatch(frame) for frame in sent + received)
    of_nodes = [frame for who, frame in passed_on(medium) if who == "node"]
    of_host = [frame for who, frame in passed_on(medium) if who == "host"]
    assert sent == of_host
    heard = set(received)
    assert received == [frame for frame in of_nodes if frame in heard]  # not the boot-ups before the bus was opened
    assert sum(frame.startswith("195#") for frame in received) == sum(frame.startswith("195#") for frame in of_nodes)
    assert "080#" in sent  # SYNC belongs to no device
    times = [record.t_ns for record in read_wire_log(log).records if isinstance(record, WireTraffic)]
    assert times[0] >= 0
    events = [(record.device, record.kind) for record in read_wire_log(log).records if hasattr(record, "kind")]
    assert {("probe_stage", "opened"), ("probe_force", "opened")} <= set(events)


def test_a_line_of_the_log_names_bus_direction_and_frame(tmp_path):
    log = tmp_path / "wire.jsonl"
    with open_rig(part(tmp_path, "probe_force"), fake=True, clock=SimulatedClock(), wire_log=log):
        pass
    lines = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()[1:]]
    first = next(line for line in lines if line.get("text", "").startswith("615#40001000"))
    assert first | {"t_s": 0} == {
        "t_s": 0, "device": f"CAN {BUS}", "direction": "sent", "text": "615#4000100000000000",
    }  # fmt: skip


def test_error_frames_and_what_others_send_are_in_the_log(tmp_path):
    log = tmp_path / "wire.jsonl"
    with open_rig(part(tmp_path, "probe_force"), fake=True, clock=SimulatedClock(), wire_log=log) as rig:
        medium = medium_named(BUS)
        medium.inject_error_frame()
        medium.open_port().send(Frame(0x595, b"\x01"))
        rig.clock.sleep(0.01)
        rig.devices["probe_force"].read()
    received = frames_of(log, "received")
    assert "20000008#0000000000000000" in received
    assert "595#01" in received


def test_nobody_pays_who_does_not_listen(tmp_path, monkeypatch):
    from microdrivers.devices.wire_tap import CanTap

    def forbid(*_, **__):
        pytest.fail("a frame was written down for nobody")

    monkeypatch.setattr(CanTap, "frame", forbid)
    with open_rig(part(tmp_path, "probe_stage", "probe_force"), fake=True, clock=SimulatedClock()) as rig:
        for device in rig.devices.values():
            device.read()


def test_listening_ends_with_the_log(tmp_path):
    rig = build_rig(part(tmp_path, "probe_force"), fake=True, clock=SimulatedClock(), wire_log=tmp_path / "wire.jsonl")
    topic = rig.bus.topic(f"CAN {BUS}/wire", WireTraffic)
    assert topic.heard
    with rig:
        rig.devices["probe_force"].read()
    assert not topic.heard


@pytest.mark.xdist_group("real_time")
def test_a_served_bus_is_logged_as_its_emulators_see_it(tmp_path):
    served, theirs, ours = (tmp_path / name for name in ("served.yaml", "emulators.jsonl", "host.jsonl"))
    with ServedRig(load_rig_file(part(tmp_path, "probe_force")), wire_log=theirs) as serving:
        serving.write(served)
        with open_rig(served, wire_log=ours) as rig:
            rig.devices["probe_force"].read()
    by_host = [
        record.data.decode()
        for record in read_wire_log(ours).records
        if isinstance(record, WireTraffic) and record.direction == "sent"
    ]
    at_emulators = frames_of(theirs, "sent")
    assert read_wire_log(theirs).header.source == "served"
    assert len(at_emulators) > 20
    assert at_emulators == by_host[: len(at_emulators)]
    assert len(by_host) - len(at_emulators) <= 5  # the last may not have got there before the port was closed
    assert "595#4300100094010200" in frames_of(theirs, "received")


# ---------------------------------------------------------------------- what is not replayed


def test_devices_on_a_bus_are_left_out_of_a_replay_by_name(run, tmp_path, caplog):
    file = part(tmp_path, "sample_stage", "probe_stage", "probe_force")
    assert run("status", file, "--fake", "--wire-log", "wire.jsonl").exit_code == 0
    result = run("status", file, "--wire-replay", "wire.jsonl")
    assert result.exit_code == 0, result.output
    (line,) = result.stdout.splitlines()
    assert line.startswith("sample_stage  Physik Instrumente")
    assert "left out of the rig, for CAN buses are not replayed: probe_stage, probe_force" in caplog.text
    assert "images and HTTP" not in caplog.text


def test_a_replay_of_nothing_but_a_bus_is_refused(run, tmp_path):
    file = part(tmp_path, "probe_stage", "probe_force")
    assert run("status", file, "--fake", "--wire-log", "wire.jsonl").exit_code == 0
    result = run("status", file, "--wire-replay", "wire.jsonl")
    assert result.exit_code == 1
    assert "wire.jsonl: CAN buses are not replayed, and probe_stage, probe_force are on one" in result.output
    assert "candump's notation" in result.output
