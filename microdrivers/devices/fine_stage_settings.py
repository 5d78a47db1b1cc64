"""What the rig file says of how a fine stage carries its tool, whatever drives move it."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping

import pydantic

from microdrivers.core.units import Range
from microdrivers.devices.drivers import DeviceSettings
from microdrivers.devices.fine_stage import Vector, place_of_tip

_UNIT_SLACK = 1e-3
_LEAST_VOLUME = 0.1


class AxisDirections(DeviceSettings):
    """Unit vectors of the stage's axes in the rig's frame."""

    x: Vector = (1.0, 0.0, 0.0)
    y: Vector = (0.0, 1.0, 0.0)
    z: Vector = (0.0, 0.0, 1.0)

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


class ToolCarrierSettings(DeviceSettings):
    """A fine stage as the carrier of a tool.

    `axes_in_rig` says how the stage's holder is tilted against the rig, `origin_um` where in the rig's frame the tip of
    the tool is when all axes are at 0, `retract_um` which way, in the stage's own axes, leads away from the sample.
    """

    axes_in_rig: AxisDirections = AxisDirections()
    origin_um: Vector | None = None
    retract_um: Vector | None = None

    @pydantic.field_validator("retract_um")
    @classmethod
    def _leads_somewhere(cls, way: Vector | None) -> Vector | None:
        if way is not None and not any(way):
            raise ValueError("retract_um [0, 0, 0] leads nowhere; leave it out, or say which way leads away")
        return way

    @property
    @abstractmethod
    def travel_um(self) -> Mapping[str, Range]:
        """Travel of x, y and z."""

    @property
    def largest_speed_um_s(self) -> float:
        """Of any axis; infinite if the settings do not tell."""
        return math.inf

    @property
    def homing_ends_um(self) -> Mapping[str, float]:
        """Where axes stand after a search for references, of those of which the settings tell."""
        return {}

    @property
    def directions(self) -> Mapping[str, Vector]:
        """Unit vectors of the axes in the rig's frame."""
        return {"x": self.axes_in_rig.x, "y": self.axes_in_rig.y, "z": self.axes_in_rig.z}

    def in_rig(self, way_um: Vector) -> Vector:
        """A way in the stage's axes, in the rig's frame."""
        return place_of_tip((0.0, 0.0, 0.0), self.directions, dict(zip("xyz", way_um, strict=True)))

    def tip_um(self, position_um: Vector) -> Vector | None:
        """Where the tip is in the rig's frame at that position of the axes; None if the rig file does not say."""
        if self.origin_um is None:
            return None
        x, y, z = (a + b for a, b in zip(self.origin_um, self.in_rig(position_um), strict=True))
        return (x, y, z)
