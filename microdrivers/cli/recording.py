"""`microdrivers recording repair`."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from microdrivers.cli.exit_codes import EXIT_ERROR


@click.command(short_help="Make a torn or damaged recording readable by any MCAP tool.")
@click.argument("file", type=click.Path(dir_okay=False, path_type=Path))
@click.option(
    "--out", type=click.Path(dir_okay=False, path_type=Path), metavar="FILE2",
    help="New file; default: FILE.repaired.mcap.",
)  # fmt: skip
def repair(file: Path, out: Path | None) -> None:
    """Write all of FILE that is intact to a new file, which any MCAP reader reads. FILE stays as it is.

    For recordings of a program that was killed, of a full disk or a bad copy. Chunks whose CRC does not match are left
    out; what was kept and what was lost is listed. The exit status is 1 if something was lost and no message could be
    kept. A repair that is killed leaves FILE2.NUMBER.part behind, to be deleted.

    \b
    Examples:
      microdrivers recording repair run.mcap
      microdrivers recording repair run.mcap --out whole.mcap
    """
    from microdrivers.recording.repair import repair as write_repaired

    target = out or file.with_name(f"{file.stem}.repaired.mcap")
    report = write_repaired(file, target)
    messages = sum(report.messages.values())
    intact = report.size - report.lost_bytes
    click.echo(f"{report.out}: {messages} messages kept, from {intact} of {report.size} bytes")
    width = max(map(len, report.messages), default=0)
    for topic, number in report.messages.items():
        click.echo(f"  {topic:<{width}}  {number}")
    for damage in report.mended:
        click.echo(f"mended: {damage}")
    for topic, number in report.backwards.items():
        click.echo(f"kept as they are: {number} messages of {topic} whose log time is before their predecessor's")
    for flaw in report.flaws:
        click.echo(f"as in the original: {flaw}")
    if not report.losses:
        click.echo("nothing more was lost" if report.flaws else "nothing was lost")
        return
    # Of bytes that never came to the file, nothing is known.
    click.echo(f"lost {report.lost_bytes} of {report.size} bytes:" if report.lost_bytes else "lost:")
    for loss in report.losses:
        click.echo(f"  {loss}")
    if not messages:
        sys.exit(EXIT_ERROR)
