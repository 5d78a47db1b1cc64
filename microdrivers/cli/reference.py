"""`microdrivers reference`."""

from __future__ import annotations

from pathlib import Path

import click


@click.command(short_help="Find the reference of a stage's axes (moves!).")
@click.argument("rig", type=click.Path(path_type=Path))
@click.option("--axes", required=True, metavar="A,B,…", help="Axes in the order in which to reference them: x,y,theta.")
@click.option("--device", default=None, help="Which stage; default: the microscope's sample stage.")
@click.option("--fake", is_flag=True, help="Replace every connection by its emulator.")
@click.option("--yes", is_flag=True, help="Do not ask whether the way is free.")
def reference(rig: Path, axes: str, device: str | None, fake: bool, yes: bool) -> None:
    r"""Find the reference of a stage of the rig file RIG. THE STAGE MOVES to its reference switches.

    \b
    Example:
      microdrivers reference lab.yaml --axes x,y,theta
    """
    from microdrivers.core.clock import SimulatedClock, SystemClock
    from microdrivers.core.errors import ConfigError
    from microdrivers.devices.xytheta_stage import XYThetaStage
    from microdrivers.rig import open_rig

    names = [name.strip() for name in axes.split(",") if name.strip()]
    with open_rig(rig, fake=fake, clock=SimulatedClock() if fake else SystemClock()) as opened:
        section = opened.file.microscope
        if device is None and section is None:
            raise ConfigError("the rig file names no sample stage", file=str(rig), remedy="add --device NAME")
        stage = opened.device(device or (section.sample_stage if section else ""), XYThetaStage)
        if not (yes or fake):
            click.confirm(f"{stage.name} will move to its reference switches. Is the way free?", abort=True)
        stage.reference(names)
        pose = stage.read()
        click.echo(f"{stage.name}: {', '.join(names)} referenced; now at x {pose.x_um:.2f} µm, y {pose.y_um:.2f} µm, "
                   f"θ {pose.theta_deg:.5f}°")  # fmt: skip
