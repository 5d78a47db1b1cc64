"""`microdrivers check`."""

from __future__ import annotations

from pathlib import Path

import click


@click.command(short_help="Validate a rig file without touching hardware.")
@click.argument("rig", type=click.Path(path_type=Path))
def check(rig: Path) -> None:
    """Validate the rig file RIG completely, without touching hardware.

    Every mistake is listed with file, line, column and what to do. Exit status 0 if there is none.

    \b
    Example:
      microdrivers check lab.yaml
    """
    from microdrivers.rig import load_rig_file
    from microdrivers.rig.registry import find_emulator

    description = load_rig_file(rig)
    click.echo(f"{rig}: rig {description.rig.name!r} is valid")
    width = max(map(len, description.devices))
    for name, entry in description.devices.items():
        fake = "" if find_emulator(entry.driver_name) else "   (no emulator: --fake will refuse)"
        click.echo(f"  {name:<{width}}  {entry.driver.kind.__name__:<13} {entry.driver_name}{fake}")
