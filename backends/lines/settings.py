"""Settings of serial ports and CAN buses, as they stand in a rig file."""

from __future__ import annotations

import difflib
import importlib
import inspect
import math
from collections.abc import Collection, Mapping
from typing import Any, Literal

import pydantic

from microdrivers.devices.drivers import DeviceSettings


class SerialConnection(DeviceSettings):
    """A serial port.

    `port` is a device path (/dev/ttyUSB0, better /dev/serial/by-id/…), COM3, or a pyserial URL. `timeout_s` is how
    long a reply may take beyond the time that its bytes need on the line.
    """

    port: str = pydantic.Field(min_length=1)
    baudrate: Literal[9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600] = 115200
    parity: Literal["N", "E", "O"] = "N"
    stopbits: Literal[1, 2] = 1
    timeout_s: float = pydantic.Field(default=0.5, gt=0, le=30)

    @property
    def bits_per_byte(self) -> int:
        """Start, data, parity and stop bits of one byte on the line."""
        return 9 + self.stopbits + (self.parity != "N")


class CanConnection(DeviceSettings):
    """A CAN bus. Devices of a rig with the same interface and channel share it.

    `interface` and `channel` are python-can's (socketcan and can0, slcan and /dev/ttyACM0 …), and so are the `options`
    (fd, tty_baudrate …). A SocketCAN interface has its bit rate from the operating system; `bitrate` must say the same.
    `timeout_s` is how long a device may take to answer. `arrival_uncertainty_ms` is how late a frame may be handed over
    by an interface that does not stamp it; FTDI chips hold it back for up to 16 ms unless their latency timer is set.
    """

    interface: str = pydantic.Field(min_length=1)
    channel: str = pydantic.Field(min_length=1)
    bitrate: Literal[10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000] = 500_000
    timeout_s: float = pydantic.Field(default=0.3, gt=0, le=30)
    arrival_uncertainty_ms: float = pydantic.Field(default=1.0, gt=0, le=100)
    options: dict[str, bool | int | float | str] = pydantic.Field(default_factory=dict)

    @pydantic.model_validator(mode="before")
    @classmethod
    def _options_in_their_place(cls, section: Any) -> Any:
        for key in section if isinstance(section, dict) else ():
            if key not in cls.model_fields and not difflib.get_close_matches(key, cls.model_fields, n=1):
                raise ValueError(
                    f"{key} is no key of a CAN connection; if it is an option of python-can's interface, write "
                    f"options: {{{key}: …}}"
                )
        return section

    @pydantic.field_validator("interface")
    @classmethod
    def _known_to_python_can(cls, interface: str) -> str:
        known = _interfaces()
        if known and interface not in known:
            close = difflib.get_close_matches(interface, known, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"it knows {', '.join(sorted(known))}"
            raise ValueError(
                f"python-can knows no interface {interface!r}; {hint} (what else there is comes with a plug-in: "
                "install it)"
            )
        return interface

    @pydantic.field_validator("options", mode="before")
    @classmethod
    def _plain(cls, options: Any) -> Any:
        for key, value in options.items() if isinstance(options, dict) else ():
            if key in cls.model_fields:
                raise ValueError(f"options.{key} is not python-can's affair; write it beside options, not in it")
            if key == "fd" and not isinstance(value, bool):
                raise ValueError(f"options.fd is {value!r}; write true for CAN FD or false for classic CAN")
            if not isinstance(value, bool | int | float | str) or value != value or value in (math.inf, -math.inf):
                raise ValueError(f"options.{key} is {value!r}; write true, false, a number or text")
        return options

    @pydantic.model_validator(mode="after")
    def _spelt_as_the_interface_does(self) -> CanConnection:
        known = _options_of(self.interface) if self.options else ()
        for key in self.options:
            close = difflib.get_close_matches(key, known, n=1, cutoff=_A_SLIP)
            if key not in known and close:
                raise ValueError(f"options.{key} is unknown to {self.interface}; did you mean {close[0]!r}?")
        return self

    @pydantic.model_validator(mode="after")
    def _channel_of_the_interface(self) -> CanConnection:
        channel = self.channel
        if self.interface == "slcan" and "/" not in channel and not channel.upper().startswith("COM"):
            raise ValueError(f"channel {channel!r} is no serial port, as slcan needs; write one, as /dev/ttyACM0")
        if self.interface == "socketcan" and ("/" in channel or len(channel) > _LONGEST_NAME):
            raise ValueError(
                f"channel {channel!r} is no name of a network interface; write one as can0, or interface: slcan for an "
                "adapter on a serial port"
            )
        return self

    @property
    def place(self) -> str:
        """The bus in words; nodes on it have their own."""
        return f"{self.interface}:{self.channel}"

    def shared(self) -> Mapping[str, Mapping[str, object]]:
        """The bus, as `DeviceSettings.shares` has it of each device there; a serial adapter's is a port."""
        path = self.channel.partition("@")[0]
        name = f"port {path}" if path.startswith(("/", "COM", "socket://")) else f"CAN bus {self.place}"
        return {name: {f"connection.{key}": getattr(self, key) for key in _ALIKE}}


_LONGEST_NAME = 15
"""Of a Linux network interface (IFNAMSIZ), in characters."""

_A_SLIP = 0.8
"""Likeness of two words that are meant to be one: python-can has options (data_bitrate) that no class names."""

_NO_OPTIONS = frozenset({"self", "args", "kwargs"})
_ALIKE = ("interface", "channel", "bitrate", "options")


def _interfaces() -> Collection[str]:
    """python-can's own interfaces and those of plug-ins; none if it is not installed, which opening says."""
    try:
        from can.interfaces import VALID_INTERFACES
    except ModuleNotFoundError:
        return ()
    return VALID_INTERFACES


def _options_of(interface: str) -> Collection[str]:
    """What python-can's class for this interface names; it takes more, and ignores what it does not know."""
    try:
        from can.interfaces import BACKENDS

        module, name = BACKENDS[interface]
        kind = getattr(importlib.import_module(module), name)
    except (ImportError, OSError, KeyError):  # of a plug-in, or without its driver, which opening says
        return ()
    return {key for base in kind.__mro__ for key in inspect.signature(base.__init__).parameters} - _NO_OPTIONS
