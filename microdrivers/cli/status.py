"""`microdrivers status`."""

from __future__ import annotations

import sys
from contextlib import closing
from typing import TYPE_CHECKING, Any

import click

from microdrivers.cli.exit_codes import EXIT_ERROR
from microdrivers.cli.rig_options import RigChoice, rig_options

if TYPE_CHECKING:
    from pathlib import Path

    from microdrivers.devices.base import Device


@click.command(short_help="Who answers, and in which state; nothing moves.")
@rig_options
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of lines.")
def status(choice: RigChoice, as_json: bool) -> None:
    """Show each device of the rig file RIG: identification, link and state. Nothing moves.

    A device that cannot be opened is shown with its error, and so are all others. Exit status 0 if every device
    answers, else 1. Emulated devices (--fake) are as they are right after power-on.

    \b
    Examples:
      microdrivers status lab.yaml
      microdrivers status lab.yaml --json
      microdrivers status lab.yaml --fake
    """
    import msgspec

    with closing(choice.build()) as rig:
        found = {name: _ask(device, choice.file) for name, device in rig.devices.items()}
        if as_json:
            fake = rig.fake or rig.file.emulated
            document = {"rig": rig.file.name, "file": str(choice.file), "fake": fake, "devices": found}
            click.echo(msgspec.json.format(msgspec.json.encode(document), indent=2).decode())
        else:
            width = max(map(len, found))
            for name, entry in found.items():
                click.echo(f"{name:<{width}}  {_line(entry)}")
    if any(entry["error"] for entry in found.values()):
        sys.exit(EXIT_ERROR)


def _ask(device: Device[Any], file: Path) -> dict[str, Any]:
    """What the device says of itself; `error` is None if it answered."""
    import msgspec

    from microdrivers.core.errors import MicrodriversError
    from microdrivers.devices.camera import Camera
    from microdrivers.routines.commands import as_commands
    from microdrivers.routines.device_state import identity_text, state_data, state_text

    entry: dict[str, Any] = {
        "identity": None, "info": None, "link": "closed", "state": None, "text": "", "fault": None, "fault_remedy": "",
        "error": None,
    }  # fmt: skip
    try:
        device.open()
        entry |= {"identity": identity_text(device.info), "info": msgspec.structs.asdict(device.info)}
        sample = None if isinstance(device, Camera) else device.read()
        entry |= {"state": state_data(device, sample), "text": state_text(device, sample)}
    except MicrodriversError as error:
        remedy = as_commands(error.remedy, file, device.name)
        entry["error"] = {"kind": type(error).__name__, "what": error.what, "remedy": remedy}
    entry["link"] = device.link
    if device.fault is not None:
        remedy = as_commands(device.fault.remedy, file, device.name)
        entry |= {"fault": device.fault.what, "fault_remedy": remedy}
    return entry


def _line(entry: dict[str, Any]) -> str:
    error, fault = entry["error"], entry["fault"]
    who = f"{entry['identity']} | " if entry["identity"] else ""
    if error is not None:
        remedy = f" (to do: {error['remedy']})" if error["remedy"] else ""
        return f"{who}link {entry['link']} | {click.style('ERROR', fg='red', bold=True)}: {error['what']}{remedy}"
    remedy = f" (to do: {entry['fault_remedy']})" if entry["fault_remedy"] else ""
    failure = f" | {click.style('FAULT', fg='red', bold=True)}: {fault}{remedy}" if fault else ""
    return f"{who}link {entry['link']} | {entry['text']}{failure}"
