"""Puts an emulated AZ drive at the other end of a zoom motor's serial port or network connection."""

from __future__ import annotations

from typing import Literal, Protocol, runtime_checkable

import pydantic

from microdrivers.core.errors import UnsupportedError
from microdrivers.devices.drivers import Emulation, EmulationRequest, Emulator
from microdrivers.fakes.modbus import SlaveLine, attach_slave
from microdrivers.fakes.oriental_az.drive import AzDrive
from microdrivers.fakes.oriental_az.port import az_port
from microdrivers.fakes.oriental_az.register_map import BYTE_WORD_ORDER
from microdrivers.fakes.rig_section import parse_settings
from microdrivers.fakes.world.axis import Axis


@runtime_checkable
class ZoomWorld(Protocol):
    """What a world must have for this emulator: the zoom motor's shaft, in motor steps."""

    zoom_axis: Axis


class _Line(SlaveLine):
    """The rates and, from the factory, the parity of the drive."""

    baudrate: Literal[9600, 19200, 38400, 57600, 115200, 230400] = 115200
    parity: Literal["N", "E", "O"] = "E"


class _Settings(pydantic.BaseModel, extra="ignore", frozen=True):
    """The part of the rig file's section that the drive itself is set to."""

    connection: _Line
    unit_id: int = pydantic.Field(default=1, ge=1, le=31)
    word_order: Literal["high-first", "low-first"] = "high-first"
    byte_order: Literal["big", "little"] = "big"

    @property
    def byte_word_order(self) -> int:
        """Parameter 1384h."""
        return (self.word_order == "low-first") + 2 * (self.byte_order == "little")


def _attach(request: EmulationRequest) -> Emulation:
    """Build the drive and its wire `fake://NAME`; with framing `tcp`, a gateway stands between the two.

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
    settings = parse_settings(
        request,
        _Settings,
        remedy="use what the drive's manual allows: 9600 to 230400 baud, units 1 to 31, word_order high-first or "
        "low-first, byte_order big or little; and framing rtu or tcp",
    )
    connection = settings.connection
    drive = AzDrive(request.world.zoom_axis, seed=request.seed + 1)
    drive.set_up(BYTE_WORD_ORDER, settings.byte_word_order)
    port = az_port(
        drive,
        unit_id=settings.unit_id,
        baudrate=connection.baudrate,
        bits_per_byte=connection.bits_per_byte,
        seed=request.seed,
    )
    return attach_slave(request, port, connection)


EMULATOR = Emulator(attach=_attach)
