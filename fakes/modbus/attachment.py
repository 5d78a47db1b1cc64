"""Puts a Modbus slave at the other end of a driver's port, directly or behind a TCP gateway."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import pydantic

from microdrivers.devices.drivers import Emulation, EmulationRequest, Endpoint, ServeRequest
from microdrivers.fakes.modbus.gateway import TcpGateway
from microdrivers.fakes.modbus.rtu import RtuSlave
from microdrivers.fakes.wire import Wire, WireEmulator, forget_wire, register_wire, serve_wire

_NETWORK_BAUDRATE, _NETWORK_BITS_PER_BYTE = 10**9, 8
"""Next to the line behind the gateway, bytes on a network take no time."""


class SlaveLine(pydantic.BaseModel, extra="ignore", frozen=True):
    """The RS-485 line of a slave; with framing `tcp`, the one behind the gateway."""

    framing: Literal["rtu", "tcp"] = "rtu"
    baudrate: int = 9600
    parity: Literal["N", "E", "O"] = "N"
    stopbits: Literal[1, 2] = 1

    @property
    def bits_per_byte(self) -> int:
        """Start, data, parity and stop bits."""
        return 9 + self.stopbits + (self.parity != "N")


def attach_slave(request: EmulationRequest, slave: RtuSlave, line: SlaveLine) -> Emulation:
    """Put a slave behind `fake://NAME`. Behind a gateway it is always served on TCP."""
    network = line.framing == "tcp"
    emulator: WireEmulator = TcpGateway(slave) if network else slave
    wire = Wire(
        emulator,
        clock=request.clock,
        seed=request.seed,
        baudrate=_NETWORK_BAUDRATE if network else line.baudrate,
        bits_per_byte=_NETWORK_BITS_PER_BYTE if network else line.bits_per_byte,
    )
    url = register_wire(request.name, wire)

    def serve(where: ServeRequest) -> Endpoint:
        return serve_wire(request.name, wire, request.clock, replace(where, transport="tcp") if network else where)

    return Emulation(
        overrides={"connection": {"port": url}},
        close=lambda: forget_wire(request.name, wire),
        wire_log=wire.log,
        serve=serve,
    )
