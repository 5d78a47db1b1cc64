"""An open rig: all devices, one clock, one bus, and a certain end."""

from __future__ import annotations

import gc
import logging
import sys
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, TypeVar

from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock, SimulatedClock, SystemClock
from microdrivers.core.clock.interruption import INTERRUPTION
from microdrivers.core.errors import ConfigError, ConnectError, ErrorTree, MicrodriversError, UnsupportedError
from microdrivers.devices.base import Device
from microdrivers.recording.wire_log import WireLogWriter, describe_source
from microdrivers.rig.rig_file import RigDescription, load_rig_file
from microdrivers.rig.safety import Safety
from microdrivers.rig.sections import RigFile
from microdrivers.rig.simulation import Simulation

DeviceT = TypeVar("DeviceT", bound=Device[Any])

_log = logging.getLogger(__name__)


class Rig:
    """All devices of a rig file, as a context manager.

    Opening connects and identifies and moves nothing; leaving stops everything, in any case, and closes it. `safety`
    is what the rig file's safety section demands of every move.
    """

    def __init__(
        self, description: RigDescription, *, clock: Clock, bus: Bus, simulation: Simulation | None = None
    ) -> None:
        self.description = description
        self.clock = clock
        self.bus = bus
        self.simulation = simulation
        self.devices: dict[str, Device[Any]] = {}
        self._wire_logs: list[WireLogWriter] = []
        for name, entry in description.devices.items():
            if simulation is None:
                self.devices[name] = entry.driver.create(name, entry.settings, clock, bus)
            elif name in simulation.emulations:
                self.devices[name] = entry.driver.create(name, simulation.settings_of(name), clock, bus)
        self.safety = Safety(description.rig.safety, self.devices, clock=clock, bus=bus)

    @property
    def file(self) -> RigFile:
        """The rig file's own content."""
        return self.description.rig

    @property
    def fake(self) -> bool:
        """Whether the devices are emulated, or replayed from a wire log: nothing real moves."""
        return self.simulation is not None

    @property
    def starts_anew(self) -> bool:
        """Whether the devices are as after power-on: emulators are; hardware, and a replay of its log, need not be."""
        return self.simulation is not None and self.simulation.starts_anew

    def log_wires(self, file: Path) -> None:
        """Write what passes on all wires from now on to a new file, until the rig is closed.

        Raises:
            ConfigError: the file exists, or cannot be made.
        """
        seed = self.simulation.seed if self.simulation is not None else None
        header = describe_source(self.description.as_data(), source="fake" if self.starts_anew else "live", seed=seed)
        self._wire_logs.append(
            WireLogWriter(file, header, bus=self.bus, devices=self.devices, start_ns=self.clock.now_ns())
        )

    def device(self, name: str, kind: type[DeviceT]) -> DeviceT:
        """The device of that name, typed.

        Raises:
            UnsupportedError: there is none of that name, or it is of another kind.
        """
        device = self.devices.get(name)
        if not isinstance(device, kind):
            found = "missing" if device is None else f"a {type(device).__name__}"
            raise UnsupportedError(
                f"device {name!r} of rig {self.file.name!r} is {found}, not a {kind.__name__}",
                remedy=f"name one of {', '.join(self.devices)}",
            )
        return device

    def open(self) -> None:
        """Open all devices.

        In real time, all objects that there are by then are exempt from garbage collection until the rig is closed: to
        look through them halts every thread for some 60 ms, which is longer than a force guard waits for data.

        Raises:
            ConnectError: with every failure; what had been opened is closed again.
        """
        failures: list[MicrodriversError] = []
        for device in self.devices.values():
            try:
                device.open()
            except MicrodriversError as error:
                failures.append(error)
        if failures:
            self.close()
            raise ConnectError(f"{len(failures)} of {len(self.devices)} devices could not be opened:", failures)
        if not self.clock.simulated:
            gc.freeze()

    def stop(self, *, by: str = "user", reason: str = "") -> None:
        """Stop all motion of all devices now.

        Raises:
            ErrorTree: stop commands that could not be sent; all others were.
        """
        failures = []
        for device in self.devices.values():
            try:
                device.stop(by=by, reason=reason)
            except MicrodriversError as error:
                failures.append(error)
        if failures:
            raise ErrorTree("not every device could be told to stop:", failures, remedy="use the emergency stop")

    def close(self) -> None:
        """Stop everything, then close everything; whatever fails is logged and does not keep the rest from it.

        A tool that the force guard is taking away gets there first, except after Ctrl-C. One that comes meanwhile takes
        effect when all is closed; a second one at once.
        """
        try:
            if not isinstance(sys.exception(), KeyboardInterrupt):
                self.safety.finish()
        finally:
            with INTERRUPTION.held():
                self._stop_and_close()
        if sys.exception() is None:  # else it is being ended as it is
            INTERRUPTION.check()

    def _stop_and_close(self) -> None:
        self.safety.disarm()
        try:
            self.stop(by="rig", reason="closing")
        except ErrorTree as error:
            _log.error("%s", error)
        self.safety.close()
        for device in self.devices.values():
            try:
                device.close()
            except MicrodriversError as error:
                _log.error("%s", error)
        if self.simulation is not None:
            self.simulation.close()
        self.clock.close()
        if not self.clock.simulated:
            gc.unfreeze()
        for log in self._wire_logs:
            log.close()

    def __enter__(self) -> Rig:
        INTERRUPTION.rig_opened()
        try:
            self.open()
        except BaseException:
            try:
                self.close()
            finally:
                INTERRUPTION.rig_closed()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close()
        finally:
            INTERRUPTION.rig_closed()


def build_rig(
    file: Path,
    *,
    fake: bool = False,
    seed: int = 0,
    clock: Clock | None = None,
    world: Path | None = None,
    world_overrides: Mapping[str, Any] | None = None,
    devices: Collection[str] | Literal["microscope", "probe"] | None = None,
    wire_log: Path | None = None,
    wire_replay: Path | None = None,
) -> Rig:
    """Read a rig file and build its devices, closed. See `open_rig`."""
    if wire_replay is not None and (fake or world is not None or world_overrides):
        raise ConfigError(
            "wire_replay takes the place of a simulation", remedy="leave out fake, world and world_overrides"
        )
    description = load_rig_file(file)
    if devices is not None:
        parts = {"microscope": description.microscope_devices, "probe": description.probe_devices}
        description = description.restricted_to(parts[devices] if isinstance(devices, str) else devices)
    if clock is None:
        clock = SystemClock() if wire_replay is None else SimulatedClock()
    bus = Bus()
    simulation = None
    if fake or wire_replay is not None:
        simulation = Simulation(
            description, clock=clock, bus=bus, seed=seed, world_file=world, world_overrides=world_overrides,
            wire_log=wire_replay,
        )  # fmt: skip
    rig = Rig(description, clock=clock, bus=bus, simulation=simulation)
    if wire_log is not None:
        try:
            rig.log_wires(wire_log)
        except ConfigError:
            rig.close()
            raise
    return rig


@contextmanager
def open_rig(
    file: Path | str,
    *,
    fake: bool = False,
    seed: int = 0,
    clock: Clock | None = None,
    world: Path | None = None,
    world_overrides: Mapping[str, Any] | None = None,
    devices: Collection[str] | Literal["microscope", "probe"] | None = None,
    wire_log: Path | str | None = None,
    wire_replay: Path | str | None = None,
) -> Iterator[Rig]:
    """Open a rig; a context manager.

    Args:
        file: the rig file.
        fake: replace every connection by its emulator.
        seed: which simulated world to draw.
        clock: default is real time; give a `SimulatedClock` to let an emulated rig run as fast as the processor.
        world: a world file for the simulation.
        world_overrides: figures in place of the world file's, nested as there: {"specimen": {"preset": "single"}}.
        devices: open these alone, or those of the microscope or the probe; default: all of the file.
        wire_log: a new file to which everything is written that passes on serial lines and CAN
            buses. Images are not.
        wire_replay: a wire log that answers in place of the devices, on a simulated clock unless another one is
            given. Devices that it does not know, cameras for instance, are left out of the rig.

    Raises:
        ConfigError: the file is wrong. ConnectError: devices could not be opened, all failures at once.
    """
    log, replay = (Path(name) if name is not None else None for name in (wire_log, wire_replay))
    rig = build_rig(
        Path(file),
        fake=fake,
        seed=seed,
        clock=clock,
        world=world,
        world_overrides=world_overrides,
        devices=devices,
        wire_log=log,
        wire_replay=replay,
    )
    with rig:
        yield rig
