"""replay, info, export, analyse: what they show, and what they refuse."""

import json
import os
import random
import shutil

import msgspec
import pytest

from microdrivers.cli.run_output import RecordingChoice, start_recording
from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.samples import ForceSample
from microdrivers.recording.errors import RecordingError
from microdrivers.recording.header import RecordingHeader
from microdrivers.recording.mcap_scan import McapScan
from microdrivers.recording.playback import RecordingPlayback
from microdrivers.recording.reader import Recording
from microdrivers.recording.recorder import Recorder
from microdrivers.routines.analysis import batch, read_table


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
        assert result.exit_code == 1
        if command[0] == "analyse":
            assert "1 with errors" in result.stdout
            (tmp_path / "t.csv").unlink()
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
    again = run("info", run_file, "--contact-sheet", "sheet.png")
    assert (again.exit_code, "a contact sheet is never overwritten" in again.stderr) == (1, True)
    other = run("info", run_file, "--contact-sheet", "sheet.txt")
    assert (other.exit_code, "must end in .png" in other.stderr) == (1, True)
    assert not (tmp_path / "sheet.txt").exists()
    found = json.loads(run("info", run_file, "--json").stdout)
    assert found["topics"]["camera"] | {"rate_hz": 0, "usual_rate_hz": 0} == {
        "sample_type": "Frame", "count": 30, "rate_hz": 0, "usual_rate_hz": 0, "first_s": 0.0,
        "last_s": pytest.approx(29 / 30, abs=1e-3), "longest_gap_s": pytest.approx(1 / 30, abs=1e-3),
        "missing": 0, "dropped": 0, "repeated": 0, "unsorted": 0,
    }  # fmt: skip


def test_info_tells_gaps_and_times_that_run_backwards(run, tmp_path):
    bus = Bus()
    with Recorder(tmp_path / "a.mcap", bus=bus, clock=SimulatedClock(), header=RecordingHeader(source="fake")):
        for seq, t_ns in ((0, 1000), (1, 3000), (4, 2000)):
            bus.topic("f", ForceSample).publish(ForceSample(t_ns=t_ns, device="f", seq=seq, force_uN=0.0, raw_uN=0.0))
        for seq in (1, 0):
            bus.topic("g", ForceSample).publish(ForceSample(t_ns=seq, device="g", seq=seq, force_uN=0.0, raw_uN=0.0))
    found = json.loads(run("info", "a.mcap", "--json").stdout)
    assert [(topic["missing"], topic["unsorted"]) for topic in found["topics"].values()] == [(2, 1), (0, 1)]
    told = "missing: 2 samples of 'f', whose numbers are skipped"
    assert (found["ended"], found["complete"], found["losses"]) == (True, False, [told])
    shown = run("info", "a.mcap").stdout
    assert f"  lost       {told}\n" in shown
    assert "NOT COMPLETE" in shown.splitlines()[0]
    rates = [line.split()[3] for line in run("info", "a.mcap").stdout.splitlines() if "ForceSample" in line]
    assert rates == ["1e+06", "–"]
    assert "5 of 5 samples" in run("replay", "a.mcap", "--speed", 100).stdout
    assert run("export", "a.mcap", "--to", "csv").exit_code == 0
    assert "no frames to show" in run("info", "a.mcap", "--contact-sheet", "sheet.png").stderr
    assert "no frames to export" in run("export", "a.mcap", "--to", "video").stderr


def test_times_out_of_order_and_dropped_samples_are_told_to_who_uses_them(run, optics_recording, tmp_path):
    bus, clock = Bus(), SimulatedClock()
    with (
        Recording(optics_recording) as whole,
        Recorder(tmp_path / "a.mcap", bus=bus, clock=clock, header=RecordingHeader(source="recorded")) as recorder,
    ):
        for topic, sample in whole.samples():
            later = 10**9 if (topic, sample.seq) == ("stage", 3) else 0
            bus.topic(topic, type(sample)).publish(msgspec.structs.replace(sample, t_ns=sample.t_ns + later))
        recorder._out.counts["zoom"].refused += 2  # the disk does not keep up
    for command in (
        ("replay", "a.mcap"), ("export", "a.mcap", "--to", "csv"), ("calibrate", "optics", "--replay", "a.mcap"),
        ("calibrate", "optics", "--replay", "a.mcap", "--json"), ("calibrate", "force", "--replay", "a.mcap"),
    ):  # fmt: skip
        told = run(*command).stderr
        assert "out of order: 1 samples of 'stage'" in told
        assert "not recorded: 2 samples of 'zoom'" in told
    told = run("analyse", "a.mcap", "--out", "t.csv")
    [row] = read_table(tmp_path / "t.csv")
    assert [row[name] for name in ("losses", "missing", "dropped", "unsorted", "doubtful")] == ["0", "0", "2", "1", "1"]
    assert "1 recording, 1 with errors" in told.stdout  # a pose that is late by a second


@pytest.mark.parametrize(
    ("kind", "option", "value"),
    [
        *(("optics", "--replay", given) for given in (
            ("--zoom-to", "1.2"), ("--zoom-from", "0.9"), ("--settled",), ("--seed", "0"),
            ("--record",), ("--compress-images",), ("--radius-um", "100"), ("--rig", "lab.yaml"), ("--fake",),
        )),
        *(("optics", "--images", given) for given in (("--seed", "1"), ("--in-motion",))),
        *(("force", "--replay", given) for given in (
            ("--depth-um", "60"), ("--max-force-uN", "9"), ("--hold-s", "1"), ("--specimen", "a"), ("--no-record",),
            ("--world", "a.yaml"),
        )),
        *(("force", "--csv", given) for given in (("--speed-um-s", "5"), ("--seed", "0"), ("--no-check",))),
    ],
)  # fmt: skip
def test_options_that_drive_an_experiment_are_refused_where_there_is_none(run, tmp_path, kind, option, value):
    result = run("calibrate", kind, option, "data", *value, "--out", "run")
    assert result.exit_code == 1
    assert f"{option} replaces the rig" in result.stderr
    assert "leave out --" in result.stderr
    assert f"leave out {value[0]}; what can be tried" in result.stderr.splitlines()[-1]
    assert not (tmp_path / "run").exists()
    others = "--frames, --forgetting" if kind == "optics" else "--leave-out, --protocol"
    others = f"--no-check, {others}" if (kind, option) == ("force", "--replay") else others
    assert f"what can be tried on old data: {others}" in result.stderr


def test_other_settings_of_the_estimators_are_tried_on_old_data(run, run_file, force_recording, tmp_path):
    def again(kind, file, *options):
        result = run("calibrate", kind, "--replay", file, *options, "--out", f"{kind}{''.join(options)}", "--json")
        assert result.exit_code == 0, result.stderr
        return json.loads(result.stdout)

    usual = again("optics", run_file)
    settings = usual["provenance"]["settings"]
    fewer = again("optics", run_file, "--frames", "15")
    assert any("in which order its estimators got their samples" in note for note in usual["notes"])  # not recorded
    assert (usual["frames"], fewer["frames"], fewer["complete"]) == (settings["frames"], 15, True)
    assert fewer["provenance"]["settings"]["frames"] == 15
    forgetful = again("optics", run_file, "--forgetting", "0.6", "--flush-frames", "2")
    assert forgetful["provenance"]["settings"]["forgetting"] == 0.6
    assert forgetful["scale_sigma_px_per_um"] > 1.2 * usual["scale_sigma_px_per_um"]
    drifting = again("optics", run_file, "--drift-um-s", "2")
    assert drifting["projection"] == usual["projection"]
    assert drifting["angle_sigma_deg"] > 1.2 * usual["angle_sigma_deg"]
    asked = again("force", force_recording, "--protocol", "loading", "--leave-out", "4")
    assert asked["best"] == "loading"
    assert any("loading was asked for; single would be preferred" in note.lower() for note in asked["notes"])
    assert asked["provenance"]["settings"]["around_reversal"] == 4
    assert asked["excluded_samples"]["around contact and reversals"] == 5  # 3 as usual


def test_old_data_has_no_more_frames_than_it_has(run, run_file):
    result = run("calibrate", "optics", "--replay", run_file, "--frames", "400")
    assert (result.exit_code, "frames of the experiment, not 400" in result.stderr) == (1, True)
    for option, value in (("--forgetting", "nan"), ("--forgetting", "0"), ("--drift-um-s", "inf")):
        assert run("calibrate", "optics", "--replay", run_file, option, value).exit_code == 2


def test_a_calibration_that_is_none_of_the_last_zoom_is_no_success(run):
    result = run("calibrate", "optics", "--frames", 60, "--flush-frames", 100, "--no-record", "--out", "run")
    assert (result.exit_code, "NOT COMPLETE" in result.stdout) == (1, True), result.output
    assert "The run ended" in result.stdout


def test_a_calibration_whose_recording_lacks_its_last_frames_is_no_success(run, optics_recording, tmp_path):
    bus = Bus()
    with (
        Recording(optics_recording) as whole,
        Recorder(
            tmp_path / "run.mcap", bus=bus, clock=SimulatedClock(), header=RecordingHeader(source="recorded")
        ) as recorder,
    ):
        samples = [(topic, sample) for topic, sample in whole.samples() if topic != "routine"]
        recorder.follow_arrivals("optics", [sample.order for _, sample in samples])
        for topic, sample in whole.samples():
            if topic != "camera" or sample.seq < 25:
                bus.topic(topic, type(sample)).publish(sample)
    result = run("calibrate", "optics", "--replay", "run.mcap", "--out", "again")
    assert (result.exit_code, "NOT COMPLETE" in result.stdout) == (1, True), result.output
    assert "the recording lacks its last 5 frames" in result.stdout
    result = run("calibrate", "optics", "--replay", "run.mcap", "--frames", 20, "--out", "first")
    assert (result.exit_code, "NOT COMPLETE" in result.stdout) == (0, False), result.output


def test_a_replay_never_writes_over_a_result(run, run_file, force_recording, tmp_path):
    for kind, source in (("optics", run_file), ("force", force_recording)):
        folder = tmp_path / kind
        folder.mkdir()
        (folder / "result.json").write_text("mine")
        result = run("calibrate", kind, "--replay", source, "--out", folder)
        assert (result.exit_code, "a result is never overwritten" in result.stderr) == (1, True)
        assert [(file.name, file.read_text()) for file in folder.iterdir()] == [("result.json", "mine")]


def copy_without(source, file, topic):
    bus = Bus()
    with (
        Recording(source) as whole,
        Recorder(file, bus=bus, clock=SimulatedClock(), header=RecordingHeader(source="recorded")),
    ):
        for name, sample in whole.samples(leave_out=(topic,)):
            bus.topic(name, type(sample)).publish(sample)


def test_topics_that_an_estimator_lacks_are_named(run, optics_recording, force_recording, tmp_path):
    for kind, source, topic, told in (
        ("optics", optics_recording, "stage", "no samples of 'stage'"),
        ("optics", optics_recording, "zoom", "no samples of 'zoom'"),
        ("optics", optics_recording, "camera", "lacks the frame"),
        ("force", force_recording, "force", "no samples of 'force'"),
        ("force", force_recording, "deformation", "no samples of 'deformation'"),
        ("force", force_recording, "routine", "holds no force characterisation"),
    ):
        copy_without(source, tmp_path / f"no-{topic}.mcap", topic)
        result = run("calibrate", kind, "--replay", f"no-{topic}.mcap")
        assert (result.exit_code, told in result.stderr) == (1, True), result.stderr


def test_two_recordings_in_one_file_and_two_writers_to_one(run, run_file, force_recording, tmp_path):
    one, other = run_file.read_bytes(), force_recording.read_bytes()
    (tmp_path / "joined.mcap").write_bytes(one + other)
    blocks = [data[at : at + 4096] for at in range(0, len(one), 4096) for data in (one, other)]
    (tmp_path / "mixed.mcap").write_bytes(b"".join(blocks))
    for name in ("joined", "mixed"):
        result = run("replay", f"{name}.mcap")
        assert result.exit_code == 0
        assert ("something follows it" if name == "joined" else "something is damaged") in result.stderr
    assert "92 of 92 samples" in run("replay", "joined.mcap").stdout


def content(file):
    try:
        with Recording(file) as recording:
            return recording.header, [(topic, sample.order) for topic, sample in recording.samples()]
    except RecordingError:
        return None


@pytest.mark.parametrize("seed", range(3))
def test_no_damage_is_silent_or_a_traceback(run, force_recording, tmp_path, seed):
    whole, chance = force_recording.read_bytes(), random.Random(seed)
    for _ in range(12):
        data = bytearray(whole)
        if chance.random() < 0.3:
            del data[chance.randrange(len(data)) :]
        else:
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        file = tmp_path / "damaged.mcap"
        file.write_bytes(data)
        unharmed = content(file) == content(force_recording)  # a bit of an index, which nobody needs
        for command in (("info",), ("replay",), ("export", "--to", "csv"), ("recording", "repair")):
            (tmp_path / "damaged.repaired.mcap").unlink(missing_ok=True)
            shutil.rmtree(tmp_path / "damaged-export", ignore_errors=True)
            result = run(*command[:2], file) if command[0] == "recording" else run(command[0], file, *command[1:])
            told = result.output + result.stderr
            assert result.exit_code in (0, 1)
            assert unharmed or any(word in told for word in ("not readable", "  lost  ", "\nlost ", "error: "))
            assert unharmed or "lost       nothing" not in told
            assert unharmed or "nothing was lost" not in told


def test_replay(run, run_file, monkeypatch):
    result = run("replay", run_file)
    assert result.exit_code == 0, result.output
    assert "92 of 92 samples" in result.stdout
    assert "× real time" in result.stdout
    assert run("replay", run_file, "--speed", "fast").exit_code == 2

    def interrupt(self, speed, on_progress):
        raise KeyboardInterrupt

    monkeypatch.setattr(RecordingPlayback, "run", interrupt)
    result = run("replay", run_file)
    assert (result.exit_code, "0 of 92 samples" in result.stdout) == (130, True)


def test_export_goes_beside_the_recording(run, run_file, tmp_path):
    result = run("export", run_file, "--to", "csv", "--topics", "stage, zoom")
    assert result.exit_code == 0, result.output
    assert sorted(file.name for file in (tmp_path / "run-export").iterdir()) == ["stage.csv", "zoom.csv"]
    assert "never overwrites" in run("export", run_file, "--to", "csv").stderr
    result = run("export", run_file, "--to", "video")
    assert "loses detail" in result.stdout


def test_analyse(run, run_file, tmp_path):
    result = run("analyse", ".", "--out", "t.csv")
    assert result.exit_code == 0, result.output
    assert result.stdout == "t.csv: 1 recording, 0 with errors\n"
    [row] = read_table(tmp_path / "t.csv")
    assert (row["doubtful"], row["complete"], row["missing"]) == ("0", "1", "0")
    assert "never overwritten" in run("analyse", ".", "--out", "t.csv").stderr


def test_a_folder_is_no_file_and_a_cluster_has_its_own_workers(run, run_file):
    for command in (("recording", "repair", "."), ("recording", "repair", run_file, "--out", "."),
                    ("analyse", run_file, "--out", ".")):  # fmt: skip
        result = run(*command)
        assert result.exit_code == 2
        assert "is a directory" in result.stderr
    result = run("analyse", run_file, "--jobs", "2", "--dask", "tcp://127.0.0.1:9")
    assert "--jobs and --dask exclude each other" in result.stderr


def test_a_check_that_was_not_recorded_cannot_be_asked_for(run, force_recording):
    result = run("calibrate", "force", "--replay", force_recording, "--check")
    assert (result.exit_code, "holds one indentation" in result.stderr) == (1, True)


def rewrite(source, file, change=lambda sample: [sample]):
    """A copy in chunks of few samples, each sample replaced by what `change` makes of it."""
    bus, clock = Bus(), SimulatedClock()
    with (
        Recording(source) as whole,
        Recorder(file, bus=bus, clock=clock, header=RecordingHeader(source="recorded")),
    ):
        for topic, sample in whole.samples():
            for changed in change(sample):
                bus.topic(topic, type(changed)).publish(changed)
            clock.sleep(0.05)


def damage_a_chunk(file, share):
    with Recording(file) as whole:
        place = whole._scan.chunks[round(share * len(whole._scan.chunks))]
    data = bytearray(file.read_bytes())
    data[place.offset + place.length - 1] ^= 1
    file.write_bytes(data)


@pytest.mark.parametrize("kind", ["optics", "force"])
def test_a_result_from_a_damaged_recording_says_so(run, optics_recording, force_recording, tmp_path, kind):
    rewrite({"optics": optics_recording, "force": force_recording}[kind], tmp_path / "run.mcap")
    damage_a_chunk(tmp_path / "run.mcap", 0.8)
    result = run("calibrate", kind, "--replay", "run.mcap", "--out", "again")
    assert result.exit_code == 0, result.stderr
    told = "with a flaw: not readable: a chunk is damaged: its CRC does not match"
    assert any(told in note for note in json.loads((tmp_path / "again" / "result.json").read_text())["notes"])
    assert told in (tmp_path / "again" / "report.html").read_text()
    assert "NOT COMPLETE" in run("info", "run.mcap").stdout.splitlines()[0]
    run("recording", "repair", "run.mcap")
    assert run("calibrate", kind, "--replay", "run.repaired.mcap", "--out", "repaired").exit_code == 0
    assert "lost before the repair: a chunk is damaged" in (tmp_path / "repaired" / "result.json").read_text()
    run("analyse", "run.repaired.mcap", "--out", "t.csv")
    [row] = read_table(tmp_path / "t.csv")
    assert (row["losses"], row["doubtful"]) == ("1", "1")
    assert "with a flaw: lost before the repair: a chunk is damaged" in row["notes"]
    told = run("analyse", "run.mcap", "--out", "t2.csv")
    assert "1 recording, 0 with errors, 1 doubtful" in told.stdout
    assert f"  run.mcap: doubtful: damaged or lost parts: 1, missing samples: {row['missing']}\n" in told.stderr


def test_an_interrupted_characterisation_stays_one_when_it_is_replayed(run, force_recording, tmp_path):
    def without(*kinds):
        return lambda sample: [] if getattr(sample, "kind", "") in kinds else [sample]

    def interrupted(sample):
        if getattr(sample, "kind", "") != "force/done":
            return [sample]
        return [msgspec.structs.replace(sample, content=json.dumps({"ended_by": "it was interrupted"}))]

    rewrite(force_recording, tmp_path / "broken_off.mcap", without("force/end", "force/done"))
    rewrite(force_recording, tmp_path / "no_end.mcap", without("force/done"))
    rewrite(force_recording, tmp_path / "interrupted.mcap", interrupted)
    rewrite(force_recording, tmp_path / "whole.mcap")
    cut = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(cut[: int(0.7 * len(cut))])
    for name, told in (
        ("broken_off", ["the recorded run ends before indentation 1 was over"]),
        ("cut", ["the recording was cut off, and ends before indentation 1 was over"]),
        ("no_end", ["the recording does not hold its end"]),
        ("interrupted", ["it was interrupted"]),
        ("whole", []),
    ):
        result = run("calibrate", "force", "--replay", f"{name}.mcap", "--out", name)
        assert result.exit_code == 0, result.stderr
        found = json.loads((tmp_path / name / "result.json").read_text())
        assert found["complete"] is (not told)
        ended = [entry for entry in found["notes"] if "ended early" in entry]
        assert len(ended) == len(told)
        assert all(f"The run ended early: {why}." in entry for entry, why in zip(ended, told, strict=True))


def test_analyse_succeeds_if_some_can_be_analysed(run, run_file, tmp_path):
    (tmp_path / "bad.mcap").write_bytes(b"")
    result = run("analyse", ".", "--out", "t.csv")
    assert (result.exit_code, "2 recordings, 1 with errors" in result.stdout) == (0, True)


def test_analyse_waits_for_no_pipe(run, run_file, tmp_path):
    os.mkfifo(tmp_path / "pipe.mcap")
    assert ": 1 recording, 0 with errors" in run("analyse", ".", "--out", "t.csv").stdout
    result = run("analyse", "pipe.mcap", "--out", "u.csv")
    assert (result.exit_code, "neither a file nor a folder" in result.stderr) == (1, True)


def test_an_interrupted_repair_leaves_no_half_copy(run, run_file, tmp_path, monkeypatch):
    def interrupt(self, place):
        assert not (tmp_path / "new.mcap").exists()  # also a kill leaves no half copy of that name
        assert len(list(tmp_path.glob("new.mcap.*.part"))) == 1
        raise KeyboardInterrupt

    monkeypatch.setattr(McapScan, "read_chunk", interrupt)
    result = run("recording", "repair", run_file, "--out", "new.mcap")
    assert (result.exit_code, list(tmp_path.glob("new*"))) == (130, [])


def test_damage_around_a_chunk_is_told_and_mended(run, run_file):
    with Recording(run_file) as recording:
        place = recording._scan.chunks[2]
    data = bytearray(run_file.read_bytes())
    data[place.offset + 17] ^= 4  # when its last message was logged
    run_file.write_bytes(data)
    told = f"the header of the chunk at byte {place.offset} is damaged; its samples are intact"
    assert f"  damaged    {told}" in run("info", run_file).stdout
    repaired = run("recording", "repair", run_file, "--out", "new.mcap").stdout
    assert f"mended: {told}" in repaired
    assert "nothing was lost" in repaired
    assert json.loads(run("info", "new.mcap", "--json").stdout)["damaged_indexes"] == []


def test_a_recording_without_samples_is_told(run, tmp_path):
    Recorder(tmp_path / "a.mcap", bus=Bus(), clock=SimulatedClock(), header=RecordingHeader(source="fake")).close()
    result = run("replay", "a.mcap")
    assert (result.exit_code, "holds no samples" in result.stderr) == (1, True)


def test_the_calibration_that_a_run_uses_is_in_its_recording(tmp_path):
    used = tmp_path / "result.json"
    used.write_text("{}")
    known = {"fake": True, "seed": 1, "rig_name": "lab", "rig": {"name": "lab"}}
    choice = RecordingChoice(compress_images=False, calibration=used)
    start_recording(tmp_path / "run", choice, bus=Bus(), clock=SimulatedClock(), known=known).close()
    with Recording(tmp_path / "run" / "run.mcap") as recording:
        assert recording.attachments["calibration.json"] == b"{}"
        assert list(recording.attachments) == ["rig.yaml", "calibration.json", "provenance.json"]
