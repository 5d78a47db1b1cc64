"""`microdrivers reference`."""

from __future__ import annotations

from contextlib import closing
from typing import TYPE_CHECKING, Any

import click

from microdrivers.cli.progress import TerminalProgress
from microdrivers.cli.rig_options import RigChoice, find_device, rig_options

if TYPE_CHECKING:
    from microdrivers.core.samples import DeviceEvent
    from microdrivers.devices.stage import Stage
    from microdrivers.devices.zoom_motor import ZoomMotor
    from microdrivers.rig import Rig


@click.command(short_help="Find the reference of a stage or the zoom (moves!).")
@rig_options
@click.option(
    "--axes",
    metavar="A,B,…",
    help="Axes of a stage in the order in which to reference them: x,y,theta. Default, of a fine stage: as the rig "
    "file says.",
)
@click.option("--device", help="Which stage or zoom; default: the microscope's sample stage.")
@click.option("--yes", is_flag=True, help="Do not ask whether the way is free.")
def reference(choice: RigChoice, axes: str | None, device: str | None, yes: bool) -> None:
    """Find the reference of a stage or the zoom of the rig file RIG. IT MOVES to its reference switches.

    Asks first whether the way is free. Ctrl-C stops the device. Only that device is opened. A fine stage is referenced
    in the order of its reference_order in the rig file, which takes the tool away first.

    \b
    Examples:
      microdrivers reference lab.yaml --axes x,y,theta
      microdrivers reference lab.yaml --device probe_stage
      microdrivers reference lab.yaml --device zoom
    """
    from microdrivers.cli.standstill import says_where_it_stopped
    from microdrivers.devices.zoom_motor import ZoomMotor
    from microdrivers.routines.device_state import state_text

    with closing(choice.build()) as rig:
        found = _find(rig, choice, device)
        names = _checked_axes(found, axes)
        found.open()
        if not (yes or rig.fake):
            order = f", {', then '.join(names)}" if names else ""
            question = f"{found.name} will move to its reference switches{order}. Is the way free?"
            click.confirm(question, abort=True, err=True)
        progress = TerminalProgress()
        found.events.subscribe(lambda event: _show(event, progress))
        with says_where_it_stopped(found, choice.file):
            if isinstance(found, ZoomMotor):
                found.reference()
            else:
                found.reference(names)
        what = f"{', '.join(names)} referenced" if names else "reference found"
        click.echo(f"{found.name}: {what}; now at {state_text(found, found.read())}")
        trapped = None if isinstance(found, ZoomMotor) else rig.safety.trapped(found)
        if trapped is not None:
            raise trapped


def _find(rig: Rig, choice: RigChoice, name: str | None) -> Stage[Any] | ZoomMotor:
    from microdrivers.core.errors import ConfigError
    from microdrivers.devices.stage import Stage
    from microdrivers.devices.zoom_motor import ZoomMotor

    section = rig.file.microscope
    if name is None and section is None:
        raise ConfigError("the rig file names no sample stage", file=str(choice.file), remedy="add --device NAME")
    wanted = name or (section.sample_stage if section else "")
    device: Stage[Any] | ZoomMotor = find_device(rig, wanted, (Stage, ZoomMotor), unsuitable="has no reference")
    return device


def _checked_axes(device: Stage[Any] | ZoomMotor, axes: str | None) -> list[str]:
    """The axes that were named, refused before anything is opened or asked if they are not the device's."""
    from microdrivers.core.errors import OutOfRange, UnsupportedError
    from microdrivers.devices.fine_stage import FineStage
    from microdrivers.devices.zoom_motor import ZoomMotor

    if axes is None and isinstance(device, FineStage):
        return list(device.reference_order)
    names = [name.strip() for name in (axes or "").split(",") if name.strip()]
    if isinstance(device, ZoomMotor):
        if axes is not None:
            raise UnsupportedError("a zoom has one axis only", device=device.name, remedy="leave out --axes")
        return []
    if not names or len(set(names)) != len(names) or not set(names) <= set(device.axis_names):
        raise OutOfRange(
            f"axes to reference: {', '.join(names) or 'none'}", device=device.name,
            remedy=f"name each of {', '.join(device.axis_names)} at most once, in the order that is safe: "
            f"--axes {','.join(device.reference_order)}",
        )  # fmt: skip
    return names


def _show(event: DeviceEvent, progress: TerminalProgress) -> None:
    if event.kind == "reference_found" and event.reason:
        progress.step(f"{event.reason} has found its reference")
