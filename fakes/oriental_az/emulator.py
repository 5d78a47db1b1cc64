"""Puts an emulated AZ drive at the other end of a zoom motor's serial port."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, Literal, Protocol, runtime_checkable

import pydantic

from microdrivers.core.errors import ConfigError, UnsupportedError
from microdrivers.devices.drivers import Emulation, EmulationRequest, Emulator
from microdrivers.fakes.oriental_az.drive import AzDrive
from microdrivers.fakes.oriental_az.rtu import RtuSlave
from microdrivers.fakes.wire import Wire, forget_wire, register_wire, serve_wire
from microdrivers.fakes.world.axis import Axis


@runtime_checkable
class ZoomWorld(Protocol):
    """What a world must have for this emulator: the zoom motor's shaft, in motor steps."""

    zoom_axis: Axis


class _Connection(pydantic.BaseModel, extra="ignore", frozen=True):
    baudrate: Literal[9600, 19200, 38400, 57600, 115200, 230400] = 115200
    parity: Literal["N", "E", "O"] = "E"
    stopbits: Literal[1, 2] = 1


class _Settings(pydantic.BaseModel, extra="ignore", frozen=True):
    """The part of the rig file's section that the drive itself is set to."""

    connection: _Connection
    unit_id: int = pydantic.Field(default=1, ge=1, le=31)


def _attach(request: EmulationRequest) -> Emulation:
    """Build the drive and its wire `fake://NAME`.

    Raises:
        UnsupportedError: the world has no zoom axis.
        ConfigError: a drive cannot be set to what the rig file says.
    """
    if not isinstance(request.world, ZoomWorld):
        raise UnsupportedError(
            f"the world {type(request.world).__name__} has no zoom axis",
            remedy="choose a world with a zoom microscope, such as `microscope`",
            device=request.name,
        )
    settings = _parse(request.name, request.settings)
    connection = settings.connection
    bits_per_byte = 9 + connection.stopbits + (connection.parity != "N")
    slave = RtuSlave(
        AzDrive(request.world.zoom_axis, seed=request.seed + 1),
        unit_id=settings.unit_id,
        baudrate=connection.baudrate,
        bits_per_byte=bits_per_byte,
        seed=request.seed,
    )
    wire = Wire(
        slave,
        clock=request.clock,
        seed=request.seed,
        baudrate=connection.baudrate,
        bits_per_byte=bits_per_byte,
    )
    url = register_wire(request.name, wire)

    return Emulation(
        overrides={"connection": {"port": url}},
        close=lambda: forget_wire(request.name, wire),
        wire_log=wire.log,
        serve=partial(serve_wire, request.name, wire, request.clock),
    )


def _parse(name: str, settings: Mapping[str, Any]) -> _Settings:
    try:
        return _Settings.model_validate(dict(settings))
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        raise ConfigError(
            f"{name}: the AZ drive cannot be set to {first['input']!r}: {first['msg']}",
            remedy="use what the drive's manual allows: 9600 to 230400 baud, units 1 to 31",
            key=".".join(str(part) for part in first["loc"]),
        ) from error


EMULATOR = Emulator(attach=_attach)
