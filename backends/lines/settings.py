"""Settings of serial ports and CAN buses, as they stand in a rig file."""

from __future__ import annotations

from typing import Literal

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
