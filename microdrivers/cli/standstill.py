"""What is seen of devices that were told to stop."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from microdrivers.core.errors import MicrodriversError
from microdrivers.core.units import seconds_to_ns
from microdrivers.devices.base import Device
from microdrivers.routines.commands import as_commands
from microdrivers.routines.device_state import state_text

_STANDSTILL_S = 2.0
_POLL_S = 0.05


def watch_standstill(device: Device[Any], file: Path) -> tuple[str, bool]:
    """What is seen of a device that was told to stop, and whether that is bad: it moves still, or nobody knows.

    Args:
        device: open.
        file: the rig file, for commands that help.
    """
    deadline_ns = device.clock.now_ns() + seconds_to_ns(_STANDSTILL_S)
    try:
        sample = device.read()
        while getattr(sample, "moving", False) and device.clock.now_ns() < deadline_ns:
            device.clock.sleep(_POLL_S)
            sample = device.read()
    except MicrodriversError as error:
        what, bad = f"told to stop; whether it stands still is not known: {error.what}", True
    else:
        bad = bool(getattr(sample, "moving", False))
        but = f", but {click.style('STILL MOVING', fg='red', bold=True)}" if bad else ""
        what = f"told to stop{but}: {state_text(device, sample)}"
    return what + _fault_text(device, file), bad


@contextmanager
def says_where_it_stopped(device: Device[Any], file: Path) -> Iterator[None]:
    """On Ctrl-C: stop the device at once, watch it stand still, and say where."""
    try:
        yield
    except KeyboardInterrupt:
        device.stop(by="user", reason="interrupted")
        click.echo(f"\n{device.name}: {watch_standstill(device, file)[0]}", err=True)
        raise


def _fault_text(device: Device[Any], file: Path) -> str:
    if device.fault is None:
        return ""
    to_do = as_commands(device.fault.remedy, file, device.name)
    fault = f"; {click.style('FAULT', fg='red', bold=True)}: {device.fault.what}"
    return f"{fault}\n    to do: {to_do}" if to_do else fault
