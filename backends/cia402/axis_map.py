"""Between the rig's µm and the drive's counts. Nowhere else are units converted."""

from __future__ import annotations

import math

import msgspec

from microdrivers.backends.cia402.settings import FineAxis
from microdrivers.devices.motion import AxisSpec

_SLACK_COUNTS = 1e-6


class AxisMap(msgspec.Struct, frozen=True, kw_only=True):
    """One axis of the stage and its counterpart in the drive.

    Attributes:
        direction: −1 if the drive's positive sense is the rig's negative one.
        spec: limits, speeds, resolution and tolerance, µm.
        lowest, highest: the last counts inside the travel.
        tolerance: in counts.
    """

    counts_per_um: float
    direction: int
    spec: AxisSpec
    lowest: int
    highest: int
    tolerance: int

    @classmethod
    def from_settings(cls, settings: FineAxis) -> AxisMap:
        """The axis as the rig file describes it."""
        scale = settings.counts_per_um
        ends = sorted(settings.direction * end * scale for end in settings.travel_um)
        spec = AxisSpec(
            unit="µm", min_position=settings.travel_um.min, max_position=settings.travel_um.max,
            max_speed=settings.max_speed_um_s, acceleration=settings.acceleration_um_s2,
            resolution=1.0 / scale, tolerance=settings.tolerance_um,
        )  # fmt: skip
        return cls(
            counts_per_um=scale,
            direction=settings.direction,
            spec=spec,
            lowest=math.ceil(ends[0] - _SLACK_COUNTS),
            highest=math.floor(ends[1] + _SLACK_COUNTS),
            tolerance=math.floor(settings.tolerance_um * scale + _SLACK_COUNTS),
        )

    def position_um(self, counts: int) -> float:
        """A position of the drive in µm of the rig."""
        return self.direction * counts / self.counts_per_um

    def counts(self, position_um: float) -> int:
        """A rig position inside the travel as the nearest count, or the last one inside."""
        nearest = round(self.direction * position_um * self.counts_per_um)
        return min(max(nearest, self.lowest), self.highest)

    def rate(self, um: float) -> int:
        """A speed or an acceleration in counts, at least 1."""
        return max(1, round(um * self.counts_per_um))
