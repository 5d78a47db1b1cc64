"""Rig-file settings of a fine stage on three CiA 402 drives."""

from __future__ import annotations

import math
from typing import Literal

import pydantic

from microdrivers.backends.lines.settings import CanConnection
from microdrivers.core.units import Range
from microdrivers.devices.drivers import DeviceSettings

AxisName = Literal["x", "y", "z"]
Triple = tuple[float, float, float]

_MOST_COUNTS = (1 << 31) - 1
_UNIT_SLACK = 1e-3
_LEAST_VOLUME = 0.1


class FineAxis(DeviceSettings):
    """One axis and its drive.

    `direction` is −1 if the drive's positive sense is the rig's negative one. `homing_method` is that of the drive's
    manual (object 6098h): 17 and 18 are the limit switches, 33 and 34 the index, negative ones the maker's.
    `homing_speeds_um_s` are those to the switch and to zero; without them the drive's own are used.
    """

    node_id: int = pydantic.Field(ge=1, le=126)
    counts_per_um: float = pydantic.Field(gt=0)
    travel_um: Range
    max_speed_um_s: float = pydantic.Field(gt=0)
    acceleration_um_s2: float = pydantic.Field(gt=0)
    tolerance_um: float = pydantic.Field(gt=0)
    homing_method: int = pydantic.Field(ge=-128, le=127)
    homing_speeds_um_s: tuple[float, float] | None = None
    direction: Literal[1, -1] = 1

    @pydantic.model_validator(mode="after")
    def _sensible(self) -> FineAxis:
        low, high = self.travel_um
        if not low < high:
            raise ValueError(f"travel_um must rise: [lowest, highest], not [{low:g}, {high:g}]")
        if max(abs(low), abs(high)) * self.counts_per_um > _MOST_COUNTS:
            raise ValueError(
                f"the drive counts in 32 bits: {self.counts_per_um:g} counts_per_um do not cover travel_um"
            )
        if self.tolerance_um * self.counts_per_um < 0.5:
            raise ValueError(
                f"tolerance_um {self.tolerance_um:g} is finer than half a count of {1 / self.counts_per_um:g} µm: "
                "moves could not end"
            )
        fastest = max(self.max_speed_um_s, self.acceleration_um_s2, *(self.homing_speeds_um_s or (0,)))
        if fastest * self.counts_per_um > _MOST_COUNTS:
            raise ValueError(f"speed or acceleration of {fastest:g} µm do not fit into 32 bits of counts")
        if self.homing_method == 0:
            raise ValueError("homing_method 0 does nothing: name one of the drive's manual")
        if self.homing_speeds_um_s is not None and not all(speed > 0 for speed in self.homing_speeds_um_s):
            raise ValueError("homing_speeds_um_s must be positive: [to the switch, to zero]")
        return self


class FineAxes(DeviceSettings):
    """The three axes, each with a drive of its own."""

    x: FineAxis
    y: FineAxis
    z: FineAxis

    @pydantic.model_validator(mode="after")
    def _distinct(self) -> FineAxes:
        node_ids = [axis.node_id for axis in (self.x, self.y, self.z)]
        if len(set(node_ids)) != len(node_ids):
            raise ValueError(f"the three drives need different node ids, not {node_ids}")
        return self


class AxisDirections(DeviceSettings):
    """Unit vectors of the stage's axes in the rig's frame."""

    x: Triple = (1.0, 0.0, 0.0)
    y: Triple = (0.0, 1.0, 0.0)
    z: Triple = (0.0, 0.0, 1.0)

    @pydantic.model_validator(mode="after")
    def _independent(self) -> AxisDirections:
        for name, vector in (("x", self.x), ("y", self.y), ("z", self.z)):
            if not math.isclose(math.hypot(*vector), 1.0, abs_tol=_UNIT_SLACK):
                raise ValueError(f"axes_in_rig.{name} must have length 1, not {math.hypot(*vector):.4g}")
        (a, b, c), (d, e, f), (g, h, i) = self.x, self.y, self.z
        volume = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
        if abs(volume) < _LEAST_VOLUME:
            raise ValueError("axes_in_rig must not lie (nearly) in one plane")
        return self


class FineStageSettings(DeviceSettings):
    """A fine stage.

    `reference_order` is the one order in which axes may be referenced: an axis that takes the tool out of harm's way
    comes first. `axes_in_rig` says how the stage's holder is tilted against the rig, `origin_um` where in the rig's
    frame the tip of the tool is when all axes are at 0, `retract_um` which way, in the stage's own axes, leads away
    from the sample.

    `heartbeat_ms` is the interval of the drives' heartbeats, and how long they go on without hearing ours before they
    stop. `settle_s` is how long a move may take to settle; `reference_timeout_s` how long one axis may search.
    """

    driver: Literal["cia402-fine-stage"] = "cia402-fine-stage"
    connection: CanConnection
    axes: FineAxes
    reference_order: tuple[AxisName, AxisName, AxisName]
    axes_in_rig: AxisDirections = AxisDirections()
    origin_um: Triple | None = None
    retract_um: Triple | None = None
    heartbeat_ms: int = pydantic.Field(default=100, ge=10, le=10_000)
    settle_s: float = pydantic.Field(default=0.1, gt=0)
    reference_timeout_s: float = pydantic.Field(default=60.0, gt=0)

    @pydantic.field_validator("reference_order")
    @classmethod
    def _each_once(cls, order: tuple[AxisName, ...]) -> tuple[AxisName, ...]:
        if len(set(order)) != len(order):
            raise ValueError(f"reference_order must name x, y and z once each, not {', '.join(order)}")
        return order

    @pydantic.field_validator("retract_um")
    @classmethod
    def _leads_somewhere(cls, way: Triple | None) -> Triple | None:
        if way is not None and not any(way):
            raise ValueError("retract_um [0, 0, 0] leads nowhere: leave it out, or say which way leads away")
        return way

    def claims(self) -> tuple[str, ...]:
        """The three nodes."""
        where = f"{self.connection.interface}:{self.connection.channel}"
        return tuple(f"node {getattr(self.axes, axis).node_id} on {where}" for axis in ("x", "y", "z"))
