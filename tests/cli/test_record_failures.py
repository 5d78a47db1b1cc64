"""A disk that is full, a folder that takes no file: what was configured happens, and what is lost is told."""

import contextlib
import json
import resource
import subprocess
import sys

import pytest

from microdrivers.configs import shipped_rig
from microdrivers.recording.mcap_writer import McapWriter
from microdrivers.recording.reader import Recording
from microdrivers.recording.recorder import Recorder


@contextlib.contextmanager
def disk_with(size):
    """No file of this process may grow larger: the kernel refuses the write, as it does on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    keeps_no_bytecode, sys.dont_write_bytecode = sys.dont_write_bytecode, True  # it would be cut off, and stay so
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        sys.dont_write_bytecode = keeps_no_bytecode


@pytest.mark.parametrize("on_failure", ["stop", "go-on"])
def test_record_on_a_full_disk(run, tmp_path, on_failure):
    with disk_with(1_500_000):
        result = run(
            "record", shipped_rig("microscope"), "--fake", "--for", 0.4, "--out", "a.mcap", "--on-failure", on_failure
        )
    assert result.exit_code == 1
    recording = Recording(tmp_path / "a.mcap")
    cameras = recording.topics["camera_fine"]
    assert recording.complete
    assert 0 < cameras.count < 6
    stopped = ["the recording was stopped because it could not be written: File too large"]
    assert [str(loss) for loss in recording.losses] == (stopped if on_failure == "stop" else [])
    shown = run("info", "a.mcap").stdout
    assert "NOT COMPLETE" in shown.splitlines()[0]
    assert f"lost       not recorded: {cameras.dropped} samples of 'camera_fine'" in shown
    assert "nothing" not in shown.splitlines()[-1]
    if on_failure == "stop":
        assert "could not be written: File too large" in result.stderr
        assert "--on-failure go-on" in result.stderr
        assert cameras.last_t_ns < recording.topics["sample_stage"].last_t_ns < 0.35e9
    else:
        assert f"camera_fine         {cameras.count} samples, {cameras.dropped} dropped" in result.stdout
        assert "could not be written all the time: File too large" in result.stdout
        assert cameras.count + cameras.dropped == recording.topics["truth/optics"].count > 10
        assert recording.topics["sample_stage"].last_t_ns > 0.35e9
    assert f"not recorded: {cameras.dropped} samples of 'camera_fine'" in run("replay", "a.mcap").stderr


@pytest.mark.xdist_group("real_time")
def test_a_full_disk_ends_a_recording_in_real_time_at_once_and_is_no_devices_fault(run, tmp_path):
    with disk_with(30_000):
        result = run(
            "record", shipped_rig("microscope"), "--fake", "--real-time", "--for", 60, "--out", "a.mcap",
            "--topics", "sample_stage,zoom",
        )  # fmt: skip
    assert result.exit_code == 1
    assert "a.mcap could not be written: File too large" in result.stderr
    assert "could be told to stop" not in result.stderr
    assert Recording(tmp_path / "a.mcap").topics["sample_stage"].count < 1000


def test_a_calibration_goes_on_without_its_disk_and_says_what_its_recording_lacks(run, tmp_path):
    with disk_with(1_500_000):
        result = run("calibrate", "optics", "--frames", 20, "--zoom-to", 0.9, "--out", "run")
    dropped = Recording(tmp_path / "run" / "run.mcap").topics["camera_fine"].dropped
    assert dropped > 20
    assert f"MB; it lacks {dropped} samples that could not be written)" in result.stdout
    told = f"The recording run.mcap lacks {dropped} samples that could not be written (File too large)"
    assert result.exit_code == 1
    assert told in " ".join(result.stdout.split())
    assert json.loads((tmp_path / "run" / "result.json").read_text())["notes"][-1].startswith(told)
    assert told in (tmp_path / "run" / "report.html").read_text()
    result = run("calibrate", "optics", "--replay", "run/run.mcap")
    assert (result.exit_code, f"not recorded: {dropped} samples" in result.stderr) == (1, True)


@pytest.mark.parametrize("as_json", [False, True])
def test_a_result_that_the_disk_does_not_take_is_shown_all_the_same(run, tmp_path, as_json):
    with disk_with(10_000):
        arguments = ("--no-record", *(["--json"] if as_json else []))
        result = run("calibrate", "optics", "--frames", 20, "--zoom-to", 0.9, "--out", "run", *arguments)
    assert result.exit_code == 1
    for name in ("result.json", "report.html"):
        assert f"error: run/{name} could not be written: File too large" in result.stderr
    assert [file.name for file in (tmp_path / "run").iterdir()] == ["calibration.yaml"]
    if as_json:
        assert json.loads(result.stdout)["complete"]
    else:
        assert "Scale" in result.stdout
        assert "written to" not in result.stdout


def test_a_disk_without_any_space_is_told_before_anything_moves(run, tmp_path):
    for command in (
        ("record", shipped_rig("microscope"), "--fake", "--for", 1, "--out", "run.mcap"),
        ("calibrate", "optics", "--out", "."),
    ):
        with disk_with(100):
            result = run(*command)
        assert result.exit_code == 1
        assert "the recording cannot be written there: File too large" in result.stderr
        assert "referencing" not in result.stderr
        assert not (tmp_path / "run.mcap").exists()


def test_folders_that_take_no_recording(run, tmp_path):
    (tmp_path / "file").write_text("mine")
    for folder, why in (("file", "Not a directory"), ("none", "No such file"), ("/proc", "No such file")):
        result = run("record", shipped_rig("microscope"), "--fake", "--for", 1, "--out", f"{folder}/a.mcap")
        assert (result.exit_code, why in result.stderr) == (1, True), result.stderr
    for kind in ("optics", "force"):
        result = run("calibrate", kind, "--out", "file/run")
        assert (result.exit_code, "nothing can be written there" in result.stderr) == (1, True), result.stderr


def test_images_may_be_compressed(run, tmp_path):
    result = run("calibrate", "optics", "--frames", 20, "--zoom-to", 0.9, "--out", "run", "--compress-images")
    assert result.exit_code == 0, result.stderr
    file = tmp_path / "run" / "run.mcap"
    size = file.stat().st_size
    assert f"run.mcap ({size / 1e6:.1f} MB)" in result.stdout
    assert size < 0.75 * 640 * 480 * Recording(file).topics["camera_fine"].count
    assert run("calibrate", "optics", "--replay", file, "--out", "again").exit_code == 0
    one, other = (json.loads((tmp_path / name / "result.json").read_text()) for name in ("run", "again"))
    assert (one["projection"], one["covariance"]) == (other["projection"], other["covariance"])


@pytest.mark.parametrize("size", [40_000, 400_000])
@pytest.mark.parametrize("form", ["csv", "hdf5", "images", "video"])
def test_exports_to_a_full_disk_fail_and_leave_nothing(run, optics_recording, tmp_path, form, size):
    with Recording(optics_recording) as recording:
        assert recording.topics["camera"].count == 30
    arguments = ("export", optics_recording, "--to", form, "--out", "out")
    if form in ("csv", "images"):
        size = 1000
    with disk_with(size):
        result = run(*arguments)
    assert result.exit_code == 1
    assert "written" in result.stderr
    assert "on a disk with space left" in result.stderr
    assert not (tmp_path / "out").exists()
    result = run(*arguments)
    assert result.exit_code == 0, result.stderr


@pytest.mark.parametrize("how", ["removed", "replaced", "written to", "emptied"])
def test_a_recording_that_somebody_else_touches_is_told(run, tmp_path, prepared, how):
    file = tmp_path / "a.mcap"

    def remove():
        if how == "written to":
            with file.open("ab") as stream:
                stream.write(bytes(10**6))
            return
        if how == "emptied":
            file.write_bytes(b"")
            return
        file.unlink()
        if how == "replaced":
            file.write_text("another")

    prepared(lambda rig: rig.clock.call_at(rig.clock.now_ns() + 50_000_000, remove, name="somebody"))
    result = run(
        "record", shipped_rig("microscope"), "--fake", "--for", 0.1, "--out", "a.mcap", "--topics", "zoom",
        "--on-failure", "go-on",
    )  # fmt: skip
    corrupt = how in ("written to", "emptied")
    told = "corrupt: another program wrote to it" if corrupt else "gone: it, or its disk, was removed"
    assert (result.exit_code, told in result.stdout) == (1, True), result.output
    if how == "written to":
        assert "something follows it" in run("info", "a.mcap").stdout
    if how == "emptied":
        assert "  lost       something is damaged here" in run("info", "a.mcap").stdout


def test_a_recording_whose_end_was_interrupted_is_not_called_complete(run, tmp_path, monkeypatch):
    def interrupt(self):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(McapWriter, "finish", interrupt)
        result = run("record", shipped_rig("microscope"), "--fake", "--for", 0.1, "--out", "a.mcap", "--topics", "zoom")
    told = "a.mcap: 0.0 MB, interrupted before its end was written; `microdrivers recording repair` makes it whole"
    assert (result.exit_code, told in result.stdout) == (1, True), result.output
    assert run("recording", "repair", "a.mcap").exit_code == 0
    assert Recording(tmp_path / "a.repaired.mcap").topics["zoom"].count > 0


def test_a_calibration_says_that_its_recording_is_gone(run, tmp_path, monkeypatch):
    def close_and_lose(self, close=Recorder.close):
        close(self)
        self.file.unlink(missing_ok=True)

    monkeypatch.setattr(Recorder, "close", close_and_lose)
    result = run("calibrate", "optics", "--frames", 20, "--zoom-to", 0.9, "--out", "run")
    note = json.loads((tmp_path / "run" / "result.json").read_text())["notes"][-1]
    assert (result.exit_code, note.startswith("The recording run.mcap is gone: it")) == (1, True)


def test_a_contact_sheet_is_whole_or_not_there(run, optics_recording, tmp_path):
    with disk_with(4096):
        result = run("info", optics_recording, "--contact-sheet", "sheet.png")
    assert (result.exit_code, "cannot be written: File too large" in result.stderr) == (1, True)
    assert not (tmp_path / "sheet.png").exists()


def test_hdf5_on_a_full_disk_ends_with_its_program(optics_recording, tmp_path):
    """What HDF5 could not write it tries again when the process ends."""
    command = [sys.executable, "-m", "microdrivers", "export", optics_recording, "--to", "hdf5", "--out", tmp_path]
    with disk_with(40_000):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert [line for line in done.stderr.splitlines() if not line.startswith("·")] == [
        f"error: {tmp_path}: nothing can be written there: File too large",
        "  to do: choose another --out folder, on a disk with space left",
    ]
