"""What the commands that work on a rig file share: its argument, --fake, --seed and --world."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

if TYPE_CHECKING:
    from microdrivers.rig import Rig


class RigChoice(NamedTuple):
    """A rig file, and whether it runs on hardware or on emulators. `seed` None is world 0."""

    file: Path
    fake: bool
    seed: int | None
    world: Path | None

    def build(self) -> Rig:
        """The rig with all devices closed: on the system clock, or simulated if it is emulated.

        Raises:
            ConfigError: the rig file or the world file is wrong, or a world was asked for without --fake.
        """
        from microdrivers.core.clock import SimulatedClock, SystemClock
        from microdrivers.core.errors import ConfigError
        from microdrivers.rig import build_rig

        if not self.fake and (self.seed is not None or self.world is not None):
            raise ConfigError("--seed and --world describe a simulation", remedy="add --fake, or leave them out")
        clock = SimulatedClock() if self.fake else SystemClock()
        return build_rig(self.file, fake=self.fake, seed=self.seed or 0, clock=clock, world=self.world)


def rig_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the RIG argument and the options of emulation; `command` gets them as one `RigChoice`, its first argument."""

    @click.argument("rig", type=click.Path(path_type=Path))
    @click.option("--fake", is_flag=True, help="Replace every connection of the rig file by its emulator.")
    @click.option("--seed", type=click.IntRange(min=0), help="Which simulated world to draw; default: 0.")
    @click.option("--world", type=click.Path(path_type=Path), help="World file of the simulation.")
    @functools.wraps(command)
    def with_choice(*, rig: Path, fake: bool, seed: int | None, world: Path | None, **others: Any) -> None:
        command(RigChoice(rig, fake, seed, world), **others)

    return with_choice
