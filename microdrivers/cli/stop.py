"""`microdrivers stop`."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from microdrivers.cli.exit_codes import EXIT_ERROR
from microdrivers.cli.rig_options import RigChoice, rig_options

if TYPE_CHECKING:
    from pathlib import Path

    from microdrivers.core.errors import ConfigError, MicrodriversError
    from microdrivers.devices.base import Device
    from microdrivers.rig import Rig


class _Told(NamedTuple):
    """What became of one device: whether the stop was sent, and what went wrong before it or after."""

    device: Device[Any]
    sent: bool
    error: MicrodriversError | None


@click.command(short_help="Stop everything that moves, now.")
@rig_options
def stop(choice: RigChoice) -> None:
    """Tell every device of the rig file RIG that can move to stop, each as soon as it can be reached.

    All are reached for at once; none waits for another. What was told to stop is then watched until it stands still.
    Exit status 0 if everything was reached and stands still, else 1: use the emergency stop then.

    A serial port belongs to one program at a time. If another program moves the rig, interrupt THAT program (Ctrl-C,
    or kill -TERM with its process id): every microdrivers command stops the rig when it is interrupted.

    \b
    Example:
      microdrivers stop lab.yaml
    """
    from microdrivers.cli.standstill import watch_standstill
    from microdrivers.devices.camera import Camera
    from microdrivers.devices.force_sensor import ForceSensor

    with closing(choice._replace(wire_log=None).build()) as rig:
        not_logged = _log_wires(rig, choice.wire_log)
        moving = [device for device in rig.devices.values() if not isinstance(device, Camera | ForceSensor)]
        told = _tell_all(rig, moving)
        width = max(map(len, rig.devices))
        failed = False
        for device, sent, error in told:
            text, bad = watch_standstill(device, choice.file) if error is None else (_failed(sent, error), True)
            failed |= bad
            click.echo(f"{device.name:<{width}}  {text}")
    if failed:
        click.echo("not everything is known to stand still: use the emergency stop", err=True)
    if not_logged is not None:
        click.echo(f"there is no wire log of this: {not_logged}", err=True)
    if failed or not_logged is not None:
        sys.exit(EXIT_ERROR)


def _log_wires(rig: Rig, file: Path | None) -> ConfigError | None:
    """Log to that file if one is wanted; why that cannot be must not keep anybody from stopping."""
    from microdrivers.core.errors import ConfigError

    try:
        if file is not None:
            rig.log_wires(file)
    except ConfigError as error:
        return error
    return None


def _tell_all(rig: Rig, devices: list[Device[Any]]) -> list[_Told]:
    """Reach for all at once; a simulated clock allows only one after the other."""
    if rig.clock.simulated or not devices:
        return [_tell(device) for device in devices]
    with ThreadPoolExecutor(len(devices), thread_name_prefix="stop") as pool:
        return list(pool.map(_tell, devices))


def _tell(device: Device[Any]) -> _Told:
    from microdrivers.core.errors import MicrodriversError

    sent = False
    try:
        device.connect()
        device.stop(by="user", reason="microdrivers stop")  # before anything is asked: whoever listens must stop
        sent = True
        device.open()
    except MicrodriversError as error:
        return _Told(device, sent, error)
    return _Told(device, sent, None)


def _failed(sent: bool, error: MicrodriversError) -> str:
    from microdrivers.core.errors import LinkLost

    outcome = "NOT REACHED"
    if sent:
        # A TCP port in use takes a second connection, and what is sent there, and hangs up.
        hung_up = isinstance(error, LinkLost)
        outcome = "PROBABLY NOT REACHED" if hung_up else "told to stop, but WHO LISTENS IS NOT KNOWN"
    first = "    to do: another program may hold the port, interrupt that program"
    remedy = f"; else {error.remedy}" if error.remedy else ""
    return f"{click.style(outcome, fg='red', bold=True)}: {error.what}\n{first}{remedy}"
