"""What the commands that work on a rig file share: its argument, and the options of emulation and of wire logs."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from microdrivers.cli.main import SERVED

if TYPE_CHECKING:
    from microdrivers.rig import Rig


WIRE_LOG_HELP = "Write the bytes to and from devices to FILE, which must not exist yet. Images and HTTP are not logged."


class RigChoice(NamedTuple):
    """A rig file, and whether it runs on hardware, on emulators or on a wire log. `seed` None is world 0."""

    file: Path
    fake: bool
    seed: int | None
    world: Path | None
    wire_log: Path | None = None
    wire_replay: Path | None = None

    def build(self, *, real_time: bool = False) -> Rig:
        """The rig with all devices closed: on the system clock, or simulated if it is emulated or replayed.

        With `real_time` emulators are on the system clock too.

        Raises:
            ConfigError: the rig file, the world file or the wire log is wrong, or options exclude each other.
        """
        from microdrivers.core.clock import SimulatedClock, SystemClock
        from microdrivers.core.errors import ConfigError
        from microdrivers.rig import build_rig

        if self.wire_replay is not None and (self.fake or self.seed is not None or self.world is not None):
            raise ConfigError(
                "--wire-replay takes the place of a simulation", remedy="leave out --fake, --seed and --world"
            )
        if not self.fake and (self.seed is not None or self.world is not None):
            raise ConfigError("--seed and --world describe a simulation", remedy="add --fake, or leave them out")
        live = not self.fake and self.wire_replay is None
        clock = SystemClock() if live or real_time else SimulatedClock()
        rig = build_rig(
            self.file, fake=self.fake, seed=self.seed or 0, clock=clock, world=self.world, wire_log=self.wire_log,
            wire_replay=self.wire_replay,
        )  # fmt: skip
        context = click.get_current_context(silent=True)
        if context is not None and live:
            context.meta[SERVED] = rig.file.emulated
        return rig


def rig_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the RIG argument and the common options; `command` gets them as one `RigChoice`, its first argument."""

    @click.argument("rig", type=click.Path(path_type=Path))
    @click.option("--fake", is_flag=True, help="Replace every connection of the rig file by its emulator.")
    @click.option("--seed", type=click.IntRange(min=0), help="Which simulated world to draw; default: 0.")
    @click.option("--world", type=click.Path(path_type=Path), help="World file of the simulation.")
    @click.option("--wire-log", type=click.Path(path_type=Path), metavar="FILE", help=WIRE_LOG_HELP)
    @click.option(
        "--wire-replay", type=click.Path(path_type=Path), metavar="FILE",
        help="Let the wire log FILE answer in place of the devices; those that it does not know are left out.",
    )  # fmt: skip
    @functools.wraps(command)
    def with_choice(
        *,
        rig: Path,
        fake: bool,
        seed: int | None,
        world: Path | None,
        wire_log: Path | None,
        wire_replay: Path | None,
        **others: Any,
    ) -> None:
        with saying_commands(rig):
            command(RigChoice(rig, fake, seed, world, wire_log, wire_replay), **others)

    return with_choice


@contextmanager
def saying_commands(file: Path) -> Iterator[None]:
    """Whatever fails inside says what to do in commands for the rig in that file."""
    from microdrivers.core.errors import MicrodriversError

    try:
        yield
    except MicrodriversError as error:
        from microdrivers.routines.commands import name_commands

        name_commands(error, file)
        raise


def find_device(rig: Rig, name: str, kinds: tuple[type[Any], ...], *, unsuitable: str) -> Any:
    """The device of that name, if it is of one of these kinds; `unsuitable` says what another one lacks.

    Raises:
        UnsupportedError: there is none; the remedy names those that there are.
    """
    from microdrivers.core.errors import UnsupportedError

    device = rig.devices.get(name)
    if isinstance(device, kinds):
        return device
    known = [other for other, each in rig.devices.items() if isinstance(each, kinds)]
    found = "is no device of this rig" if device is None else unsuitable
    raise UnsupportedError(f"{name!r} {found}", remedy=f"name one of {', '.join(known) or 'none: there is none'}")
