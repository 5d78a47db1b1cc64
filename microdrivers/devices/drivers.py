"""How drivers, emulators and worlds announce themselves.

Three entry-point groups: `microdrivers.drivers` (a `Driver` by name), `microdrivers.emulators` (an `Emulator` under
the same name as the driver that it is the other end of) and `microdrivers.worlds` (a `WorldType` by name). The
framework names none of them; a third party's package adds its own. See docs/decisions/0005.
"""

from __future__ import annotations

import re
import socket
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Literal, Protocol, TypeVar, runtime_checkable

import pydantic

from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.devices.base import Device
from microdrivers.devices.wire_tap import WireTap


class DeviceSettings(pydantic.BaseModel):
    """Base of a driver's settings in the rig file: unknown keys are refused, values are not converted silently.

    A validator's `ValueError` is shown with its place in the file. It may begin with the key that it is about, and end
    with what to do: `travel_um runs backwards; write [lowest, highest]`.
    """

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    def claims(self) -> tuple[str, ...]:
        """What a device needs for itself alone, in words: a port, a node on a bus. A rig gives each to one device."""
        return ()

    def shares(self) -> Mapping[str, Mapping[str, object]]:
        """What a device uses together with others, in words: settings, by key, that all of them must state alike."""
        return {}


def spelled(pattern: str, words: str) -> pydantic.AfterValidator:
    """A check of text against a regular expression, with what to say if it does not match."""

    def check(text: str) -> str:
        if re.search(pattern, text) is None:
            raise ValueError(words)
        return text

    return pydantic.AfterValidator(check)


SettingsT = TypeVar("SettingsT", bound=DeviceSettings)


@dataclass(frozen=True)
class Driver(Generic[SettingsT]):
    """One real device type.

    Attributes:
        kind: the interface that the device implements.
        settings: model of its part of the rig file.
        create: builds the device, closed, from its name, its settings, the clock and the bus.
    """

    kind: type[Device[Any]]
    settings: type[SettingsT]
    create: Callable[[str, SettingsT, Clock, Bus], Device[Any]]


class World(Protocol):
    """The physical world that the emulators of a rig share."""

    def close(self) -> None:
        """Release what the world holds."""


@runtime_checkable
class WorldWithEmulators(World, Protocol):
    """A world that brings its own emulators instead of the drivers': a replay.

    Attributes:
        emulators: by the device's name; devices that are not among them are left out of the rig.
        starts_anew: whether its devices are as after power-on whenever the rig is built.
    """

    emulators: Mapping[str, Emulator]
    starts_anew: bool


@dataclass(frozen=True)
class WorldRequest(Generic[SettingsT]):
    """What a world is built from: the world file's settings, the whole rig file as plain data, and a seed."""

    settings: SettingsT
    rig: Mapping[str, Any]
    seed: int
    clock: Clock
    bus: Bus


@dataclass(frozen=True)
class WorldType(Generic[SettingsT]):
    """One kind of simulated world, with the model of its file's settings."""

    settings: type[SettingsT]
    build: Callable[[WorldRequest[SettingsT]], World]


@dataclass(frozen=True)
class EmulationRequest:
    """What an emulator is built from.

    Attributes:
        name: the device's name in the rig file.
        settings: the device's validated settings as plain data.
        world: what the emulators share.
        seed: of the emulator's own draws (delays, fragments, noise).
    """

    name: str
    settings: Mapping[str, Any]
    world: World
    seed: int
    clock: Clock
    bus: Bus


@dataclass(frozen=True)
class ServeRequest:
    """Where an emulator is to be put, for other programs to use.

    Attributes:
        transport: of serial lines: pseudo-terminals or TCP ports. Cameras are served over HTTP in either case.
        bind: address for TCP and HTTP.
        folder: where stable names of pseudo-terminals are made.
        tap: is told what passes on a serial line, if somebody wants to know; `of_bus` gives that of a CAN bus.
        can: of CAN buses: a serial adapter on a `transport` of its own, or an existing SocketCAN interface.
        can_channel: that interface's name.
    """

    transport: Literal["pty", "tcp"]
    bind: str
    folder: Path
    tap: WireTap | None = None
    can: Literal["slcan", "socketcan"] = "slcan"
    can_channel: str = "vcan0"

    @property
    def host(self) -> str:
        """The name or address by which a port bound to `bind` is reached; a wildcard is none, so this machine's own."""
        if self.bind not in ("", "0.0.0.0", "::"):
            return self.bind
        name = socket.gethostname()
        try:
            socket.getaddrinfo(name, None)
        except OSError:
            return _own_address()
        return name


def _own_address() -> str:
    """The address from which this machine would speak to others; nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # reserved for documentation (RFC 5737)
        except OSError:
            return "127.0.0.1"
        address: str = probe.getsockname()[0]
        return address


@dataclass(frozen=True)
class Endpoint:
    """A port on which an emulator is served.

    Attributes:
        overrides: merged over the device's settings, so that a driver in another process connects to it.
        where: the port's name, for people.
        close: ends serving.
        control: what a test may pull and put back, if the port can.
    """

    overrides: Mapping[str, Any]
    where: str
    close: Callable[[], None]
    control: object = None


@dataclass(frozen=True)
class Emulation:
    """A running emulator.

    Attributes:
        overrides: merged over the device's settings, so that the driver connects to the emulator.
        close: ends the emulator.
        wire_log: what passed on the wire of late, as (t_ns, "host" | "device", bytes), if the device has one. It
            grows at one end and may shrink at the other: take `list(wire_log)` while the device is in use.
        serve: puts the emulator on an operating-system port, if it can.
    """

    overrides: Mapping[str, Any]
    close: Callable[[], None]
    wire_log: Collection[tuple[int, str, bytes]] = field(default_factory=list)
    serve: Callable[[ServeRequest], Endpoint] | None = None


@dataclass(frozen=True)
class Emulator:
    """The other end of a driver's wire."""

    attach: Callable[[EmulationRequest], Emulation]
