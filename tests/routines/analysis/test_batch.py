"""Many recordings into one table: the same whatever the number of processes, kills and bad files in between."""

import json
import os
import resource
import shutil
import signal
from pathlib import Path

import pytest

from microdrivers import __version__
from microdrivers.core.errors import ConfigError, UnsupportedError
from microdrivers.recording.reader import Recording
from microdrivers.routines.analysis import (
    COLUMNS,
    analyse_recording,
    analyse_recordings,
    batch,
    find_recordings,
    read_table,
)
from microdrivers.routines.analysis.one import analyse_force
from microdrivers.routines.analysis.results_table import ResultsTable


def fake_row(file):
    """An analysis that takes no time; of a file whose name says so, one that kills its process."""
    if "deadly" in file:
        os.kill(os.getpid(), signal.SIGKILL)
    size = Path(file).stat().st_size
    return dict.fromkeys(COLUMNS) | {"file": file, "kind": 'test, "quoted"', "scale_px_per_um": size / 3}


class _Killed(BaseException):
    pass


def here(monkeypatch):
    monkeypatch.setattr(batch, "_in_processes", lambda files, _jobs, analyse: map(analyse, files))


@pytest.fixture
def in_process(monkeypatch):
    """Processes take a second to start: what is not about them does without."""
    here(monkeypatch)


@pytest.fixture
def files(tmp_path):
    for number in range(6):
        (tmp_path / f"{number}.mcap").write_bytes(b"x" * (number + 1))
    return find_recordings([tmp_path])


def test_an_optical_calibration_and_a_force_characterisation(optics_recording, force_recording):
    row = analyse_recording(str(optics_recording))
    assert list(row) == list(COLUMNS)
    assert (row["error"], row["kind"], row["losses"], row["rig"]) == (None, "optical-calibration", 0, "table")
    assert row["frames"] + row["lost_frames"] + row["unmatched_frames"] >= 25
    assert row["scale_px_per_um"] > 0
    row = analyse_recording(str(force_recording))
    assert (row["error"], row["kind"]) == (None, "force-characterisation")
    with Recording(force_recording) as recording:
        result, _ = analyse_force(recording)
    assert row["k1_uN_per_um"] == result.protocols[row["protocol"]].k1_uN_per_um
    assert row["notes"] == " ".join(result.notes)
    assert (row["complete"], row["doubtful"]) == (True, False)


def test_this_process_and_two_others_give_the_same_bytes_and_bad_files_have_rows(
    optics_recording, tmp_path, monkeypatch
):
    runs = tmp_path / "runs"
    runs.mkdir()
    whole = optics_recording.read_bytes()
    shutil.copy(optics_recording, runs / "a.mcap")
    (runs / "empty.mcap").write_bytes(b"")
    (runs / "foreign.mcap").write_bytes(b"no recording")
    (runs / "torn.mcap").write_bytes(whole[: len(whole) // 3 * 2])
    files = find_recordings([runs])
    analyse_recordings(list(reversed(files)), tmp_path / "two.csv", jobs=2)
    with monkeypatch.context() as patched:
        here(patched)
        one = analyse_recordings(files, tmp_path / "one.csv")
    assert (tmp_path / "one.csv").read_bytes() == (tmp_path / "two.csv").read_bytes()
    rows = {row["file"].rsplit("/")[-1]: row for row in read_table(tmp_path / "one.csv")}
    assert rows["empty.mcap"]["error"].startswith("EmptyRecording")
    assert rows["foreign.mcap"]["error"].startswith("ForeignRecording")
    assert int(rows["torn.mcap"]["losses"]) > 0
    assert {name: row["doubtful"] for name, row in rows.items() if row["doubtful"] != "1"} == {"a.mcap": "0"}
    assert float(rows["a.mcap"]["scale_px_per_um"]) == one.rows[0]["scale_px_per_um"]
    assert not (tmp_path / "one.csv.journal").exists()


def test_topics_that_an_estimator_needs_are_missed(optics_recording, tmp_path):
    from microdrivers.core.bus import Bus
    from microdrivers.core.clock import SimulatedClock
    from microdrivers.recording.header import RecordingHeader
    from microdrivers.recording.recorder import Recorder

    for topics, told in (
        (["routine", "stage", "zoom"], "lacks the frame"), (["routine", "camera"], "no samples of 'stage'")
    ):  # fmt: skip
        bus, clock = Bus(), SimulatedClock()
        file = tmp_path / f"{len(topics)}.mcap"
        with (
            Recording(optics_recording) as whole,
            Recorder(file, bus=bus, clock=clock, header=RecordingHeader(source="recorded")),
        ):
            for topic, sample in whole.samples(topics):
                bus.topic(topic, type(sample)).publish(sample)
        row = analyse_recording(str(file))
        assert told in row["error"]


def test_an_interrupted_run_is_gone_on_with(in_process, files, tmp_path):
    def break_off(done, total):
        if done == 3:
            raise _Killed

    analyse_recordings(files, tmp_path / "whole.csv", analyse=fake_row)
    table = tmp_path / "t.csv"
    with pytest.raises(_Killed):
        analyse_recordings(files, table, analyse=fake_row, on_progress=break_off)
    journal = tmp_path / "t.csv.journal"
    assert len(journal.read_bytes().splitlines()) == 4
    with journal.open("ab") as stream:
        stream.write(b'{"row": {"file": "torn')
    done = [json.loads(line)["row"]["file"] for line in journal.read_bytes().splitlines()[1:4]]
    os.utime(done[0], ns=(1, 1))  # has changed since: to be done again
    report = analyse_recordings(files, table, analyse=fake_row)
    assert (report.resumed, report.failed) == (2, 0)
    assert table.read_bytes() == (tmp_path / "whole.csv").read_bytes()


def test_a_file_that_kills_its_process_has_a_row(files, tmp_path):
    deadly = tmp_path / "3-deadly.mcap"
    deadly.write_bytes(b"x")
    report = analyse_recordings([files[0], str(deadly)], tmp_path / "t.csv", jobs=1, analyse=fake_row)
    assert report.failed == 1
    failed = next(row for row in report.rows if row["error"])
    assert (failed["file"], failed["doubtful"], report.doubtful) == (str(deadly), True, [])
    assert [row["error"] is None for row in report.rows] == [True, False]


def test_parquet_holds_the_same(in_process, files, tmp_path):
    from pyarrow import parquet  # here: the processes of other tests would import it too

    report = analyse_recordings(files, tmp_path / "t.parquet", analyse=fake_row)
    assert parquet.read_table(tmp_path / "t.parquet").to_pylist() == report.rows


def test_tables_are_refused(in_process, files, tmp_path):
    for name, told in (("a.txt", "end in .csv"), ("there.csv", "never overwritten"), ("dir/", "must end in")):
        (tmp_path / "there.csv").write_text("mine")
        with pytest.raises(ConfigError, match=told):
            analyse_recordings(files, tmp_path / name, analyse=fake_row)
    (tmp_path / "b.csv.journal").write_text("something else\n")
    with pytest.raises(ConfigError, match="not a journal"):
        analyse_recordings(files, tmp_path / "b.csv", analyse=fake_row)
    older = {"journal": "microdrivers analyse", "microdrivers": __version__, "columns": [*COLUMNS][:-1]}
    (tmp_path / "b.csv.journal").write_text(json.dumps(older) + "\n")
    with pytest.raises(ConfigError, match="another version of microdrivers"):
        analyse_recordings(files, tmp_path / "b.csv", analyse=fake_row)
    with ResultsTable(tmp_path / "c.csv"), pytest.raises(ConfigError, match="another program"):
        ResultsTable(tmp_path / "c.csv")


def test_what_is_meant_is_found(files, tmp_path):
    assert find_recordings([tmp_path, tmp_path / "1.mcap"]) == files
    with pytest.raises(ConfigError, match="no such recording"):
        find_recordings([tmp_path / "none.mcap"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match=r"holds no \*\.mcap"):
        find_recordings([tmp_path / "empty"])


def test_a_cluster_needs_its_extra(files, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(UnsupportedError) as caught:
        analyse_recordings(files, tmp_path / "t.csv", dask="tcp://127.0.0.1:1", analyse=fake_row)
    assert "microdrivers[cluster]" in caught.value.remedy


def test_a_recording_to_which_links_lead_is_analysed_once(tmp_path, monkeypatch):
    runs = tmp_path / "runs" / "monday"
    runs.mkdir(parents=True)
    (runs / "b.mcap").write_bytes(b"")
    (runs / "a.mcap").symlink_to("b.mcap")
    (runs / "back").symlink_to("..")
    monkeypatch.chdir(tmp_path)
    named = [Path("runs"), tmp_path / "runs", Path("runs/monday/back/monday/b.mcap"), Path("runs/monday/back")]
    assert find_recordings(named) == [str(runs / "a.mcap")]
    assert find_recordings(named[:1]) == ["runs/monday/a.mcap"]


def test_links_to_folders_are_followed_and_one_that_leads_nowhere_has_a_row(in_process, tmp_path):
    runs, elsewhere = tmp_path / "runs", tmp_path / "elsewhere"
    for folder in (runs / "z", elsewhere):
        folder.mkdir(parents=True)
        (folder / "run.mcap").write_bytes(b"")
    (runs / "a").symlink_to("z")
    (runs / "linked").symlink_to("../elsewhere")
    (elsewhere / "back").symlink_to("../runs")
    (runs / "gone.mcap").symlink_to("nowhere.mcap")
    found = find_recordings([runs])
    assert found == [str(runs / name) for name in ("gone.mcap", "linked/run.mcap", "z/run.mcap")]
    report = analyse_recordings(found, tmp_path / "t.csv")
    assert "cannot be read: No such file" in report.rows[0]["error"]


def test_a_table_on_a_full_disk_is_refused_and_leaves_no_journal(in_process, files, tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    for size, told in ((100, "cannot be written: File too large"), (3000, "cannot be written: File too large")):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            with pytest.raises(ConfigError, match=told):
                analyse_recordings(files, tmp_path / "t.csv", analyse=fake_row)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert (tmp_path / "t.csv.journal").exists() == (size == 3000)  # which has rows
    assert analyse_recordings(files, tmp_path / "t.csv", analyse=fake_row).resumed > 0
