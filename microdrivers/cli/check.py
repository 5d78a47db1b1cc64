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
    from microdrivers.devices.fine_stage import FineStage
    from microdrivers.rig import load_rig_file
    from microdrivers.rig.registry import find_emulator
    from microdrivers.rig.safety_checks import unguarded

    description = load_rig_file(rig)
    click.echo(f"{rig}: rig {description.rig.name!r} is valid")
    width = max(map(len, description.devices))
    for name, entry in description.devices.items():
        fake = "" if find_emulator(entry.driver_name) else "   (no emulator: --fake will refuse)"
        click.echo(f"  {name:<{width}}  {entry.driver.kind.__name__:<13} {entry.driver_name}{fake}")
    for sensor, stage in unguarded(description.rig.safety, description.devices).items():
        click.echo(f"no force guard watches {sensor}: nothing stops {stage} if it presses too hard")
    if not description.rig.safety.keep_out and any(
        issubclass(entry.driver.kind, FineStage) for entry in description.devices.values()
    ):
        click.echo("no keep_out box limits where tools may go")
