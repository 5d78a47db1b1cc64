"""`microdrivers record`."""

from __future__ import annotations

import difflib
import math
import shutil
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from microdrivers.cli.exit_codes import EXIT_ERROR, EXIT_INTERRUPTED
from microdrivers.cli.options import COMPRESSION_HELP, topic_patterns
from microdrivers.cli.rig_options import RigChoice, rig_options

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from microdrivers.core.clock import Clock
    from microdrivers.devices.base import Device
    from microdrivers.recording.recorder import Recorder
    from microdrivers.rig import Rig

_LINE_PERIOD_S = 1.0
_PLAIN_LINE_PERIOD_S = 10.0
_LOOK_PERIOD_S = 0.1
_HOUR_S, _DAY_S = 3600.0, 86400.0


def _finite(_context: click.Context, _parameter: click.Parameter, duration_s: float | None) -> float | None:
    if duration_s is not None and not math.isfinite(duration_s):
        raise click.BadParameter(f"{duration_s} is no time; without --for a recording goes on until Ctrl-C.")
    return duration_s


@click.command(short_help="Record what every device tells, frames included; nothing moves.")
@rig_options
@click.option(
    "--topics", multiple=True, metavar="NAMES",
    help="Record these alone, separated by commas; patterns are allowed. Default: all but the bytes on wires, of which "
    "there are many: only names and patterns that end in /wire ask for them, '*/wire' for instance.",
)  # fmt: skip
@click.option(
    "--for", "duration_s", type=click.FloatRange(min=0, min_open=True), callback=_finite, metavar="S",
    help="End after S seconds.",
)  # fmt: skip
@click.option(
    "--out", type=click.Path(path_type=Path), metavar="FILE", help="New file to write; default: RIG-DATE.mcap."
)
@click.option("--real-time", is_flag=True, help="Let a simulation take the time that it simulates.")
@click.option("--compress-images", is_flag=True, help=COMPRESSION_HELP.capitalize())
@click.option(
    "--on-failure", type=click.Choice(["stop", "go-on"]), default="stop", show_default=True,
    help="What a full disk does, or another program that writes to FILE: end the recording, or count what is lost.",
)  # fmt: skip
def record(
    choice: RigChoice,
    topics: tuple[str, ...],
    duration_s: float | None,
    out: Path | None,
    real_time: bool,
    compress_images: bool,
    on_failure: str,
) -> None:
    """Record all devices of the rig file RIG to an MCAP file, until Ctrl-C or for a given time. Nothing moves.

    Force comes at its sensor's rate, frames at their camera's, poses at 100 Hz, the zoom at 70 Hz. The file is
    complete after Ctrl-C, and whatever kills the program costs the last 0.1 s: see `microdrivers recording repair`.
    If samples could not be written, they are counted, and the exit status is 1; so it is if one of NAMES met no topic
    or no sample. After a Ctrl-C before all devices are open it is 130.

    \b
    Examples:
      microdrivers record lab.yaml
      microdrivers record lab.yaml --for 60 --out run.mcap
      microdrivers record lab.yaml --topics 'force,*/event'
      microdrivers record lab.yaml --fake --for 10
      microdrivers record lab.yaml --fake --real-time
    """
    from microdrivers.core.errors import ConfigError
    from microdrivers.recording.header import describe_recording
    from microdrivers.recording.recorder import Recorder

    simulated = (choice.fake or choice.wire_replay is not None) and not real_time
    if simulated and duration_s is None:
        raise ConfigError(
            "a simulation runs as fast as it can, and would fill the disk", remedy="add --for S, or --real-time"
        )
    patterns = topic_patterns(topics)
    rig = choice.build(real_time=real_time)
    try:
        if patterns is not None and len(_unmet(patterns, rig.bus.topics)) == len(patterns):
            raise ConfigError(
                f"there is no topic {_quoted(patterns)}, and nothing would be recorded",
                remedy=_similar(patterns, rig.bus.topics),
            )
        header = describe_recording(
            source="fake" if rig.fake or rig.file.emulated else "live", rig=rig.file.name,
            seed=(choice.seed or 0) if choice.fake else None,
        )  # fmt: skip
        recorder = Recorder(
            out or _default_file(rig), bus=rig.bus, clock=rig.clock, header=header, topics=patterns,
            on_failure="stop" if on_failure == "stop" else "go_on", compress_images=compress_images,
        )  # fmt: skip
    except BaseException:
        rig.close()
        raise
    ended_by_user = begun = False
    try:
        with recorder, rig, ExitStack() as streams:
            _attach_rig(recorder, rig)
            for name, device in rig.devices.items():
                if recorder.wants(name):
                    streams.enter_context(device.stream(_rate_hz(device)))
            begun = True
            _run(rig.clock, recorder, duration_s)
    except KeyboardInterrupt:
        ended_by_user = True
    disturbance = recorder.disturbance
    if not begun and recorder.empty and not disturbance:
        recorder.file.unlink()
        click.echo(f"nothing was recorded, and {recorder.file} was removed: not all devices were open yet", err=True)
        raise KeyboardInterrupt
    how = "complete"
    if ended_by_user:
        how = "ended by you; the file is complete" if begun else "ended by you before all devices were open"
    silent = _silent(patterns or (), recorder)
    _tell(recorder, how=how, disturbance=disturbance, silent=silent)
    unmet = _unmet(patterns or (), rig.bus.topics)
    if unmet:
        click.echo(f"there was no topic {_quoted(unmet)}: {_similar(unmet, rig.bus.topics)}", err=True)
    missed = [topic for topic in silent if not _tells_events(topic)]
    if missed:
        click.echo(f"no sample of {_quoted(missed)} came{_needed(missed, rig)}", err=True)
    if disturbance or unmet or missed or recorder.dropped or recorder.failure is not None or not recorder.complete:
        sys.exit(EXIT_ERROR)
    if not begun:
        sys.exit(EXIT_INTERRUPTED)


def _silent(patterns: Collection[str], recorder: Recorder) -> list[str]:
    """Topics without a sample for which a pattern asks that has met no other."""
    from microdrivers.recording.channels import is_wanted

    counts = recorder.counts
    found: dict[str, None] = {}
    for pattern in patterns:
        asked = [topic for topic in counts if is_wanted(topic, [pattern])]
        if not any(counts[topic].messages or counts[topic].dropped for topic in asked):
            found |= dict.fromkeys(asked)
    return list(found)


def _tells_events(topic: str) -> bool:
    """Whether it is silent as long as nothing happens."""
    from microdrivers.rig.safety import TOPIC

    return topic == TOPIC or topic.endswith("/event")


def _needed(topics: Collection[str], rig: Rig) -> str:
    """What would have let them come, as far as that is known."""
    from microdrivers.devices.camera import Camera
    from microdrivers.recording.channels import TRUTH_PREFIX

    cameras = [name for name, device in rig.devices.items() if isinstance(device, Camera)]
    if not cameras or not any(topic.startswith(TRUTH_PREFIX) for topic in topics):
        return ""
    return f": {TRUTH_PREFIX}* tells what was true at a camera's frames; record a camera too, such as {cameras[0]!r}"


def _unmet(patterns: Collection[str], topics: Collection[str]) -> list[str]:
    """Those of the patterns that ask for none of the topics."""
    from microdrivers.recording.channels import is_wanted

    return [pattern for pattern in patterns if not any(is_wanted(topic, [pattern]) for topic in topics)]


def _quoted(patterns: Collection[str]) -> str:
    return ", ".join(map(repr, patterns))


def _similar(patterns: Collection[str], topics: Collection[str]) -> str:
    """What to ask for instead."""
    from microdrivers.devices.wire_tap import WIRE_SUFFIX
    from microdrivers.recording.channels import matches

    close = dict.fromkeys(name for pattern in patterns for name in difflib.get_close_matches(pattern, topics, n=1))
    meant = f"did you mean {_quoted(close)}? " if close else ""
    if any(matches(topic, patterns) for topic in topics if topic.endswith(WIRE_SUFFIX)):
        meant += f"wires are asked for by a name or pattern that ends in {WIRE_SUFFIX}, such as '*{WIRE_SUFFIX}'; "
    return f"{meant}topics of this rig: {', '.join(topics)}"


def _default_file(rig: Rig) -> Path:
    from microdrivers.core.clock import utc_now

    return Path(f"{rig.file.name}-{utc_now():%Y%m%d-%H%M%S}.mcap")


def _attach_rig(recorder: Recorder, rig: Rig) -> None:
    import yaml

    text = yaml.safe_dump(rig.description.as_data(), sort_keys=False, allow_unicode=True)
    recorder.attach("rig.yaml", text.encode(), "application/yaml")


def _rate_hz(device: Device[Any]) -> float:
    from microdrivers.devices.camera import Camera
    from microdrivers.routines.stream_check import usual_rate_hz

    return device.settings.rate_hz if isinstance(device, Camera) else usual_rate_hz(device)


def _run(clock: Clock, recorder: Recorder, duration_s: float | None) -> None:
    """Wait until the time is over or the file cannot be written, and tell how it goes."""
    from microdrivers.core.units import NS_PER_S

    live = sys.stderr.isatty()
    period_s = _LINE_PERIOD_S if live else _PLAIN_LINE_PERIOD_S
    begin_ns = before_ns = clock.now_ns()
    before = {topic: count.messages for topic, count in recorder.counts.items()}
    end_s = float("inf") if duration_s is None else duration_s
    try:
        while (elapsed_s := (clock.now_ns() - begin_ns) / NS_PER_S) < end_s and not recorder.stopped:
            clock.sleep(min(_LOOK_PERIOD_S, end_s - elapsed_s))
            now_ns = clock.now_ns()
            over = now_ns - begin_ns >= end_s * NS_PER_S or recorder.stopped
            if now_ns - before_ns < period_s * NS_PER_S and not over:
                continue
            messages = {topic: count.messages for topic, count in recorder.counts.items()}
            width = shutil.get_terminal_size().columns - 1 if live else sys.maxsize
            since_s, elapsed_s = (now_ns - before_ns) / NS_PER_S, (now_ns - begin_ns) / NS_PER_S
            line = _line(recorder, messages, before, since_s, elapsed_s, width)
            click.echo(f"\r\x1b[2K{line}" if live else line, nl=not live, err=True)
            before, before_ns = messages, now_ns
    finally:
        if live:
            click.echo("", err=True)


def _line(
    recorder: Recorder,
    messages: Mapping[str, int],
    before: Mapping[str, int],
    period_s: float,
    elapsed_s: float,
    width: int,
) -> str:
    """How it goes, in at most so many columns: a line that is wrapped would not be overwritten by the next."""
    from microdrivers.recording.channels import TRUTH_PREFIX

    rates = " · ".join(
        f"{topic} {(number - before.get(topic, 0)) / max(period_s, _LOOK_PERIOD_S):.0f}/s"
        for topic, number in sorted(messages.items(), key=lambda item: item[0].startswith(TRUTH_PREFIX))
        if number > before.get(topic, 0)
    )
    dropped = f"{recorder.dropped} dropped"
    begin = f"{elapsed_s:.0f} s | {recorder.size / 1e6:.1f} MB{_room(recorder, elapsed_s)} | "
    rest = _cut(f" | {rates or 'nothing'}", width - len(begin) - len(dropped))
    return begin + (click.style(dropped, fg="red", bold=True) if recorder.dropped else dropped) + rest


def _room(recorder: Recorder, elapsed_s: float) -> str:
    """For how much longer the disk has room, at the mean rate so far; nothing if that is more than a day."""
    try:
        left_s = shutil.disk_usage(recorder.file.parent).free * elapsed_s / recorder.size
    except OSError:  # the folder is gone: the end tells
        return ""
    if left_s > _DAY_S:
        return ""
    return f", room for {left_s:.0f} s" if left_s < _HOUR_S else f", room for {left_s / _HOUR_S:.1f} h"


def _cut(text: str, width: int) -> str:
    return text if len(text) <= width else text[: max(width - 1, 0)] + "…"


def _tell(recorder: Recorder, *, how: str, disturbance: str, silent: Collection[str]) -> None:
    if recorder.empty:
        how += ", but it holds no samples"
    if not recorder.complete:
        how = "interrupted before its end was written; `microdrivers recording repair` makes it whole"
    if recorder.failure is not None:
        how = f"could not be written all the time: {recorder.failure.strerror or recorder.failure}"
    if disturbance:
        how = disturbance
    click.echo(f"{recorder.file}: {recorder.size / 1e6:.1f} MB, {how}")
    told = {
        topic: count for topic, count in recorder.counts.items() if count.messages or count.dropped or topic in silent
    }
    width = max(map(len, told), default=0)
    for topic, count in told.items():
        click.echo(f"  {topic:<{width}}  {count.messages} samples, {count.dropped} dropped")
