"""Analyses many recordings in parallel processes, or on a Dask cluster."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import connection
from pathlib import Path
from typing import NamedTuple

from microdrivers.core.errors import ConfigError
from microdrivers.recording.views import optional_module
from microdrivers.routines.analysis.one import Row, analyse_recording, failed_row
from microdrivers.routines.analysis.results_table import ResultsTable

_THREAD_LIMITS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_PER_WORKER = 2
"""Recordings handed to each worker ahead of time."""
SCHEDULER_TIMEOUT = "10s"

Analyse = Callable[[str], Row]


class BatchReport(NamedTuple):
    """What became of a batch: rows of the table, and how many of them an earlier run had left or have an error."""

    rows: list[Row]
    resumed: int
    failed: int

    @property
    def doubtful(self) -> list[Row]:
        """Rows without an error whose figures are not to be trusted without a second look."""
        return [row for row in self.rows if row["doubtful"] and row["error"] is None]


def find_recordings(runs: Sequence[Path]) -> list[str]:
    """The recordings that are meant: files as they are, of folders all `*.mcap` in and below; sorted.

    Links to folders are followed, and one that leads nowhere is a recording that cannot be read. Each is there once,
    also if links or several ways of writing its path lead to it: by the first of these.

    Raises:
        ConfigError: there is no such file or folder, or a folder holds no recording, or what is named is neither.
    """
    found: set[str] = set()
    for run in runs:
        if not run.exists():
            raise ConfigError("there is no such recording", file=str(run), remedy="check the path")
        if not (run.is_file() or run.is_dir()):  # a pipe lets its reader wait
            raise ConfigError("it is neither a file nor a folder", file=str(run), remedy="name recordings")
        inside = [str(file) for file in _recordings_below(run)] if run.is_dir() else [str(run)]
        if not inside:
            raise ConfigError("the folder holds no *.mcap", file=str(run), remedy="name recordings or their folders")
        found.update(inside)
    return sorted({os.path.realpath(file): file for file in sorted(found, reverse=True)}.values())


def _recordings_below(folder: Path) -> Iterator[Path]:
    """All `*.mcap` in and below a folder; each folder is entered once, by a link only if no other way leads to it."""
    entered: set[str] = set()
    tops = deque([folder])
    while tops:
        for root, folders, names in os.walk(tops.popleft()):
            real = os.path.realpath(root)
            if real in entered:
                folders.clear()
                continue
            entered.add(real)
            tops.extend(Path(root, name) for name in sorted(folders) if Path(root, name).is_symlink())
            for file in (Path(root, name) for name in names if name.endswith(".mcap")):
                if file.is_file() or (file.is_symlink() and not file.exists()):
                    yield file


def analyse_recordings(
    files: Sequence[str],
    table: Path,
    *,
    jobs: int = 1,
    dask: str | None = None,
    analyse: Analyse = analyse_recording,
    on_progress: Callable[[int, int], object] = lambda _done, _total: None,
) -> BatchReport:
    """Analyse recordings into a table (.csv or .parquet), sorted by file.

    Rows are kept as they come: a run that is interrupted or killed is gone on with by calling this again. The table is
    the same whatever `jobs`, on a cluster (of equal machines), and after a kill. A recording that cannot be analysed
    has a row with its `error`.

    Args:
        files: as `find_recordings` gives them.
        table: a new file.
        jobs: processes, each with one thread.
        dask: address of a scheduler, such as `tcp://10.0.0.5:8786`, whose workers see the same files; instead of
            processes.
        analyse: what makes a row of a file.
        on_progress: told rows done and in all.

    Raises:
        ConfigError: the table cannot be written, or is being filled by another program; no scheduler answers.
        UnsupportedError: an extra is missing.
    """
    with ResultsTable(table) as results:
        todo = [file for file in files if not results.is_done(file)]
        resumed = len(files) - len(todo)
        done = resumed
        on_progress(done, len(files))
        source = _on_cluster(todo, dask, analyse) if dask is not None else _in_processes(todo, jobs, analyse)
        for row in source:
            results.add(row)
            done += 1
            on_progress(done, len(files))
        results.finish(files)
        rows = [results.rows[file] for file in sorted(set(files))]
    return BatchReport(rows, resumed, sum(row["error"] is not None for row in rows))


# ---------------------------------------------------------------------- processes


def _in_processes(files: Sequence[str], jobs: int, analyse: Analyse) -> Iterator[Row]:
    """Rows as they come. A file that kills its worker has a row that says so; it is found by trying one by one."""
    waiting = list(reversed(files))
    while waiting:
        suspects = yield from _with_pool(waiting, jobs, analyse)
        for file in suspects:
            if (yield from _with_pool([file], 1, analyse)):
                yield failed_row(file, "the process that analysed it was killed")


def _with_pool(waiting: list[str], jobs: int, analyse: Analyse) -> Generator[Row, None, list[str]]:
    """Takes files from the end of `waiting` until it is empty or a worker has died.

    Returns:
        the files that were in work when a worker died; none if none did.
    """
    in_work: dict[Future[Row], str] = {}
    context = multiprocessing.get_context("spawn")
    watched, held = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(jobs, context, initializer=_begin_worker, initargs=(watched,))
    try:
        while waiting or in_work:
            while waiting and len(in_work) < _PER_WORKER * jobs:
                with _one_thread_each():  # a worker is started when it is needed
                    in_work[pool.submit(analyse, waiting[-1])] = waiting[-1]
                waiting.pop()
            for future in wait(in_work, return_when=FIRST_COMPLETED).done:
                row = future.result()
                del in_work[future]
                yield row
    except BrokenProcessPool:
        return list(in_work.values())
    finally:
        if not in_work:
            pool.shutdown()
        held.close()
        pool.shutdown(cancel_futures=True)
        watched.close()
    return []


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Workers started within have one thread for linear algebra: two jobs are to be twice as fast on two cores."""
    before = {name: os.environ.get(name) for name in _THREAD_LIMITS}
    os.environ.update(dict.fromkeys(_THREAD_LIMITS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _begin_worker(watched: connection.Connection) -> None:
    """One thread; Ctrl-C is the main program's affair; a worker ends at once when that no longer holds its pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with, args=(watched,), daemon=True).start()


def _end_with(watched: connection.Connection) -> None:
    connection.wait([watched])
    os._exit(1)


# ---------------------------------------------------------------------- cluster


async def _knock(address: str) -> None:
    """Find out whether somebody listens there."""
    distributed, comm = optional_module("distributed"), optional_module("distributed.comm")
    arguments = distributed.Security().get_connection_args("client")
    opened = await comm.connect(address, timeout=SCHEDULER_TIMEOUT, **arguments)
    opened.abort()


def _on_cluster(files: Sequence[str], address: str, analyse: Analyse) -> Iterator[Row]:
    distributed = optional_module("distributed", extra="cluster")
    try:
        # First: a client that finds no scheduler is not rid of before the program's end, and tells that in a traceback.
        asyncio.run(_knock(address))
        client = distributed.Client(address, timeout=SCHEDULER_TIMEOUT, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:  # TypeError: of TLS without certificates
        raise ConfigError(
            f"no Dask scheduler answers at {address!r}: {error}", remedy="check the address, and that it runs"
        ) from error
    with client:
        futures = {client.submit(analyse, file, pure=False): file for file in files}
        for future in distributed.as_completed(futures, loop=client.loop):
            if future.status == "finished":
                yield future.result()
            else:
                why = f"the cluster has given it up: {future.exception()}".splitlines()[0]
                yield failed_row(futures[future], why)
            future.release()
