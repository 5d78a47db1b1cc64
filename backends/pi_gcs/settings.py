"""Rig-file settings of a PI XYθ stage on one GCS 2.0 controller, or on three in a daisy chain."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import pydantic

from microdrivers.backends.lines.settings import SerialConnection
from microdrivers.core.units import Range
from microdrivers.devices.drivers import DeviceSettings, spelled

ReferenceMode = Literal["FRF", "FNL", "FPL"]

_MOST_AXES = {"C-884.4": 4, "C-884": 6, "C-863": 1}
"""By what a model's name begins with; ids that are numbers are those of its connectors."""
_NATIVE_ONLY = "C-863.10"


AxisId = Annotated[str, spelled(r"^[A-Za-z0-9_]{1,16}\Z", "an axis id has 1 to 16 letters, digits and _")]


class _Axis(DeviceSettings):
    """What a linear and a rotary axis have in common.

    `id` is the controller's axis identifier; `stage` the name that `CST?` must report; `direction` is −1 if
    the controller's positive sense is the rig's negative one. `address` is that of the axis' own controller in a
    daisy chain (DIP switches 1-4), which may have to have a `serial_number`.
    """

    id: AxisId = "1"
    address: int | None = pydantic.Field(default=None, ge=1, le=16)
    serial_number: str | None = None
    stage: str | None = None
    direction: Literal[1, -1] = 1
    reference: ReferenceMode = "FRF"


class LinearAxis(_Axis):
    """A linear axis; the controller's unit is the millimetre."""

    travel_um: Range
    max_speed_um_s: float = pydantic.Field(gt=0)
    acceleration_um_s2: float = pydantic.Field(gt=0)
    resolution_um: float = pydantic.Field(gt=0)
    tolerance_um: float = pydantic.Field(gt=0)

    @pydantic.model_validator(mode="after")
    def _sensible(self) -> LinearAxis:
        _check(self.travel_um, self.resolution_um, self.tolerance_um, "um")
        return self


class RotaryAxis(_Axis):
    """A rotary axis; the controller's unit is the degree."""

    travel_deg: Range
    max_speed_deg_s: float = pydantic.Field(gt=0)
    acceleration_deg_s2: float = pydantic.Field(gt=0)
    resolution_deg: float = pydantic.Field(gt=0)
    tolerance_deg: float = pydantic.Field(gt=0)

    @pydantic.model_validator(mode="after")
    def _sensible(self) -> RotaryAxis:
        _check(self.travel_deg, self.resolution_deg, self.tolerance_deg, "deg")
        return self


class StageAxes(DeviceSettings):
    """The three axes of the stage: all on one controller, or each on one of its own, with an address."""

    x: LinearAxis
    y: LinearAxis
    theta: RotaryAxis

    @property
    def chained(self) -> bool:
        """Whether each axis has a controller of its own in a daisy chain."""
        return self.x.address is not None

    @pydantic.model_validator(mode="after")
    def _distinct(self) -> StageAxes:
        axes = (self.x, self.y, self.theta)
        addresses = [axis.address for axis in axes]
        if None not in addresses:
            if len(set(addresses)) != len(axes):
                raise ValueError(
                    f"{_twice(addresses)}.address is that of another axis: the three controllers of a daisy chain need "
                    f"different addresses, not {addresses}"
                )
            return self
        if any(addresses):
            raise ValueError(
                f"addresses are {addresses}: give one to each axis (three controllers in a daisy chain) or to none "
                "(one controller for all axes)"
            )
        ids = [axis.id for axis in axes]
        if len(set(ids)) != len(ids):
            raise ValueError(
                f"{_twice(ids)}.id is that of another axis: the three need different controller axis ids, not {ids}"
            )
        if any(axis.serial_number is not None for axis in axes):
            raise ValueError("only an axis with an address has a serial_number: give it for the stage, not per axis")
        return self


class PositionLatch(DeviceSettings):
    """When the controller samples the position that it reports.

    `delay_ms` is counted from the end of the request's last bit; `uncertainty_ms` is the half-width of the
    95 % interval of that delay.
    """

    delay_ms: float = pydantic.Field(default=0.05, ge=0)
    uncertainty_ms: float = pydantic.Field(default=0.05, gt=0)


class GcsStageSettings(DeviceSettings):
    """An XYθ stage on one multi-axis GCS 2.0 controller (C-884 class) or on three of one axis (C-863.11, C-863.12).

    `controller` is the model that each of them must report.
    """

    driver: Literal["pi-gcs-xytheta"] = "pi-gcs-xytheta"
    connection: SerialConnection
    controller: str = pydantic.Field(default="C-884", min_length=1)
    serial_number: str | None = None
    axes: StageAxes
    latch: PositionLatch = PositionLatch()
    settle_s: float = pydantic.Field(default=0.2, gt=0)
    reference_timeout_s: float = pydantic.Field(default=60.0, gt=0)

    @pydantic.model_validator(mode="after")
    def _axes_of_the_controller(self) -> GcsStageSettings:
        if self.controller.startswith(_NATIVE_ONLY):
            raise ValueError(
                f"controller {self.controller} speaks no GCS on its serial line; use a C-863.11 or C-863.12, or a C-884"
            )
        most = next((number for family, number in _MOST_AXES.items() if self.controller.startswith(family)), None)
        if most is None:
            return self
        axes = {"x": self.axes.x, "y": self.axes.y, "theta": self.axes.theta}
        if not self.axes.chained and most < len(axes):
            raise ValueError(
                f"controller {self.controller} drives one axis; give each axis the address of its own controller in "
                "the daisy chain, address: 1, 2, 3, or correct the controller"
            )
        for name, axis in axes.items():
            if axis.id.isdecimal() and not 1 <= int(axis.id) <= most:
                raise ValueError(
                    f"axes.{name}.id {axis.id!r} is none of a {self.controller}, whose axes are 1 to {most}; correct "
                    "it, or state the controller's full name if it has more axes"
                )
        return self

    @pydantic.model_validator(mode="after")
    def _whose_serial_number(self) -> GcsStageSettings:
        if self.axes.chained and self.serial_number is not None:
            raise ValueError(
                "each controller of a daisy chain has its own serial_number: give it per axis, not for the stage"
            )
        return self

    def claims(self) -> tuple[str, ...]:
        """The port."""
        return (f"port {self.connection.port}",)


def _twice(values: Sequence[object]) -> str:
    """The axis whose value another one before it has too."""
    return next(axis for i, axis in enumerate(("x", "y", "theta")) if values[i] in values[:i])


def _check(travel: Range, resolution: float, tolerance: float, unit: str) -> None:
    if not travel.min < travel.max:
        raise ValueError(f"travel_{unit} must rise: [lowest, highest], not [{travel.min:g}, {travel.max:g}]")
    if tolerance < 0.5 * resolution:
        raise ValueError(
            f"tolerance_{unit} {tolerance:g} is finer than half of resolution_{unit} {resolution:g}: "
            "moves could not end"
        )
