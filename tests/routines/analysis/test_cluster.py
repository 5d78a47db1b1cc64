"""A Dask cluster makes the same table as processes, and one bad file or a broken task does not stop it."""

import distributed
import pytest
from distributed import LocalCluster

from microdrivers.core.errors import ConfigError
from microdrivers.routines.analysis import COLUMNS, analyse_recordings, batch, find_recordings


def row_or_failure(file):
    """An analysis that takes no time, and fails on one file as only a worker can."""
    if "broken" in file:
        raise RuntimeError("the worker has lost its memory")
    return dict.fromkeys(COLUMNS) | {"file": file, "kind": "test", "scale_px_per_um": len(file) / 3}


@pytest.fixture(scope="module")
def cluster():
    """One worker in a thread of this process, over TCP; without an address for its pages it takes a fixed port."""
    pages = "127.0.0.1:0"
    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", host="127.0.0.1", dashboard_address=pages
    ) as made:  # fmt: skip
        yield made.scheduler_address


def test_a_live_cluster_gives_the_table_of_one_process(cluster, tmp_path, optics_recording, monkeypatch):
    runs = tmp_path / "runs"
    runs.mkdir()
    (runs / "a.mcap").hardlink_to(optics_recording)
    (runs / "empty.mcap").write_bytes(b"")
    files = find_recordings([runs])
    seen = []
    report = analyse_recordings(
        files, tmp_path / "dask.csv", dask=cluster, on_progress=lambda *counts: seen.append(counts)
    )
    assert (len(report.rows), report.failed, seen) == (2, 1, [(0, 2), (1, 2), (2, 2)])
    monkeypatch.setattr(batch, "_in_processes", lambda files, _jobs, analyse: map(analyse, files))
    analyse_recordings(files, tmp_path / "one.csv")
    assert (tmp_path / "dask.csv").read_bytes() == (tmp_path / "one.csv").read_bytes()


def test_a_task_that_fails_on_the_cluster_has_a_row(cluster, tmp_path):
    files = [str(tmp_path / name) for name in ("a", "broken", "c")]
    report = analyse_recordings(files, tmp_path / "t.csv", dask=cluster, analyse=row_or_failure)
    assert [row["error"] for row in report.rows if row["error"]] == [
        "the cluster has given it up: the worker has lost its memory"
    ]
    assert report.failed == 1


@pytest.mark.parametrize("address", ["nowhere", "", "tls://127.0.0.1:9", "smoke://127.0.0.1:9"])
def test_addresses_that_are_none_leave_no_client_and_no_journal(tmp_path, monkeypatch, address):
    # A client that finds no scheduler hangs at the program's end, and leaves a traceback.
    monkeypatch.setattr(distributed, "Client", lambda *_, **__: pytest.fail("there is a client"))
    with pytest.raises(ConfigError, match="no Dask scheduler answers"):
        analyse_recordings(["a"], tmp_path / "t.csv", dask=address, analyse=row_or_failure)
    assert list(tmp_path.iterdir()) == []


def test_no_scheduler_at_the_address(tmp_path, monkeypatch):
    monkeypatch.setattr(batch, "SCHEDULER_TIMEOUT", "0.3s")
    with pytest.raises(ConfigError, match=r"no Dask scheduler answers at 'tcp://127\.0\.0\.1:9'"):
        analyse_recordings(["a"], tmp_path / "t.csv", dask="tcp://127.0.0.1:9", analyse=row_or_failure)
