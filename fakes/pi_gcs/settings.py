"""The part of a stage's section of the rig file that its controllers could know."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import pydantic
from pydantic import AliasChoices

from microdrivers.core.units import UM_PER_MM, Range
from microdrivers.fakes.pi_gcs.axis_channel import AxisSpec

_DEFAULT_SERIAL_NUMBER = "116012345"
_FIRST_CHAINED_SERIAL_NUMBER = 115500620
_FULL_NAME = {"C-863": "C-863.12", "C-884": "C-884.4DC"}
_TRUE_PER_UNIT = {"x": UM_PER_MM, "y": UM_PER_MM, "theta": 1.0}
_DEFAULT_STAGE = {"x": "M-111.1DG", "y": "M-111.1DG", "theta": "M-116.DG"}


class _Settings(pydantic.BaseModel):
    """The rest is the driver's."""

    model_config = pydantic.ConfigDict(extra="ignore", frozen=True)


class AxisSettings(_Settings):
    """Numbers in µm for x and y, in degrees for theta; `address` is that of the axis' own controller."""

    id: str = "1"
    address: int | None = pydantic.Field(default=None, ge=1, le=16)
    serial_number: str | None = None
    stage: str | None = None
    direction: Literal[1, -1] = 1
    travel: Range = pydantic.Field(validation_alias=AliasChoices("travel_um", "travel_deg"))
    max_speed: float = pydantic.Field(validation_alias=AliasChoices("max_speed_um_s", "max_speed_deg_s"))
    acceleration: float = pydantic.Field(validation_alias=AliasChoices("acceleration_um_s2", "acceleration_deg_s2"))
    resolution: float = pydantic.Field(validation_alias=AliasChoices("resolution_um", "resolution_deg"))
    tolerance: float = pydantic.Field(validation_alias=AliasChoices("tolerance_um", "tolerance_deg"))

    def spec(self, key: str, reference_position: float) -> AxisSpec:
        """The axis x, y or theta as its controller knows it."""
        return AxisSpec(
            identifier=self.id,
            key=key,
            stage=self.stage or _DEFAULT_STAGE[key],
            direction=self.direction,
            true_per_unit=_TRUE_PER_UNIT[key],
            travel=self.travel,
            max_speed=self.max_speed,
            acceleration=self.acceleration,
            resolution=self.resolution,
            tolerance=self.tolerance,
            reference_position=reference_position,
        )


class _Axes(_Settings):
    x: AxisSettings
    y: AxisSettings
    theta: AxisSettings


class _Connection(_Settings):
    baudrate: int = 115200


class StageSettings(_Settings):
    """A stage's section: three controllers of one axis if the axes have addresses, otherwise one of three axes."""

    connection: _Connection
    controller: str | None = None
    serial_number: str | None = None
    axes: _Axes

    @pydantic.model_validator(mode="after")
    def _check_addresses(self) -> StageSettings:
        axes = self.by_key().values()
        addresses = {axis.address for axis in axes}
        if addresses == {None}:
            if len({axis.id for axis in axes}) < len(axes):
                raise ValueError("axes of one controller need different ids")
        elif None in addresses or len(addresses) < len(axes):
            raise ValueError("either each axis has an address of its own, or none has one")
        return self

    @property
    def chained(self) -> bool:
        """Whether each axis has a controller of its own."""
        return self.axes.x.address is not None

    def by_key(self) -> Mapping[str, AxisSettings]:
        """The axes by x, y and theta."""
        return {"x": self.axes.x, "y": self.axes.y, "theta": self.axes.theta}

    def identification(self) -> str:
        """What the controller of all axes replies to *IDN?."""
        name = _full_name(self.controller or "C-884")
        serial_number = self.serial_number or _DEFAULT_SERIAL_NUMBER
        return f"(c)2016 Physik Instrumente (PI) GmbH & Co. KG, {name}, {serial_number}, 1.2.0.5"

    def identification_of(self, axis: AxisSettings) -> str:
        """What an axis' own controller replies to *IDN?; without a serial number, it follows from the address."""
        name = _full_name(self.controller or "C-863")
        default = f"{_FIRST_CHAINED_SERIAL_NUMBER + (axis.address or 1) - 1:010d}"
        return f"(c)2015 Physik Instrumente(PI) Karlsruhe, {name},{axis.serial_number or default},1.2.0.0"


def _full_name(controller: str) -> str:
    return _FULL_NAME.get(controller, controller)
