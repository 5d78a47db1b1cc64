"""The straight way on which a tool meets the specimen."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from microdrivers.core.errors import ConfigError
from microdrivers.devices.fine_stage import FineStage
from microdrivers.devices.force_sensor import ForceSensor
from microdrivers.devices.motion_plan import MotionPlan

_SMALLEST_SHARE = 1e-6


class ProbingWay:
    """A line through a starting point, against the direction in which a push on the tip reads positive.

    Places on it are µm of the tip's travel in the rig's frame, into the specimen; the stage's axes may be tilted.

    Attributes:
        path_per_um: the stage's way for each µm of the tip's.

    Raises:
        ConfigError: the stage's axes do not span the rig's frame.
    """

    def __init__(self, stage: FineStage, sensor: ForceSensor, start_um: Mapping[str, float]) -> None:
        self._stage = stage
        self._start_um = dict(start_um)
        directions = np.array([stage.axes_in_rig[axis] for axis in stage.axis_names]).T
        try:
            shares = np.linalg.solve(directions, -np.array(sensor.axis))
        except np.linalg.LinAlgError as error:
            raise ConfigError(
                f"the axes of {stage.name} lie in one plane", remedy="correct its axes_in_rig in the rig file"
            ) from error
        self._shares: dict[str, float] = {
            axis: float(share)
            for axis, share in zip(stage.axis_names, shares, strict=True)
            if abs(share) > _SMALLEST_SHARE
        }
        self.path_per_um = float(np.hypot.reduce(list(self._shares.values())))

    @property
    def largest_speed_um_s(self) -> float:
        """Of the tip, as the axes allow."""
        return min(self._stage.max_speed[axis] for axis in self._shares) / self.path_per_um

    @property
    def step_um(self) -> float:
        """The smallest step along the way that the stage's encoders tell."""
        steps = [abs(share) * self._stage.resolution[axis] for axis, share in self._shares.items()]
        return float(np.hypot.reduce(steps)) / self.path_per_um**2

    def targets(self, place_um: float) -> dict[str, float]:
        """Targets of the stage's axes (`x_um=…`) for a place on the way."""
        return {f"{axis}_um": self._start_um[axis] + share * place_um for axis, share in self._shares.items()}

    def path_speed_um_s(self, speed_um_s: float) -> float:
        """The stage's path speed that moves the tip at this speed."""
        return speed_um_s * self.path_per_um

    def place_um(self, position_um: Mapping[str, float]) -> float:
        """How far along the way a position of the stage is."""
        along = sum(share * (position_um[axis] - self._start_um[axis]) for axis, share in self._shares.items())
        return along / self.path_per_um**2

    def longest_um(self, *, back: bool = False) -> float:
        """How far the way goes on from the start, or back from it, until an axis' travel ends."""
        rooms = []
        for axis, share in self._shares.items():
            limits = self._stage.limits[axis]
            end = limits.max if (share > 0) != back else limits.min
            rooms.append((end - self._start_um[axis]) / (-share if back else share))
        return min(rooms)

    def plans(self, *places_um: float) -> Iterator[MotionPlan]:
        """The straight moves from the start to the first place, and on to the others."""
        here = self._start_um
        for place_um in places_um:
            goal = {axis: self._start_um[axis] + share * place_um for axis, share in self._shares.items()}
            yield MotionPlan(kind="move", start=here, targets=goal, sweep={}, straight=True)
            here = here | goal
