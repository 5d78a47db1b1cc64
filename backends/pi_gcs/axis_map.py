"""Between the rig's µm and degrees and the controller's mm and degrees. Nowhere else are units converted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

import msgspec

from microdrivers.backends.pi_gcs.replies import decimal
from microdrivers.backends.pi_gcs.settings import LinearAxis, ReferenceMode, RotaryAxis
from microdrivers.core.errors import ProtocolError
from microdrivers.core.units import UM_PER_MM, Range
from microdrivers.devices.motion import AxisSpec

ValueT = TypeVar("ValueT")


class AxisMap(msgspec.Struct, frozen=True, kw_only=True):
    """One axis of the stage and its counterpart in the controller.

    Attributes:
        id: the controller's identifier of the axis.
        rig_per_native: rig units in one controller unit: 1000 µm in a mm, 1 deg in a deg.
        direction: −1 if the controller's positive sense is the rig's negative one.
        spec: limits, speeds, resolution and tolerance in rig units.
        native_unit: the controller's unit.
        reference: how to find the reference.
    """

    id: str
    rig_per_native: float
    direction: int
    spec: AxisSpec
    native_unit: str
    reference: ReferenceMode

    @classmethod
    def from_settings(cls, settings: LinearAxis | RotaryAxis) -> AxisMap:
        """The axis as the rig file describes it."""
        if isinstance(settings, LinearAxis):
            spec = AxisSpec(
                unit="µm", min_position=settings.travel_um.min, max_position=settings.travel_um.max,
                max_speed=settings.max_speed_um_s, acceleration=settings.acceleration_um_s2,
                resolution=settings.resolution_um, tolerance=settings.tolerance_um,
            )  # fmt: skip
            rig_per_native, native_unit = UM_PER_MM, "mm"
        else:
            spec = AxisSpec(
                unit="deg", min_position=settings.travel_deg.min, max_position=settings.travel_deg.max,
                max_speed=settings.max_speed_deg_s, acceleration=settings.acceleration_deg_s2,
                resolution=settings.resolution_deg, tolerance=settings.tolerance_deg,
            )  # fmt: skip
            rig_per_native, native_unit = 1.0, "deg"
        return cls(
            id=settings.id, rig_per_native=rig_per_native, direction=settings.direction, spec=spec,
            native_unit=native_unit, reference=settings.reference,
        )  # fmt: skip

    def restricted(self, *, travel: Range, acceleration: float) -> AxisMap:
        """The same axis with the travel and acceleration that the controller allows."""
        spec = msgspec.structs.replace(
            self.spec,
            min_position=travel.min,
            max_position=travel.max,
            acceleration=min(acceleration, self.spec.acceleration),
        )
        return msgspec.structs.replace(self, spec=spec)

    def position(self, native: float) -> float:
        """A position of the controller in µm or degrees of the rig."""
        return native * self.rig_per_native * self.direction

    def magnitude(self, native: float) -> float:
        """A speed or an acceleration of the controller in rig units."""
        return native * self.rig_per_native

    def travel(self, native_min: float, native_max: float) -> Range:
        """Limits of the controller in rig units."""
        ends = self.position(native_min), self.position(native_max)
        return Range(min(ends), max(ends))

    def target_text(self, position: float) -> str:
        """A rig position for a request: the nearest whole count, or the last one inside the limits."""
        counts = round(position / self.spec.resolution)
        slack = 1e-6 * self.spec.resolution
        if counts * self.spec.resolution > self.spec.max_position + slack:
            counts -= 1
        elif counts * self.spec.resolution < self.spec.min_position - slack:
            counts += 1
        return decimal(counts * self.spec.resolution / self.rig_per_native * self.direction)

    def speed_text(self, speed: float) -> str:
        """A rig speed for a request."""
        return decimal(speed / self.rig_per_native)


def by_axis(axes: Mapping[str, AxisMap], reply: Mapping[str, ValueT], *, command: str) -> dict[str, ValueT]:
    """A reply by axis of the rig instead of by the controller's ids.

    Raises:
        ProtocolError: an axis is missing.
    """
    missing = [axis_map.id for axis_map in axes.values() if axis_map.id not in reply]
    if missing:
        raise ProtocolError(
            f"the reply to {command} lacks axis {', '.join(missing)}; it has {', '.join(reply) or 'none'}",
            remedy="check that the axis is switched on in the controller; close and open the stage again",
        )
    return {axis: reply[axis_map.id] for axis, axis_map in axes.items()}
