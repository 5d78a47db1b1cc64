"""Rig-file settings of a fine stage on three CiA 402 drives."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import pydantic

from microdrivers.backends.lines.settings import CanConnection
from microdrivers.core.units import Range
from microdrivers.devices.drivers import DeviceSettings
from microdrivers.devices.fine_stage_settings import ToolCarrierSettings

_NEGATIVE_SWITCH, _POSITIVE_SWITCH = frozenset({1, 17}), frozenset({2, 18})
"""Methods that end at a limit switch, or at the index beside it."""

AxisName = Literal["x", "y", "z"]

_AXES: tuple[AxisName, ...] = ("x", "y", "z")
_MOST_COUNTS = (1 << 31) - 1
_HOMING_METHODS = frozenset((*range(1, 15), *range(17, 31), 33, 34, 35, 37))
"""Those of CiA 402-2, 11; 15, 16, 31, 32 and 36 are reserved, negative ones the maker's."""


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
    homing_method: int
    homing_speeds_um_s: tuple[float, float] | None = None
    direction: Literal[1, -1] = 1

    @pydantic.field_validator("homing_method")
    @classmethod
    def _of_the_profile(cls, method: int) -> int:
        if method not in _HOMING_METHODS and not -128 <= method < 0:
            raise ValueError(
                f"homing_method {method} is none of CiA 402; write one of the drive's manual: 17 or 18 for the "
                "negative or positive switch, 33 or 34 for the index, 37 for where it stands (of 1 to 14, 17 to 30, 33 "
                "to 35, 37, or a negative one of its maker)"
            )
        return method

    @pydantic.model_validator(mode="after")
    def _sensible(self) -> FineAxis:
        low, high = self.travel_um
        if not low < high:
            raise ValueError(f"travel_um must rise: [lowest, highest], not [{low:g}, {high:g}]")
        if max(abs(low), abs(high)) * self.counts_per_um > _MOST_COUNTS:
            raise ValueError(
                f"counts_per_um {self.counts_per_um:g} does not cover travel_um, since the drive counts in 32 bits"
            )
        if self.tolerance_um * self.counts_per_um < 0.5:
            raise ValueError(
                f"tolerance_um {self.tolerance_um:g} is finer than half a count of {1 / self.counts_per_um:g} µm: "
                "moves could not end"
            )
        fastest = max(self.max_speed_um_s, self.acceleration_um_s2, *(self.homing_speeds_um_s or (0,)))
        if fastest * self.counts_per_um > _MOST_COUNTS:
            raise ValueError(f"speed or acceleration of {fastest:g} µm do not fit into 32 bits of counts")
        if self.homing_speeds_um_s is not None and not all(speed > 0 for speed in self.homing_speeds_um_s):
            raise ValueError("homing_speeds_um_s must be positive: [to the switch, to zero]")
        return self

    @property
    def homing_end_um(self) -> float | None:
        """The end of the travel at which a search for the reference ends; None if the method does not say."""
        if self.homing_method not in _NEGATIVE_SWITCH | _POSITIVE_SWITCH:
            return None
        upper = (self.homing_method in _POSITIVE_SWITCH) == (self.direction == 1)
        return self.travel_um.max if upper else self.travel_um.min


class FineAxes(DeviceSettings):
    """The three axes, each with a drive of its own."""

    x: FineAxis
    y: FineAxis
    z: FineAxis

    @pydantic.model_validator(mode="after")
    def _distinct(self) -> FineAxes:
        node_ids = [axis.node_id for axis in (self.x, self.y, self.z)]
        if len(set(node_ids)) != len(node_ids):
            twice = next(i for i, node_id in enumerate(node_ids) if node_id in node_ids[:i])
            raise ValueError(
                f"{_AXES[twice]}.node_id is that of another axis: the three drives need different node ids, not "
                f"{node_ids}"
            )
        return self


class FineStageSettings(ToolCarrierSettings):
    """A fine stage.

    `reference_order` is the one order in which axes may be referenced: an axis that takes the tool out of harm's way
    comes first.

    `heartbeat_ms` is the interval of the drives' heartbeats, and how long they go on without hearing ours before they
    stop. `settle_s` is how long a move may take to settle; `reference_timeout_s` how long one axis may search.
    """

    driver: Literal["cia402-fine-stage"] = "cia402-fine-stage"
    connection: CanConnection
    axes: FineAxes
    reference_order: tuple[AxisName, AxisName, AxisName]
    heartbeat_ms: int = pydantic.Field(default=100, ge=10, le=10_000)
    settle_s: float = pydantic.Field(default=0.1, gt=0)
    reference_timeout_s: float = pydantic.Field(default=60.0, gt=0)

    @pydantic.field_validator("reference_order", mode="before")
    @classmethod
    def _each_once(cls, order: Any) -> Any:
        names = [str(axis) for axis in order] if isinstance(order, list | tuple) else []
        if sorted(names) != list(_AXES):
            raise ValueError(
                f"reference_order must name x, y and z once each, not {', '.join(names) or repr(order)}; begin with "
                "the axis that takes the tool away, for example [z, x, y]"
            )
        return tuple(names)

    @property
    def largest_speed_um_s(self) -> float:
        """Of any axis."""
        return max(axis.max_speed_um_s for axis in (self.axes.x, self.axes.y, self.axes.z))

    @property
    def travel_um(self) -> Mapping[str, Range]:
        """Travel of x, y and z."""
        return {axis: getattr(self.axes, axis).travel_um for axis in _AXES}

    @property
    def homing_ends_um(self) -> Mapping[str, float]:
        """The ends of the travel at which axes stand after a search for references that ends at a limit switch."""
        ends = {axis: getattr(self.axes, axis).homing_end_um for axis in _AXES}
        return {axis: end for axis, end in ends.items() if end is not None}

    def claims(self) -> tuple[str, ...]:
        """The three nodes."""
        where = self.connection.place
        return tuple(f"node {getattr(self.axes, axis).node_id} on {where}" for axis in _AXES)

    def shares(self) -> Mapping[str, Mapping[str, object]]:
        """The bus."""
        return self.connection.shared()
