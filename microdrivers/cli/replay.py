"""`microdrivers replay`."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from microdrivers.cli.exit_codes import EXIT_ERROR, EXIT_INTERRUPTED
from microdrivers.cli.output import tell_flaws
from microdrivers.cli.progress import TerminalProgress


def _speed(_context: click.Context, _parameter: click.Parameter, value: str) -> float | None:
    """× real time; None stands for `max`."""
    if value == "max":
        return None
    try:
        speed = float(value)
    except ValueError:
        speed = 0.0
    if not 0.0 < speed < float("inf"):
        raise click.BadParameter(f"{value!r} is neither 'max' nor a number above 0")
    return speed


@click.command(short_help="Publish a recording again, in recorded order.")
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "--speed", callback=_speed, default="max", show_default=True, metavar="X", help="× real time, or max: no waiting."
)
def replay(file: Path, speed: float | None) -> None:
    """Publish all that the recording FILE holds on a bus, in recorded order; tells what there was and how fast it went.

    In Python, `microdrivers.recording.playback.open_replay` gives that bus to subscribers of one's own. To estimate
    anew from a recording, see `calibrate optics --replay` and `calibrate force --replay`.

    \b
    Examples:
      microdrivers replay run.mcap
      microdrivers replay run.mcap --speed 1     as it happened
    """
    from microdrivers.core.clock import SimulatedClock, SystemClock
    from microdrivers.core.units import NS_PER_S
    from microdrivers.recording.playback import open_replay

    progress = TerminalProgress()
    clock = SystemClock()
    interrupted = False
    try:
        with open_replay(file, clock=SimulatedClock() if speed is None else clock) as playback:
            tell_flaws(playback.recording)
            total = sum(found.count for found in playback.recording.topics.values())
            progress.step(f"replaying {file}")
            begin_ns = clock.now_ns()
            try:
                playback.run(speed, on_progress=lambda done: progress.count(done, total, what="samples"))
            except KeyboardInterrupt:
                interrupted = True
            took_s = (clock.now_ns() - begin_ns) / NS_PER_S
            progress.close()
            width = max(map(len, playback.counts), default=0)
            for topic, number in playback.counts.items():
                click.echo(f"  {topic:<{width}}  {number}")
            factor = f", {playback.span_s / took_s:.3g} × real time" if took_s > 0 and playback.span_s else ""
            published = sum(playback.counts.values())
            click.echo(f"{published} of {total} samples, {playback.span_s:.3f} s in {took_s:.3f} s{factor}")
    finally:
        progress.close()
        clock.close()
    if not total:
        click.echo(f"{file} holds no samples: nothing was recorded in it, or nothing can be read", err=True)
        sys.exit(EXIT_ERROR)
    if interrupted:
        click.echo("interrupted", err=True)
        sys.exit(EXIT_INTERRUPTED)
