"""replay, info, export, analyse: what they show, and what they refuse."""

import json
import shutil

import pytest

from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.samples import ForceSample
from microdrivers.recording.header import RecordingHeader
from microdrivers.recording.playback import RecordingPlayback
from microdrivers.recording.recorder import Recorder
from microdrivers.routines.analysis import batch


@pytest.fixture(autouse=True)
def in_process(monkeypatch):
    """Processes take a second to start; tests/routines/analysis has them."""
    monkeypatch.setattr(batch, "_in_processes", lambda files, _jobs, analyse: map(analyse, files))


@pytest.fixture
def run_file(optics_recording, tmp_path):
    shutil.copy(optics_recording, tmp_path / "run.mcap")
    return tmp_path / "run.mcap"


COMMANDS = (
    ("replay",), ("info",), ("export", "--to", "csv"), ("export", "--to", "hdf5"), ("analyse", "--out", "t.csv")
)  # fmt: skip


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: "-".join(command))
def test_files_that_are_no_recordings(run, tmp_path, command):
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "foreign.mcap").write_bytes(b"\x89MCAP0\r\n" * 4)
    with Recorder(
        tmp_path / "future.mcap", bus=Bus(), clock=SimulatedClock(),
        header=RecordingHeader(source="fake", schema_version=99, microdrivers="9.9"),
    ):  # fmt: skip
        pass
    for name, told in (("empty", "is empty"), ("foreign", "foreign.mcap"), ("future", "schema version 99")):
        result = run(command[0], f"{name}.mcap", *command[1:])
        assert told in result.stderr
        assert "Traceback" not in result.stderr
        if command[0] == "analyse":
            assert "1 with errors" in result.stdout
            (tmp_path / "t.csv").unlink()
        else:
            assert result.exit_code == 1
    assert run(command[0], "none.mcap", *command[1:]).exit_code == 1


@pytest.mark.parametrize("command", COMMANDS[:-1], ids=lambda command: "-".join(command))
@pytest.mark.parametrize("damage", ["truncated", "flipped"])
def test_damage_is_told(run, run_file, command, damage):
    data = bytearray(run_file.read_bytes())
    if damage == "truncated":
        del data[len(data) // 2 :]
    else:
        data[len(data) // 2] ^= 0x10
    run_file.write_bytes(data)
    result = run(command[0], run_file, *command[1:])
    assert result.exit_code == 0, result.output
    assert "not readable" in result.stderr or "  lost       " in result.stdout
    assert "lost       nothing" not in result.stdout


def test_info(run, run_file, tmp_path):
    result = run("info", run_file, "--contact-sheet", "sheet.png")
    assert result.exit_code == 0, result.output
    assert "camera  " in result.stdout
    assert "rig table, seed 4" in result.stdout
    assert "lost       nothing" in result.stdout
    assert (tmp_path / "sheet.png").read_bytes().startswith(b"\x89PNG")
    assert "cannot be written" in run("info", run_file, "--contact-sheet", "sheet.png").stderr
    found = json.loads(run("info", run_file, "--json").stdout)
    assert found["topics"]["camera"] | {"rate_hz": 0} == {
        "sample_type": "Frame", "count": 30, "rate_hz": 0, "first_s": 0.0, "last_s": pytest.approx(29 / 30, abs=1e-3),
        "missing": 0, "dropped": 0, "unsorted": 0,
    }  # fmt: skip


def test_info_tells_gaps_and_times_that_run_backwards(run, tmp_path):
    bus = Bus()
    with Recorder(tmp_path / "a.mcap", bus=bus, clock=SimulatedClock(), header=RecordingHeader(source="fake")):
        for seq, t_ns in ((0, 1000), (1, 3000), (4, 2000)):
            bus.topic("f", ForceSample).publish(ForceSample(t_ns=t_ns, device="f", seq=seq, force_uN=0.0, raw_uN=0.0))
    topic = json.loads(run("info", "a.mcap", "--json").stdout)["topics"]["f"]
    assert (topic["missing"], topic["unsorted"]) == (2, 1)
    assert "3 of 3 samples" in run("replay", "a.mcap", "--speed", 100).stdout
    assert run("export", "a.mcap", "--to", "csv").exit_code == 0
    assert "no frames to show" in run("info", "a.mcap", "--contact-sheet", "sheet.png").stderr
    assert "no frames to export" in run("export", "a.mcap", "--to", "video").stderr


def test_replay(run, run_file, monkeypatch):
    result = run("replay", run_file)
    assert result.exit_code == 0, result.output
    assert "91 of 91 samples" in result.stdout
    assert "× real time" in result.stdout
    assert run("replay", run_file, "--speed", "fast").exit_code == 2

    def interrupt(self, speed, on_progress):
        raise KeyboardInterrupt

    monkeypatch.setattr(RecordingPlayback, "run", interrupt)
    result = run("replay", run_file)
    assert (result.exit_code, "0 of 91 samples" in result.stdout) == (130, True)


def test_export_goes_beside_the_recording(run, run_file, tmp_path):
    result = run("export", run_file, "--to", "csv", "--topics", "stage, zoom")
    assert result.exit_code == 0, result.output
    assert sorted(file.name for file in (tmp_path / "run-export").iterdir()) == ["stage.csv", "zoom.csv"]
    assert "never writes over" in run("export", run_file, "--to", "csv").stderr
    result = run("export", run_file, "--to", "video")
    assert "loses detail" in result.stdout


def test_analyse(run, run_file, tmp_path):
    result = run("analyse", ".", "--out", "t.csv")
    assert result.exit_code == 0, result.output
    assert "1 recordings, 0 with errors" in result.stdout
    assert "never written over" in run("analyse", ".", "--out", "t.csv").stderr
