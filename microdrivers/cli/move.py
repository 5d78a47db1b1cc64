"""`microdrivers move`."""

from __future__ import annotations

import math
from contextlib import closing
from typing import TYPE_CHECKING, Any

import click

from microdrivers.cli.rig_options import RigChoice, find_device, rig_options

if TYPE_CHECKING:
    from microdrivers.devices.fine_stage import FineStage
    from microdrivers.devices.stage import Stage
    from microdrivers.devices.zoom_motor import ZoomMotor
    from microdrivers.rig import Rig

_TARGET_OF = {"x": "x_um", "y": "y_um", "z": "z_um", "theta": "theta_deg"}
_ZOOM_OPTIONS = ("zoom",)


@click.command(short_help="Move a stage or the zoom, and wait until settled.")
@rig_options
@click.argument("device")
@click.option("--x-um", type=float, help="Target (with --by: distance) on x, µm.")
@click.option("--y-um", type=float, help="Target (with --by: distance) on y, µm.")
@click.option("--z-um", type=float, help="Target (with --by: distance) on z of a fine stage, µm.")
@click.option("--theta-deg", type=float, help="Target (with --by: angle) on θ, degrees.")
@click.option("--zoom", type=float, help="Zoom to set (with --by: to add).")
@click.option("--by", "relative", is_flag=True, help="Move by these amounts, counted from where the device is.")
@click.option("--speed-um-s", type=float, help="Path speed of the linear axes; default: as fast as they allow.")
@click.option("--theta-speed-deg-s", type=float, help="Speed of θ; default: as fast as the axis allows.")
@click.option("--retract", is_flag=True, help="Take a fine stage's tool away from the sample, as the rig file says.")
def move(choice: RigChoice, device: str, relative: bool, retract: bool, **options: float | None) -> None:
    """Move DEVICE of the rig file RIG, wait until it has settled and print where it was observed to be.

    The move is checked before anything moves: finite, inside the limits, axes referenced, speed possible; nothing is
    clipped. Ctrl-C stops the device. A failed move is stopped and never repeated. Only DEVICE is opened. An emulated
    device (--fake) starts anew with each command, so its axes are referenced first.

    \b
    Examples:
      microdrivers move lab.yaml sample_stage --x-um 7600 --y-um 7450 --speed-um-s 500
      microdrivers move lab.yaml sample_stage --by --x-um -20
      microdrivers move lab.yaml sample_stage --theta-deg 0.5
      microdrivers move lab.yaml zoom --zoom 1.2
      microdrivers move lab.yaml probe_stage --z-um 250 --speed-um-s 50
      microdrivers move lab.yaml probe_stage --retract
    """
    from microdrivers.cli.standstill import says_where_it_stopped
    from microdrivers.core.errors import NotReferenced
    from microdrivers.devices.stage import Stage
    from microdrivers.devices.zoom_motor import ZoomMotor

    given = {name: value for name, value in options.items() if value is not None}
    with closing(choice.build()) as rig:
        stage_or_zoom = find_device(rig, device, (Stage, ZoomMotor), unsuitable="cannot move")
        _check_options(stage_or_zoom, given, retract)
        stage_or_zoom.open()
        try:
            with says_where_it_stopped(stage_or_zoom, choice.file):
                if isinstance(stage_or_zoom, ZoomMotor):
                    _move_zoom(stage_or_zoom, given["zoom"], relative)
                    return
                _reference_emulated(rig, stage_or_zoom, given)
                if retract:
                    _retract(rig, stage_or_zoom)
                else:
                    _move_stage(stage_or_zoom, given, relative)
        except NotReferenced as error:
            error.remedy = f"make sure that the way is free, then: {_reference_command(choice, stage_or_zoom, given)}"
            raise


def _check_options(device: Stage[Any] | ZoomMotor, given: dict[str, float], retract: bool) -> None:
    """Refuse options that are not the device's, or that name no target, before anything is opened."""
    from microdrivers.core.errors import OutOfRange, UnsupportedError
    from microdrivers.devices.fine_stage import FineStage

    known = _options_of(device)
    targets = [_option(name) for name in known if "speed" not in name]
    if retract:
        if not isinstance(device, FineStage) or given:
            raise UnsupportedError(
                "--retract is a whole move of a fine stage", device=device.name, remedy="give it alone, or leave it out"
            )
        return
    foreign = [_option(name) for name in given if name not in known]
    if foreign:
        raise UnsupportedError(
            f"{', '.join(foreign)} cannot be used here", device=device.name, remedy=f"give {', '.join(targets)}"
        )
    if not any(_option(name) in targets for name in given):
        raise OutOfRange("a move needs a target", device=device.name, remedy=f"give {', '.join(targets)}")


def _options_of(device: Stage[Any] | ZoomMotor) -> tuple[str, ...]:
    from microdrivers.devices.stage import Stage

    if not isinstance(device, Stage):
        return _ZOOM_OPTIONS
    turns = "theta" in device.axis_names
    return (*(_TARGET_OF[axis] for axis in device.axis_names), "speed_um_s", *["theta_speed_deg_s"] * turns)


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _axes(given: dict[str, float]) -> list[str]:
    return [axis for axis, option in _TARGET_OF.items() if option in given]


def _reference_emulated(rig: Rig, stage: Stage[Any], given: dict[str, float]) -> None:
    unknown = _to_reference(stage, given)
    if rig.starts_anew and unknown:
        click.echo(f"· referencing {', '.join(unknown)} of the emulated stage first", err=True)
        stage.reference(unknown)


def _move_zoom(motor: ZoomMotor, zoom: float, relative: bool) -> None:
    from microdrivers.routines.device_state import state_text

    sample = motor.move_to(zoom=zoom + (motor.read().zoom if relative else 0.0))
    click.echo(f"{motor.name}: {state_text(motor, sample)}")


def _move_stage(stage: Stage[Any], given: dict[str, float], relative: bool) -> None:
    from microdrivers.routines.device_state import state_text

    moving: Any = stage  # which keywords its own move takes has been checked
    if relative:
        pose = moving.move_by(**{name if "speed" in name else f"d{name}": value for name, value in given.items()})
    else:
        pose = moving.move_to(**given)
    here, goal = pose.position, pose.target
    misses = [f"{axis} {here[axis] - goal[axis]:+.3g} {stage.axes[axis].unit}" for axis in _axes(given)]
    click.echo(f"{stage.name}: {state_text(stage, pose)}; off target by {', '.join(misses)}")


def _retract(rig: Rig, stage: FineStage) -> None:
    """Take the tool away, and say how far that was; it is away if it stands at the end of its travel that way.

    Raises:
        NotReached: not the whole way that the rig file states.
    """
    from microdrivers.core.errors import NotReached
    from microdrivers.routines.device_state import state_text

    start = stage.read().position
    pose = stage.retract().wait()
    way = dict(zip(stage.axis_names, stage.retract_um or (), strict=True))
    asked_um = math.hypot(*way.values())
    moved_um = sum((pose.position[axis] - start[axis]) * length for axis, length in way.items()) / asked_um
    click.echo(f"{stage.name}: {state_text(stage, pose)}; taken away by {moved_um:.2f} µm of {asked_um:g} µm")
    if stage.retraction_at_end and rig.safety.trapped(stage) is None:
        click.echo(f"{stage.name}: already at the end of its way away: nothing to retract")
    elif stage.retraction_share < 1.0 and asked_um - moved_um > max(stage.axes[axis].tolerance for axis in way):
        raise NotReached(
            "the tool is not taken away as far as retract_um says: the travel ends, or a keep-out box begins",
            device=stage.name,
            moved="no" if stage.retraction_share == 0.0 else "yes",
            remedy="look whether the tool is clear; else move it away on another axis, or state a shorter retract_um",
        )


def _reference_command(choice: RigChoice, device: Stage[Any] | ZoomMotor, given: dict[str, float]) -> str:
    from microdrivers.devices.stage import Stage

    command = f"microdrivers reference {choice.file} --device {device.name}"
    if not isinstance(device, Stage):
        return command
    return f"{command} --axes {','.join(_to_reference(device, given))}"


def _to_reference(stage: Stage[Any], given: dict[str, float]) -> list[str]:
    """Axes that a move needs and whose reference is not known; a fine stage is referenced as a whole, z away first."""
    from microdrivers.devices.fine_stage import FineStage

    needed = stage.axis_names if isinstance(stage, FineStage) else _axes(given)
    return [axis for axis in stage.reference_order if axis in needed and not stage.referenced[axis]]
