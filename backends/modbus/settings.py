"""Settings of a connection to Modbus devices, as they stand in a rig file."""

from __future__ import annotations

from typing import Literal

import pydantic

from microdrivers.backends.lines.settings import SerialConnection

_NETWORK = ("socket://", "fake://")


class ModbusConnection(SerialConnection):
    """A serial line with Modbus devices on it, or a network connection to one or to a gateway.

    `framing: rtu` is for serial ports, and for `socket://HOST:PORT` if a serial server stands there that passes bytes
    on as they are. `framing: tcp` is Modbus TCP; `port` is then `socket://HOST:PORT` (the standard's port is 502), and
    baudrate, parity and stopbits mean nothing: they are the gateway's affair.
    """

    framing: Literal["rtu", "tcp"] = "rtu"

    @pydantic.model_validator(mode="after")
    def _tcp_needs_a_network(self) -> ModbusConnection:
        if self.framing == "tcp" and not self.port.startswith(_NETWORK):
            raise ValueError(
                f"framing: tcp needs a network address, and {self.port} is none; write port: socket://HOST:502 for "
                f"Modbus TCP, or framing: rtu for a serial line"
            )
        return self

    @property
    def bits_per_byte(self) -> int:
        """Bits of one byte on a serial line; a network has no byte times."""
        return 0 if self.framing == "tcp" else super().bits_per_byte
