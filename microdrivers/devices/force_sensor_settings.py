"""What the rig file says of every force sensor, whatever wire it hangs on."""

from __future__ import annotations

import math

import pydantic

from microdrivers.core.units import Range
from microdrivers.devices.drivers import DeviceSettings

_UNIT_LENGTH = Range(0.99, 1.01)


class ForceSensorSettings(DeviceSettings):
    """One axis of force.

    `resolution_uN` and `bandwidth_hz` are those of sensor and amplifier together. `axis` is the unit vector in the
    rig's frame along which a push on the tip reads positive. `carried_by` names the stage that carries the sensor.
    `rate_hz` is the rate at which a tare is taken, and a stream unless it is asked for another.
    """

    range_uN: Range
    resolution_uN: float = pydantic.Field(gt=0)
    bandwidth_hz: float = pydantic.Field(gt=0)
    stiffness_uN_per_um: float = pydantic.Field(gt=0)
    axis: tuple[float, float, float]
    carried_by: str | None = pydantic.Field(default=None, min_length=1)
    rate_hz: float = pydantic.Field(gt=0)

    @pydantic.field_validator("range_uN")
    @classmethod
    def _forwards(cls, range_uN: Range) -> Range:
        if range_uN.min >= range_uN.max:
            raise ValueError(f"{range_uN} is empty or runs backwards: write [lowest, highest]")
        return range_uN

    @pydantic.model_validator(mode="after")
    def _finer_than_its_range(self) -> ForceSensorSettings:
        if self.resolution_uN >= self.range_uN.max - self.range_uN.min:
            raise ValueError(
                f"resolution_uN {self.resolution_uN:g} is as coarse as the whole range_uN; check the unit, µN"
            )
        return self

    @pydantic.field_validator("axis")
    @classmethod
    def _unit_vector(cls, axis: tuple[float, float, float]) -> tuple[float, float, float]:
        length = math.hypot(*axis)
        if length not in _UNIT_LENGTH:
            raise ValueError(f"the axis has the length {length:.3g}; write a unit vector such as [0, 0, 1]")
        x, y, z = axis
        return (x / length, y / length, z / length)
