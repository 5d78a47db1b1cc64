"""`microdrivers export`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

from microdrivers.cli.options import topic_patterns
from microdrivers.cli.output import tell_flaws
from microdrivers.cli.progress import TerminalProgress

if TYPE_CHECKING:
    from microdrivers.recording.export import Format

_FORMATS = ("csv", "parquet", "hdf5", "images", "video")


@click.command(short_help="A recording as CSV, Parquet, HDF5, images or video.")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--to", type=click.Choice(_FORMATS), required=True, help="Format; `video` loses detail and exact times.")
@click.option(
    "--topics", multiple=True, metavar="NAMES", help="These alone, separated by commas; patterns are allowed."
)
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Folder to write to; default: FILE-export.")
def export(file: Path, to: str, topics: tuple[str, ...], out: Path | None) -> None:
    """Write the recording FILE in a format that other tools open. Nothing is overwritten.

    csv and parquet: one table a topic, time_s since the recording's start, t_ns, then all fields, units in their
    names. hdf5: one file, for h5py and MATLAB, images included. images: numbered PNG files and frames.csv, which
    `calibrate optics --images` reads if pose and zoom were recorded, the stage referenced. video: Motion JPEG at the
    rate between pauses, to look at. An export that is killed leaves a hidden folder .export-… in DIR, to be deleted.

    \b
    Examples:
      microdrivers export run.mcap --to csv
      microdrivers export run.mcap --to hdf5 --out analysis/
      microdrivers export run.mcap --to csv --topics 'probe_force,estimate/*'
      microdrivers export run.mcap --to images --topics camera_fine
    """
    from microdrivers.recording.export import export_recording
    from microdrivers.recording.reader import Recording

    patterns = topic_patterns(topics)
    progress = TerminalProgress()
    try:
        with Recording(file) as recording:
            tell_flaws(recording)
            progress.step(f"reading {file}")
            report = export_recording(
                recording, cast("Format", to), out or file.with_name(f"{file.stem}-export"), topics=patterns,
                on_progress=lambda done, total: progress.count(done, total, what="samples"),
            )  # fmt: skip
    finally:
        progress.close()
    for written, number in report.written.items():
        click.echo(f"{written}: {number} samples")
    if to == "video":
        click.echo("a video loses detail and exact times: look at it, measure in the recording")
    for remark in report.remarks:
        click.echo(remark, err=True)
