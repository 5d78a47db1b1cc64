"""`microdrivers move`."""

from __future__ import annotations

from contextlib import closing
from typing import TYPE_CHECKING

import click

from microdrivers.cli.rig_options import RigChoice, rig_options

if TYPE_CHECKING:
    from microdrivers.devices.xytheta_stage import XYThetaStage
    from microdrivers.devices.zoom_motor import ZoomMotor
    from microdrivers.rig import Rig

_STAGE_OPTIONS = ("x_um", "y_um", "theta_deg", "speed_um_s", "theta_speed_deg_s")
_ZOOM_OPTIONS = ("zoom",)


@click.command(short_help="Move a stage or the zoom, and wait until settled.")
@rig_options
@click.argument("device")
@click.option("--x-um", type=float, help="Target (with --by: distance) on x, µm.")
@click.option("--y-um", type=float, help="Target (with --by: distance) on y, µm.")
@click.option("--theta-deg", type=float, help="Target (with --by: angle) on θ, degrees.")
@click.option("--zoom", type=float, help="Zoom to set (with --by: to add).")
@click.option("--by", "relative", is_flag=True, help="Move by these amounts, counted from where the device is.")
@click.option("--speed-um-s", type=float, help="Path speed in the xy plane; default: as fast as the axes allow.")
@click.option("--theta-speed-deg-s", type=float, help="Speed of θ; default: as fast as the axis allows.")
def move(choice: RigChoice, device: str, relative: bool, **options: float | None) -> None:
    r"""Move DEVICE of the rig file RIG, wait until it has settled and print where it was observed to be.

    The move is checked before anything moves: finite, inside the limits, axes referenced, speed possible; nothing is
    clipped. Ctrl-C stops the device. A failed move is stopped and never repeated. Only DEVICE is opened. An emulated
    device (--fake) starts anew with each command, so its axes are referenced first.

    \b
    Examples:
      microdrivers move lab.yaml sample_stage --x-um 7600 --y-um 7450 --speed-um-s 500
      microdrivers move lab.yaml sample_stage --by --x-um -20
      microdrivers move lab.yaml sample_stage --theta-deg 0.5
      microdrivers move lab.yaml zoom --zoom 1.2
    """
    from microdrivers.core.errors import NotReferenced
    from microdrivers.devices.zoom_motor import ZoomMotor
    from microdrivers.routines.device_state import state_text

    given = {name: value for name, value in options.items() if value is not None}
    with closing(choice.build()) as rig:
        stage_or_zoom = _find(rig, device)
        _check_options(stage_or_zoom, given)
        stage_or_zoom.open()
        try:
            if isinstance(stage_or_zoom, ZoomMotor):
                zoom = given["zoom"] + (stage_or_zoom.read().zoom if relative else 0.0)
                click.echo(f"{device}: {state_text(stage_or_zoom, stage_or_zoom.move_to(zoom=zoom))}")
            else:
                _reference_emulated(rig, stage_or_zoom, given)
                click.echo(f"{device}: {_move_stage(stage_or_zoom, given, relative)}")
        except NotReferenced as error:
            error.remedy = f"make sure that the way is free, then: {_reference_command(choice, stage_or_zoom, given)}"
            raise


def _find(rig: Rig, name: str) -> XYThetaStage | ZoomMotor:
    from microdrivers.core.errors import UnsupportedError
    from microdrivers.devices.xytheta_stage import XYThetaStage
    from microdrivers.devices.zoom_motor import ZoomMotor

    device = rig.devices.get(name)
    if isinstance(device, XYThetaStage | ZoomMotor):
        return device
    movable = [known for known, each in rig.devices.items() if isinstance(each, XYThetaStage | ZoomMotor)]
    found = "is no device of this rig" if device is None else "cannot move"
    raise UnsupportedError(f"{name!r} {found}", remedy=f"name one of {', '.join(movable) or 'none: nothing can move'}")


def _check_options(device: XYThetaStage | ZoomMotor, given: dict[str, float]) -> None:
    """Refuse options that are not the device's, or that name no target, before anything is opened."""
    from microdrivers.core.errors import OutOfRange, UnsupportedError
    from microdrivers.devices.xytheta_stage import XYThetaStage

    known = _STAGE_OPTIONS if isinstance(device, XYThetaStage) else _ZOOM_OPTIONS
    foreign = [_option(name) for name in given if name not in known]
    targets = [_option(name) for name in known if "speed" not in name]
    if foreign:
        raise UnsupportedError(
            f"{', '.join(foreign)} cannot be used here", device=device.name, remedy=f"give {', '.join(targets)}"
        )
    if not any(_option(name) in targets for name in given):
        raise OutOfRange("a move needs a target", device=device.name, remedy=f"give {', '.join(targets)}")


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _axes(given: dict[str, float]) -> list[str]:
    option_of = {"x": "x_um", "y": "y_um", "theta": "theta_deg"}
    return [axis for axis, option in option_of.items() if option in given]


def _reference_emulated(rig: Rig, stage: XYThetaStage, given: dict[str, float]) -> None:
    unknown = [axis for axis in _axes(given) if not stage.referenced[axis]]
    if rig.starts_anew and unknown:
        click.echo(f"· referencing {', '.join(unknown)} of the emulated stage first", err=True)
        stage.reference(unknown)


def _move_stage(stage: XYThetaStage, given: dict[str, float], relative: bool) -> str:
    from microdrivers.routines.device_state import state_text

    if relative:
        pose = stage.move_by(**{name if "speed" in name else f"d{name}": value for name, value in given.items()})
    else:
        pose = stage.move_to(**given)
    here, goal = pose.position, pose.target
    misses = [f"{axis} {here[axis] - goal[axis]:+.3g} {stage.axes[axis].unit}" for axis in _axes(given)]
    return f"{state_text(stage, pose)}; off target by {', '.join(misses)}"


def _reference_command(choice: RigChoice, device: XYThetaStage | ZoomMotor, given: dict[str, float]) -> str:
    from microdrivers.devices.xytheta_stage import XYThetaStage

    command = f"microdrivers reference {choice.file} --device {device.name}"
    if not isinstance(device, XYThetaStage):
        return command
    unknown = [axis for axis in _axes(given) if not device.referenced[axis]]
    return f"{command} --axes {','.join(unknown)}"
