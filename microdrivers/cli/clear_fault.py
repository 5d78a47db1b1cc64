"""`microdrivers clear-fault`."""

from __future__ import annotations

from contextlib import closing
from typing import TYPE_CHECKING, Any

import click

from microdrivers.cli.rig_options import RigChoice, find_device, rig_options

if TYPE_CHECKING:
    from microdrivers.core.errors import DeviceFault
    from microdrivers.core.samples import Sample
    from microdrivers.devices.base import Device


@click.command(short_help="Clear a device's fault once its cause is removed.")
@rig_options
@click.argument("device")
@click.option("--yes", is_flag=True, help="Do not ask whether the cause is removed and the way is free.")
def clear_fault(choice: RigChoice, device: str, yes: bool) -> None:
    """Show the fault of DEVICE in the rig file RIG, clear it, and show the device's state.

    Asks first, unless the rig is emulated: a device without its fault can move again. Only that device is opened.

    \b
    Examples:
      microdrivers clear-fault lab.yaml zoom
      microdrivers clear-fault lab.yaml sample_stage --yes
    """
    from microdrivers.devices.force_sensor import ForceSensor
    from microdrivers.devices.stage import Stage
    from microdrivers.devices.zoom_motor import ZoomMotor
    from microdrivers.routines.commands import as_commands
    from microdrivers.routines.device_state import state_text

    with closing(choice.build()) as rig:
        found = find_device(
            rig, device, (Stage, ZoomMotor, ForceSensor), unsuitable="is a camera and has no fault to clear"
        )
        found.open()
        sample, fault = _look(found)
        if fault is None:
            click.echo(f"{found.name}: no fault is known, nothing was cleared; {state_text(found, sample)}")
            return
        click.echo(f"{found.name}: {click.style('FAULT', fg='red', bold=True)}: {fault.what}")
        if fault.remedy:
            click.echo(f"  to do: {as_commands(fault.remedy, choice.file, found.name)}")
        if not (yes or rig.fake or rig.file.emulated):
            click.confirm("Is its cause removed, and is the way free?", abort=True, err=True)
        found.clear_fault()
        click.echo(f"{found.name}: fault cleared; now at {state_text(found, found.read())}")


def _look(device: Device[Any]) -> tuple[Sample | None, DeviceFault | None]:
    """What the device reads, and its fault."""
    from microdrivers.core.errors import DeviceFault

    try:
        sample: Sample | None = device.read()
    except DeviceFault as fault:
        return None, fault
    return sample, device.fault
