"""`microdrivers serve`."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from microdrivers.cli.rig_options import WIRE_LOG_HELP

if TYPE_CHECKING:
    from microdrivers.rig.serving import ServedRig

_LONGEST_S = 1e9
_SWITCH_S = 0.0005
"""How long a thread may compute while others wait for their turn: Python's 5 ms, times all that draw pictures, are
longer than a bus may stand still."""
_ADAPTER = "slcan"
_HEADER = ("device", "where other programs reach it")


def _finite(_context: click.Context, _parameter: click.Parameter, value: float | None) -> float | None:
    if value is not None and not math.isfinite(value):
        raise click.BadParameter(f"{value:g} is no number of seconds")
    return value


@click.command(short_help="Put every emulator of a rig on a port for other programs.")
@click.argument("rig", type=click.Path(path_type=Path))
@click.option(
    "--transport", type=click.Choice(["pty", "tcp"]), default="pty", show_default=True, help="Of serial lines."
)
@click.option("--bind", default="127.0.0.1", show_default=True, help="Address for TCP and HTTP; the default is local.")
@click.option(
    "--can",
    "can_interface",
    metavar="NAME",
    help="SocketCAN interface for CAN, as vcan0; default: slcan, a serial adapter.",
)
@click.option(
    "--write",
    "served",
    type=click.Path(path_type=Path),
    help="Write a rig file that points at the endpoints; only one that serve wrote is overwritten.",
)
@click.option(
    "--for", "duration_s", type=click.FloatRange(0, _LONGEST_S), callback=_finite, metavar="SECONDS",
    help="End after so many seconds; default: at Ctrl-C.",
)  # fmt: skip
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Which simulated world to draw.")
@click.option("--world", type=click.Path(path_type=Path), help="World file of the simulation.")
@click.option(
    "--wire-log", type=click.Path(path_type=Path), metavar="FILE", help=f"{WIRE_LOG_HELP} As the emulators see it."
)
@click.option("--json", "as_json", is_flag=True, help="Print the endpoints as JSON.")
def serve(
    rig: Path,
    transport: Literal["pty", "tcp"],
    bind: str,
    can_interface: str | None,
    served: Path | None,
    duration_s: float | None,
    seed: int,
    world: Path | None,
    wire_log: Path | None,
    as_json: bool,
) -> None:
    """Emulate the rig file RIG in real time and let other programs use it.

    Serial devices appear on pseudo-terminals or TCP ports, CAN buses behind a serial adapter (slcan) or on a SocketCAN
    interface, cameras as HTTP streams. Other machines are not let in unless --bind says so. A serial adapter belongs to
    one program at a time, with all devices on its bus; a SocketCAN interface is shared.

    \b
    Examples:
      microdrivers serve lab.yaml --write served.yaml
      microdrivers calibrate optics --rig served.yaml      in another terminal
    """
    from microdrivers.rig import load_rig_file
    from microdrivers.rig.serving import ServedRig, check_writable

    description = load_rig_file(rig)
    if served is not None:
        check_writable(served, description)
    with (
        _quick_turns(),
        ServedRig(
            description,
            seed=seed,
            world=world,
            transport=transport,
            bind=bind,
            can_interface=None if can_interface == _ADAPTER else can_interface,
            wire_log=wire_log,
        ) as running,
    ):
        try:
            if served is not None:
                running.write(served)
            _announce(running, served, duration_s, as_json)
            if duration_s is not None:
                running.clock.sleep(duration_s)
            while duration_s is None:
                running.clock.sleep(3600.0)
        except KeyboardInterrupt:
            click.echo("stopped", err=True)


@contextmanager
def _quick_turns() -> Iterator[None]:
    usual_s = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(usual_s)


def _announce(running: ServedRig, served: Path | None, duration_s: float | None, as_json: bool) -> None:
    where = {name: endpoint.where for name, endpoint in running.endpoints.items()}
    if as_json:
        click.echo(json.dumps(where))
        return
    width = max(map(len, (_HEADER[0], *where)))
    click.echo(f"{_HEADER[0]:<{width}}  {_HEADER[1]}")
    for name, place in where.items():
        click.echo(f"{name:<{width}}  {place}")
    for line in _adapters(running):
        click.echo(line)
    if served is not None:
        click.echo(f"rig file: {served}")
    click.echo("serving; Ctrl-C ends it" if duration_s is None else f"serving for {duration_s:g} s")


def _adapters(running: ServedRig) -> list[str]:
    """How other programs reach the CAN buses behind serial adapters, a line for each."""
    users: dict[str, list[str]] = {}
    bitrates: dict[str, int] = {}
    for name, endpoint in running.endpoints.items():
        connection = endpoint.overrides.get("connection", {})
        if connection.get("interface") == _ADAPTER:
            users.setdefault(connection["channel"], []).append(name)
            bitrates[connection["channel"]] = connection["bitrate"]
    return [
        f"{channel} is a serial CAN adapter: one program at a time has it, with all devices on its bus "
        f"({', '.join(names)}); it connects with a rig file from --write, or with "
        f"can.Bus(interface={_ADAPTER!r}, channel={channel!r}, bitrate={bitrates[channel]})"
        for channel, names in users.items()
    ]
