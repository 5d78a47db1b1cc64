"""Rig-file settings of a PI XYθ stage on a GCS 2.0 controller."""

from __future__ import annotations

from typing import Literal

import pydantic

from microdrivers.backends.lines.settings import SerialConnection
from microdrivers.core.units import Range
from microdrivers.devices.drivers import DeviceSettings

ReferenceMode = Literal["FRF", "FNL", "FPL"]


class _Axis(DeviceSettings):
    """What a linear and a rotary axis have in common.

    `id` is the controller's axis identifier; `stage` the name that `CST?` must report; `direction` is −1 if
    the controller's positive sense is the rig's negative one.
    """

    id: str = pydantic.Field(pattern=r"^[A-Za-z0-9_]{1,16}$")
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
    """The three axes of the stage."""

    x: LinearAxis
    y: LinearAxis
    theta: RotaryAxis

    @pydantic.model_validator(mode="after")
    def _distinct(self) -> StageAxes:
        ids = [self.x.id, self.y.id, self.theta.id]
        if len(set(ids)) != len(ids):
            raise ValueError(f"the three axes need different controller axis ids, not {ids}")
        return self


class PositionLatch(DeviceSettings):
    """When the controller samples the position that it reports.

    `delay_ms` is counted from the end of the request's last bit; `uncertainty_ms` is the half-width of the
    95 % interval of that delay.
    """

    delay_ms: float = pydantic.Field(default=0.05, ge=0)
    uncertainty_ms: float = pydantic.Field(default=0.05, gt=0)


class GcsStageSettings(DeviceSettings):
    """An XYθ stage on one multi-axis GCS 2.0 controller (C-884 class)."""

    driver: Literal["pi-gcs-xytheta"] = "pi-gcs-xytheta"
    connection: SerialConnection
    controller: str = "C-884"
    serial_number: str | None = None
    axes: StageAxes
    latch: PositionLatch = PositionLatch()
    settle_s: float = pydantic.Field(default=0.2, gt=0)
    reference_timeout_s: float = pydantic.Field(default=60.0, gt=0)


def _check(travel: Range, resolution: float, tolerance: float, unit: str) -> None:
    if not travel.min < travel.max:
        raise ValueError(f"travel_{unit} must rise: [lowest, highest], not [{travel.min:g}, {travel.max:g}]")
    if tolerance < 0.5 * resolution:
        raise ValueError(
            f"tolerance_{unit} {tolerance:g} is finer than half of resolution_{unit} {resolution:g}: "
            "moves could not end"
        )
