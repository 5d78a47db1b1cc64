"""`microdrivers info`."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from microdrivers.recording.reader import Recording


_COUNTS = ("missing", "dropped", "repeated", "unsorted")
"""Of a topic's samples, what speaks against them."""


@click.command(short_help="What a recording holds, and what it has lost.")
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "--contact-sheet", "sheet", type=click.Path(path_type=Path), metavar="PNG", help="New image: frames, by camera."
)
@click.option("--json", "as_json", is_flag=True, help="Print it as JSON.")
def info(file: Path, sheet: Path | None, as_json: bool) -> None:
    """Tell what the recording FILE holds: topics, rates, gaps, what was dropped, where it comes from, what is damaged.

    \b
    Examples:
      microdrivers info run.mcap
      microdrivers info run.mcap --contact-sheet frames.png
      microdrivers info run.mcap --json
    """
    from microdrivers.recording.reader import Recording

    with Recording(file) as recording:
        found = describe(recording)
        click.echo(json.dumps(found, indent=1, allow_nan=False) if as_json else _as_text(found))
        if sheet is not None:
            from microdrivers.recording.contact_sheet import write_contact_sheet

            number = write_contact_sheet(recording, sheet)
            click.echo(f"{sheet}: {number} frames", err=as_json)


def describe(recording: Recording) -> dict[str, Any]:
    """All that is known of a recording, as plain data."""
    import msgspec

    from microdrivers.core.units import NS_PER_S
    from microdrivers.recording.views import start_ns

    begin_ns = start_ns(recording)
    lost = [*map(str, recording.losses), *recording.drops, *recording.skipped]
    topics: dict[str, dict[str, Any]] = {}
    for name, topic in recording.topics.items():
        topics[name] = {
            "sample_type": topic.sample_type.__name__,
            "count": topic.count,
            "rate_hz": _finite(topic.rate_hz),
            "usual_rate_hz": _finite(topic.usual_rate_hz),
            "first_s": (topic.first_t_ns - begin_ns) / NS_PER_S if topic.count else None,
            "last_s": (topic.last_t_ns - begin_ns) / NS_PER_S if topic.count else None,
            "longest_gap_s": _finite(topic.longest_gap_s),
            "missing": topic.gaps,
            "dropped": topic.dropped,
            "repeated": topic.repeated,
            "unsorted": topic.unsorted,
        }
    ends: list[float | None] = [topic["last_s"] for topic in topics.values()]
    return {
        "file": str(recording.file),
        "bytes": recording.file.stat().st_size,
        "ended": recording.complete,
        "complete": recording.complete and not lost,
        "duration_s": max((last_s for last_s in ends if last_s is not None), default=0.0),
        "start_ns": begin_ns,
        "header": msgspec.structs.asdict(recording.header),
        "clock": None if recording.clock is None else msgspec.structs.asdict(recording.clock),
        "topics": topics,
        "arrivals": {host: len(orders) for host, orders in recording.arrivals.items()},
        "attachments": {name: len(data) for name, data in recording.attachments.items()},
        "losses": lost,
        "damaged_indexes": [str(damage) for damage in recording.check_indexes()],
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _as_text(found: dict[str, Any]) -> str:
    header = found["header"]
    ended = "complete" if found["complete"] else "NOT COMPLETE: see what it has lost, below"
    if not found["ended"]:
        ended = "not ended: its program was killed, or the file was cut off"
    lines = [
        f"{found['file']}: {found['bytes'] / 1e6:.1f} MB, {found['duration_s']:.3f} s, {ended}",
        f"  made       {header['created_utc'] or 'unknown'} by microdrivers {header['microdrivers'] or 'unknown'}"
        f" (schema {header['schema_version']}, Python {header['python'] or 'unknown'})",
        f"  source     {header['source']}, rig {header['rig'] or 'unknown'}"
        + ("" if header["seed"] is None else f", seed {header['seed']}"),
        f"  command    {header['command'] or 'unknown'}",
        f"  clock      {_clock(found['clock'])}",
        "",
    ]
    names = ["topic", "samples", "count", "mean rate", "from s", "to s", "longest gap s", *_COUNTS]
    rows = [names, *(_row(name, topic) for name, topic in found["topics"].items())]
    widths = [max(len(row[column]) for row in rows) for column in range(len(names))]
    for row in rows:
        texts = [f"{cell:<{width}}" for cell, width in zip(row[:2], widths[:2], strict=True)]
        numbers = [f"{cell:>{width}}" for cell, width in zip(row[2:], widths[2:], strict=True)]
        lines.append("  " + "  ".join([*texts, *numbers]).rstrip())
    lines += [
        "",
        "  attached   " + (", ".join(f"{n} ({s} bytes)" for n, s in found["attachments"].items()) or "nothing"),
    ]
    if found["arrivals"]:
        lines.append(
            "  estimators " + ", ".join(f"{host} ({number} samples)" for host, number in found["arrivals"].items())
        )
    lines += ["", *(f"  lost       {loss}" for loss in found["losses"] or ["nothing"])]
    lines += [f"  damaged    {damage}" for damage in found["damaged_indexes"]]
    if found["damaged_indexes"]:
        lines.append("             other programs may misread it; `microdrivers recording repair` makes it anew")
    return "\n".join(lines)


def _row(name: str, topic: dict[str, Any]) -> list[str]:
    def seconds(value: float | None) -> str:
        return "–" if value is None else f"{value:.3f}"

    tells_rate = topic["rate_hz"] is not None and topic["count"] > 2  # of two events, a rate says nothing
    rate = f"{topic['rate_hz']:.4g} Hz" if tells_rate else "–"
    return [
        name, topic["sample_type"], str(topic["count"]), rate, seconds(topic["first_s"]), seconds(topic["last_s"]),
        seconds(topic["longest_gap_s"]), *(str(topic[key]) for key in _COUNTS),
    ]  # fmt: skip


def _clock(clock: dict[str, Any] | None) -> str:
    if clock is None:
        return "unknown: that record is damaged"
    if clock["kind"] == "simulated":
        return "simulated, begins at 0"
    told = f"system; wall time = t_ns + {clock['offset_ns']} ns ± {clock['uncertainty_ns'] / 1e3:.0f} µs at the start"
    if clock["end_offset_ns"] is not None:
        told += f", {(clock['end_offset_ns'] - clock['offset_ns']) / 1e3:+.0f} µs more at the end"
    return told
