"""Rig-file settings of a zoom motor on an Oriental Motor AZ drive."""

from __future__ import annotations

from typing import Literal

import pydantic

from microdrivers.backends.modbus.register_order import ByteOrder, RegisterOrder, WordOrder
from microdrivers.backends.modbus.settings import ModbusConnection
from microdrivers.core.errors import OutOfRange
from microdrivers.core.units import Range
from microdrivers.devices.drivers import DeviceSettings
from microdrivers.devices.zoom_motor import ZoomCurve


class AzConnection(ModbusConnection):
    """The drive's factory setting is 8 data bits, EVEN parity, 1 stop bit (HP-5142E). It speaks RTU; a gateway, TCP.

    A reply begins within 10 ms; `timeout_s` is also the longest that a stop waits behind another exchange.
    """

    baudrate: Literal[9600, 19200, 38400, 57600, 115200, 230400] = 115200
    parity: Literal["N", "E", "O"] = "E"
    timeout_s: float = pydantic.Field(default=0.2, gt=0, le=30)


class AzZoomSettings(DeviceSettings):
    """A zoom motor on an AZ drive.

    `curve` lists [steps, zoom] from the lowest zoom to the highest; between the points zoom is interpolated
    logarithmically. `backlash_steps` is the play of the zoom body's gear. `tolerance_steps` is how far from its
    target a settled motor may stand.

    The drive must have its factory assignment of inputs and outputs, except that ABSPEN (177) may take the place of
    HOME-END on R-OUT4: then `referenced` holds as long as the drive's coordinates do, and a session may begin
    without reference().

    `word_order` and `byte_order` are the drive's parameter 1384h; opening checks it. `communication_timeout_s` is its
    parameter 138Ah: a drive that hears nothing for so long stops by itself, with alarm 85h. It is written at opening,
    to the drive's memory that forgets, and taken back at closing; null leaves it as the drive has it.
    """

    driver: Literal["oriental-az-zoom"] = "oriental-az-zoom"
    connection: AzConnection
    unit_id: int = pydantic.Field(default=1, ge=1, le=31)
    word_order: WordOrder = "high-first"
    byte_order: ByteOrder = "big"
    communication_timeout_s: float | None = pydantic.Field(default=None, ge=0.1, le=10.0)
    curve: tuple[tuple[int, float], ...] = pydantic.Field(min_length=2)
    zoom_range: Range
    speed_steps_s: int = pydantic.Field(gt=0, le=4_000_000)
    acceleration_steps_s2: int = pydantic.Field(gt=0, le=1_000_000_000)
    current_percent: float = pydantic.Field(default=100.0, gt=0, le=100)
    backlash_steps: int = pydantic.Field(default=0, ge=0)
    tolerance_steps: int = pydantic.Field(default=2, ge=0)
    settle_s: float = pydantic.Field(default=0.1, gt=0)
    reference_timeout_s: float = pydantic.Field(default=30.0, gt=0)

    @pydantic.field_validator("curve")
    @classmethod
    def _monotone(cls, points: tuple[tuple[int, float], ...]) -> tuple[tuple[int, float], ...]:
        try:
            ZoomCurve.from_points(points)
        except OutOfRange as error:
            raise ValueError(f"{error.what}; {error.remedy}") from error
        if any(not -(1 << 31) <= steps < 1 << 31 for steps, _ in points):
            raise ValueError("the drive counts steps in 32 bits: −2147483648 to 2147483647")
        return points

    @pydantic.model_validator(mode="after")
    def _within_curve(self) -> AzZoomSettings:
        low, high = self.curve[0][1], self.curve[-1][1]
        if self.zoom_range.min > self.zoom_range.max:
            raise ValueError(f"zoom_range {self.zoom_range} runs backwards")
        if self.zoom_range.max < low or self.zoom_range.min > high:
            raise ValueError(f"zoom_range {self.zoom_range} has nothing in common with the curve, {low:g} to {high:g}")
        return self

    @pydantic.model_validator(mode="after")
    def _time_for_a_lost_reply(self) -> AzZoomSettings:
        least_s = 2 * self.connection.timeout_s + 0.1
        if self.communication_timeout_s is not None and self.communication_timeout_s < least_s:
            raise ValueError(
                f"communication_timeout_s {self.communication_timeout_s:g} leaves no time for a lost reply: with "
                f"connection.timeout_s {self.connection.timeout_s:g} it must be {least_s:g} or more"
            )
        return self

    @property
    def register_order(self) -> RegisterOrder:
        """How the drive puts 32-bit values into registers."""
        return RegisterOrder(self.word_order, self.byte_order)

    def claims(self) -> tuple[str, ...]:
        """The port."""
        return (f"port {self.connection.port}",)
