"""`microdrivers doctor`."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Iterator
from contextlib import closing
from typing import TYPE_CHECKING

import click

from microdrivers.cli.exit_codes import EXIT_ERROR
from microdrivers.cli.progress import TerminalProgress
from microdrivers.cli.rig_options import RigChoice, rig_options

if TYPE_CHECKING:
    from microdrivers.rig import Rig
    from microdrivers.routines.findings import Diagnosis, Finding

_LABELS = {"ok": ("OK", "green"), "warning": ("warning", "yellow"), "problem": ("PROBLEM", "red")}
_WIDTH = 110
_INDENT = " " * 11


@click.command(short_help="Examine every device and say what is wrong and what to try.")
@rig_options
@click.option("--motion", is_flag=True, help="Also move each referenced linear axis by ±20 µm; asks first.")
@click.option("--yes", is_flag=True, help="Do not ask whether the way is free.")
@click.option("--json", "as_json", is_flag=True, help="Print findings and figures as JSON.")
def doctor(choice: RigChoice, motion: bool, yes: bool, as_json: bool) -> None:
    """Examine every device of the rig file RIG, say what is wrong and what to try. Nothing moves without --motion.

    Each device is opened by itself, so that one failure does not hide the others. Measured: the time of 20 reads,
    the rate of one second's stream, how well the time of a sample is known; of a camera also lost frames, saturation,
    and whether grab() returns frames exposed after the call; of a CAN bus its load while all its devices stream, and
    its errors.

    --motion compares sign and size of small steps with the stage's own encoder. It cannot see a wrong sign that
    motor and encoder share: only the camera can (`microdrivers calibrate optics`). The axes of an emulated stage are
    referenced first.

    Exit status 0 if there is no problem (there may be warnings), else 1.

    \b
    Examples:
      microdrivers doctor lab.yaml
      microdrivers doctor lab.yaml --motion
      microdrivers doctor lab.yaml --json > before-the-experiment.json
      microdrivers doctor lab.yaml --fake --motion
    """
    import msgspec

    from microdrivers.routines.doctor import diagnose

    progress = TerminalProgress(quiet=as_json)
    with closing(choice.build()) as rig:
        if motion and not (yes or rig.fake):
            _ask_for_the_way(rig)
        diagnosis = diagnose(rig, motion=motion, progress=progress)
        where = _where(choice, emulated=rig.file.emulated)
    if as_json:
        click.echo(msgspec.json.format(msgspec.json.encode(diagnosis), indent=2).decode())
    else:
        for line in _lines(diagnosis, where):
            click.echo(line)
    if diagnosis.count("problem"):
        sys.exit(EXIT_ERROR)


def _ask_for_the_way(rig: Rig) -> None:
    from microdrivers.devices.stage import Stage
    from microdrivers.routines.doctor import STEP_UM

    stages = [name for name, device in rig.devices.items() if isinstance(device, Stage)]
    if stages:
        what = f"{', '.join(stages)}: linear axes will move by ±{STEP_UM:g} µm. Is the way free?"
        click.confirm(what, abort=True, err=True)


def _where(choice: RigChoice, *, emulated: bool) -> str:
    if choice.wire_replay is not None:
        return f"replayed from {choice.wire_replay}"
    if choice.fake:
        return "emulated, simulated clock"
    return "emulated, on ports" if emulated else "hardware"


def _lines(diagnosis: Diagnosis, where: str) -> Iterator[str]:
    yield f"rig {diagnosis.rig} ({diagnosis.file}), {where}"
    for device in diagnosis.devices:
        yield ""
        yield click.style(device.name, bold=True) + f"  {device.driver}"
        for finding in device.findings:
            yield from _finding_lines(finding)
    for bus in diagnosis.buses:
        yield ""
        yield click.style(bus.name, bold=True) + f"  shared by {', '.join(bus.devices)}"
        for finding in bus.findings:
            yield from _finding_lines(finding)
    problems, warnings = diagnosis.count("problem"), diagnosis.count("warning")
    yield ""
    yield (
        f"{_counted(len(diagnosis.devices), 'device')}: {diagnosis.count('ok')} OK, "
        f"{_counted(warnings, 'warning')}, {_counted(problems, 'problem')}"
    )


def _finding_lines(finding: Finding) -> Iterator[str]:
    label, colour = _LABELS[finding.level]
    first, *rest = textwrap.wrap(finding.what, _WIDTH - len(_INDENT)) or [""]
    yield f"  {click.style(f'{label:<7}', fg=colour)}  {first}"
    for line in rest:
        yield f"{_INDENT}{line}"
    if finding.remedy:
        # A command must survive being copied: the remedy is not wrapped.
        yield f"{_INDENT}try: {finding.remedy}"


def _counted(number: int, noun: str) -> str:
    return f"{number or 'no'} {noun}{'' if number == 1 else 's'}"
