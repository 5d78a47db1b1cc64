"""Serial port settings, as they stand in a rig file."""

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
