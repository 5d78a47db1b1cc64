"""record and recording repair: what the devices of a rig tell, in a file that others read."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import click
import h5py
import pytest
import yaml

from microdrivers.cli.record import _line
from microdrivers.configs import shipped_rig
from microdrivers.core.contact_samples import SpecimenTruth
from microdrivers.core.samples import ForceSample, Frame
from microdrivers.devices.camera import Camera
from microdrivers.recording.reader import Recording


def test_record_takes_all_that_an_emulated_rig_tells(run, tmp_path):
    result = run("record", shipped_rig("workstation"), "--fake", "--seed", 2, "--for", 0.25, "--out", "a.mcap")
    assert result.exit_code == 0, result.output
    recording = Recording(tmp_path / "a.mcap")
    topics = recording.topics
    assert recording.losses == []
    assert (recording.header.source, recording.header.seed, recording.header.rig) == ("fake", 2, "workstation")
    assert topics["truth/specimen"].sample_type is SpecimenTruth
    assert topics["probe_force"].sample_type is ForceSample
    assert topics["probe_force"].rate_hz == pytest.approx(1000, rel=0.01)
    assert topics["probe_stage"].rate_hz == pytest.approx(100, rel=0.01)
    assert topics["camera_fine"].sample_type is Frame
    assert topics["camera_fine"].rate_hz == pytest.approx(30, rel=0.01)
    kinds = [sample.kind for _, sample in recording.samples(["camera_fine/event"])]
    assert (kinds[0], kinds[-1]) == ("opened", "closed")
    assert yaml.safe_load(recording.attachments["rig.yaml"])["name"] == "workstation"
    assert "probe_force" in result.stdout
    assert "0 dropped" in result.stderr


@pytest.mark.parametrize("dropped", [0, 12])
def test_the_live_line_fits_a_terminal(dropped):
    messages = dict.fromkeys(("truth/optics", "sample_stage", "camera_fine", "camera_lateral", "probe_force"), 1000)
    recorder = SimpleNamespace(size=123_456_789, dropped=dropped, file=Path("none", "a.mcap"))
    line = click.unstyle(_line(recorder, messages, {}, 1.0, 12.0, 79))
    assert len(line) == 79
    assert line.startswith(f"12 s | 123.5 MB | {dropped} dropped | sample_stage 1000/s · camera_fine 1000/s")
    assert line.endswith("…")
    assert click.unstyle(_line(recorder, messages, {}, 1.0, 12.0, 500)).endswith("truth/optics 1000/s")


def test_the_live_line_of_an_instant_tells_no_rate_of_what_came_before(run):
    told = run("record", shipped_rig("microscope"), "--fake", "--for", 1e-9, "--out", "a.mcap").stderr
    assert "0 s | " in told
    assert told.endswith("0 dropped | nothing\n")


def test_the_live_line_tells_how_long_the_disk_has_room(monkeypatch, tmp_path):
    recorder = SimpleNamespace(size=10**8, dropped=0, file=tmp_path / "a.mcap")
    for free, told in ((10**9, ", room for 100 s |"), (10**11, ", room for 2.8 h |"), (10**14, "100.0 MB |")):
        monkeypatch.setattr("shutil.disk_usage", lambda _folder, free=free: SimpleNamespace(free=free))
        assert told in _line(recorder, {}, {}, 1.0, 10.0, 79)


def test_record_takes_the_topics_that_are_named(run, tmp_path):
    result = run(
        "record",
        shipped_rig("workstation"),
        "--fake",
        "--for",
        0.2,
        "--out",
        "a.mcap",
        "--topics",
        "probe_force, sample_*",
    )
    assert result.exit_code == 0, result.output
    assert set(Recording(tmp_path / "a.mcap").topics) == {"probe_force", "sample_stage", "sample_stage/event"}


def test_names_that_meet_no_topic_are_told(run, tmp_path):
    rig = shipped_rig("workstation")
    result = run("record", rig, "--fake", "--for", 0.1, "--out", "a.mcap", "--topics", "prob_force,nothing*")
    assert result.exit_code == 1
    assert "there is no topic 'prob_force', 'nothing*'" in result.stderr
    assert "did you mean 'probe_force'?" in result.stderr
    assert "sample_stage/event" in result.stderr
    assert not (tmp_path / "a.mcap").exists()
    result = run("record", rig, "--fake", "--for", 0.1, "--out", "a.mcap", "--topics", "probe_force,zooom")
    assert result.exit_code == 1
    assert "there was no topic 'zooom': did you mean 'zoom'?" in result.stderr
    assert set(Recording(tmp_path / "a.mcap").topics) == {"probe_force"}


@pytest.mark.parametrize("names", ["", ",,"])
def test_topics_that_name_nothing_are_refused(run, tmp_path, names):
    result = run("record", shipped_rig("microscope"), "--fake", "--for", 0.1, "--out", "a.mcap", "--topics", names)
    assert (result.exit_code, "--topics names no topic" in result.stderr) == (1, True)
    assert not (tmp_path / "a.mcap").exists()


@pytest.mark.parametrize("duration_s", ["nan", "inf"])
def test_a_recording_lasts_a_finite_time(run, duration_s):
    result = run("record", shipped_rig("microscope"), "--fake", "--for", duration_s)
    assert (result.exit_code, "is no time" in result.stderr or "range" in result.stderr) == (2, True)


def test_record_needs_an_end_where_time_flies_and_a_file_that_is_new(run, tmp_path):
    result = run("record", shipped_rig("microscope"), "--fake")
    assert result.exit_code == 1
    assert "add --for S, or --real-time" in result.stderr
    (tmp_path / "a.mcap").write_text("mine")
    result = run("record", shipped_rig("microscope"), "--fake", "--for", 1, "--out", "a.mcap")
    assert result.exit_code == 1
    assert "never overwritten" in result.stderr
    assert (tmp_path / "a.mcap").read_text() == "mine"


def test_repair_tells_what_was_kept_and_lost(run, tmp_path):
    run("record", shipped_rig("microscope"), "--fake", "--for", 0.3, "--out", "a.mcap")
    whole = (tmp_path / "a.mcap").read_bytes()
    with Recording(tmp_path / "a.mcap") as recording:
        between = recording._scan.chunks[2].offset
    (tmp_path / "c.mcap").write_bytes(whole[:between])
    shown = run("recording", "repair", "c.mcap").stdout
    assert "lost:\n  the recording was not ended" in shown
    (tmp_path / "a.mcap").write_bytes(whole[: len(whole) // 2])
    result = run("recording", "repair", "a.mcap")
    assert result.exit_code == 0, result.output
    assert "the recording was not ended" in result.stdout
    assert f"of {len(whole) // 2} bytes" in result.stdout
    repaired = Recording(tmp_path / "a.repaired.mcap")
    told = [str(loss) for loss in repaired.losses]
    assert all(loss.startswith("lost before the repair: ") for loss in told)
    assert any("the recording was not ended" in loss for loss in told)
    assert not repaired.complete
    shown = run("info", "a.repaired.mcap").stdout
    assert "complete" not in shown.splitlines()[0]
    assert f"  lost       {told[-1]}" in shown
    run("export", "a.repaired.mcap", "--to", "hdf5")
    [hdf5] = tmp_path.glob("*-export/*.h5")
    with h5py.File(hdf5) as exported:
        assert exported.attrs["losses"] == "; ".join(told)
    assert run("recording", "repair", "a.mcap").exit_code == 1
    result = run("recording", "repair", "a.repaired.mcap", "--out", "b.mcap")
    assert "nothing was lost" in result.stdout
    (tmp_path / "c.mcap").write_text("no recording of anything")
    result = run("recording", "repair", "c.mcap")
    assert result.exit_code == 1
    assert "no MCAP file" in result.stderr


def test_a_repair_that_keeps_nothing_fails(run, tmp_path):
    run("record", shipped_rig("microscope"), "--fake", "--for", 0.3, "--out", "a.mcap")
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    with Recording(tmp_path / "a.mcap") as recording:
        places = recording._scan.chunks
    for place in places[:-1]:
        data[place.offset + 60] ^= 1
    (tmp_path / "a.mcap").write_bytes(data)
    result = run("recording", "repair", "a.mcap", "--out", "b.mcap")
    intact = len(data) - sum(place.length for place in places[:-1])
    assert result.exit_code == 0
    assert f" messages kept, from {intact} of {len(data)} bytes" in result.stdout
    data[places[-1].offset + 60] ^= 1
    (tmp_path / "a.mcap").write_bytes(data)
    result = run("recording", "repair", "a.mcap", "--out", "c.mcap")
    assert (result.exit_code, "c.mcap: 0 messages kept" in result.stdout) == (1, True)


@pytest.mark.xdist_group("real_time")
def test_ctrl_c_ends_a_recording_that_is_complete(tmp_path):
    file = tmp_path / "a.mcap"
    command = [sys.executable, "-m", "microdrivers", "record", str(shipped_rig("microscope")), "--fake", "--real-time"]
    with subprocess.Popen([*command, "--out", str(file)], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        deadline = time.monotonic() + 60
        while not (file.exists() and file.stat().st_size > 2_000_000):
            assert process.poll() is None, process.stderr.read()
            assert time.monotonic() < deadline
            time.sleep(0.05)
        os.kill(process.pid, signal.SIGINT)
        told, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    assert b"the file is complete" in told
    recording = Recording(file)
    assert recording.complete
    assert recording.losses == []
    assert recording.topics["camera_fine"].count > 2


def test_topics_that_gave_no_sample_are_told(run, tmp_path):
    def told(topics):
        (tmp_path / "a.mcap").unlink(missing_ok=True)
        return run("record", shipped_rig("microscope"), "--fake", "--for", 0.04, "--out", "a.mcap", "--topics", topics)

    result = told("zoom,truth/optics")
    assert result.exit_code == 1
    assert "  truth/optics  0 samples, 0 dropped\n" in result.stdout
    assert "no sample of 'truth/optics' came: " in result.stderr
    assert "record a camera too, such as 'camera_fine'" in result.stderr
    result = told("truth/optics")
    assert (result.exit_code, "0.0 MB, complete, but it holds no samples\n" in result.stdout) == (1, True)
    result = told("truth/*,camera_fine")
    assert (result.exit_code, "no sample of" in result.stderr) == (0, False)
    result = told("zoom,safety")  # of which nothing is to be heard if all is well
    assert (result.exit_code, "  safety  0 samples, 0 dropped\n" in result.stdout) == (0, True)


def test_how_to_ask_for_wires_is_told(run):
    remedy = "wires are asked for by a name or pattern that ends in /wire, such as '*/wire'"
    for topics, meant in (("*can0*", True), ("*wire*", True), ("*cann0*", False)):
        result = run("record", shipped_rig("workstation"), "--fake", "--for", 0.1, "--topics", topics)
        assert (result.exit_code, remedy in result.stderr) == (1, meant)
    assert "end in /wire" in " ".join(run("record", "--help").stdout.split())


def test_a_recording_of_sound_wires_tells_of_no_flaw(run, tmp_path):
    """Drivers may send before they take in what has arrived meanwhile; both stamps are right."""
    result = run("record", shipped_rig("workstation"), "--fake", "--for", 0.1, "--out", "a.mcap", "--topics", "*/wire")
    assert result.exit_code == 0, result.output
    with Recording(tmp_path / "a.mcap") as recording:
        stamps = [sample.t_ns for _, sample in recording.samples(["CAN socketcan:can0/wire"])]
        assert recording.flaws == []
        assert {topic.unsorted for topic in recording.topics.values()} == {0}
    assert stamps != sorted(stamps)


@pytest.mark.parametrize(("topics", "leaves"), [("zoom", False), ("*/event", True)])
def test_an_interruption_before_all_devices_are_open(run, tmp_path, monkeypatch, topics, leaves):
    def interrupted(_self: Camera) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Camera, "open", interrupted)
    result = run("record", shipped_rig("workstation"), "--fake", "--for", 1, "--out", "a.mcap", "--topics", topics)
    assert result.exit_code == 130
    assert (tmp_path / "a.mcap").exists() == leaves
    if leaves:
        assert "ended by you before all devices were open\n" in result.stdout
    else:
        assert "nothing was recorded, and a.mcap was removed" in result.stderr
        assert "complete" not in result.output
