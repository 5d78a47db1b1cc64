"""`microdrivers analyse`."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from microdrivers.cli.exit_codes import EXIT_ERROR, EXIT_INTERRUPTED
from microdrivers.cli.progress import TerminalProgress


@click.command(short_help="Analyse many recordings into one table.")
@click.argument("runs", type=click.Path(path_type=Path), nargs=-1, required=True)
@click.option("--jobs", type=click.IntRange(min=1), default=1, show_default=True, help="Parallel processes.")
@click.option(
    "--out", type=click.Path(dir_okay=False, path_type=Path), metavar="TABLE", default=Path("analysis.csv"),
    show_default=True, help="New table, .csv or .parquet.",
)  # fmt: skip
@click.option("--dask", metavar="ADDRESS", help="A Dask scheduler instead of processes, such as tcp://10.0.0.5:8786.")
def analyse(runs: tuple[Path, ...], jobs: int, out: Path, dask: str | None) -> None:
    """Run the analysis again that each recording of RUNS holds, and write a table of results, one row a recording.

    RUNS are recordings, or folders with some in or below them. Optical calibrations and force characterisations are
    estimated anew from what was recorded. A file that cannot be analysed has a row that says why; the exit status
    is 1 if that is so of all of them. The column `doubtful` marks these rows, and those of runs that are not complete
    or of whose recording something is lost. After Ctrl-C or a kill, run the same command again to resume.

    \b
    Examples:
      microdrivers analyse runs/ --jobs 4
      microdrivers analyse monday/*.mcap --out monday.parquet
      microdrivers analyse runs/ --dask tcp://10.0.0.5:8786
    """
    from microdrivers.core.errors import ConfigError
    from microdrivers.routines.analysis import analyse_recordings, doubts, find_recordings

    if dask is not None and jobs != 1:
        raise ConfigError("--jobs and --dask exclude each other", remedy="the cluster has its own workers: omit --jobs")
    files = find_recordings(runs)
    progress = TerminalProgress()
    progress.step(_recordings(len(files)))
    try:
        report = analyse_recordings(
            files, out, jobs=jobs, dask=dask,
            on_progress=lambda done, total: progress.count(done, total, what="recordings"),
        )  # fmt: skip
    except KeyboardInterrupt:
        progress.close()
        click.echo(f"interrupted; run the same command again to resume ({out}.journal)", err=True)
        sys.exit(EXIT_INTERRUPTED)
    finally:
        progress.close()
    resumed = f", {report.resumed} of them from an earlier run" if report.resumed else ""
    doubtful = f", {len(report.doubtful)} doubtful" if report.doubtful else ""
    click.echo(f"{out}: {_recordings(len(report.rows))}{resumed}, {report.failed} with errors{doubtful}")
    for row in report.rows:
        if row["doubtful"]:
            click.echo(f"  {row['file']}: {row['error'] or 'doubtful: ' + ', '.join(doubts(row))}", err=True)
    if report.failed == len(report.rows):
        sys.exit(EXIT_ERROR)


def _recordings(number: int) -> str:
    return "1 recording" if number == 1 else f"{number} recordings"
