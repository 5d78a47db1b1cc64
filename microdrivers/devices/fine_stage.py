"""The 3-DOF fine stages that carry probe and gripper."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping

from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.core.errors import UnsupportedError
from microdrivers.core.samples import FineStageSample
from microdrivers.devices.motion import Move
from microdrivers.devices.motion_plan import MotionKind, MotionPlan
from microdrivers.devices.stage import Stage

_END_TOLERANCES = 5.0
"""A drive that has found a limit switch rests as far from it as it brakes, some tolerances of a move."""

Vector = tuple[float, float, float]

_log = logging.getLogger(__name__)


def place_of_tip(origin_um: Vector, axes_in_rig: Mapping[str, Vector], position_um: Mapping[str, float]) -> Vector:
    """Where in the rig's frame a tip is that is at `origin_um` when all axes are at 0."""
    x, y, z = origin_um
    for axis, (dx, dy, dz) in axes_in_rig.items():
        way = position_um[axis]
        x, y, z = x + way * dx, y + way * dy, z + way * dz
    return (x, y, z)


class FineStage(Stage[FineStageSample]):
    """A 3-DOF fine stage in its own axes x, y, z (µm); see `Stage`.

    Attributes:
        axes_in_rig: the unit vector of each axis in the rig's frame (a holder may be tilted against the rig).
        origin_um: where the tip of the tool is in the rig's frame when all axes are at 0; None if the rig file does not
            say.
        retract_um: the way, in the stage's own axes, that takes the tool away from the sample; None if the rig file
            states none.
        retraction_share: how much of `retract_um` was free for the last retraction, 0 to 1.
        retraction_at_end: whether the last retraction found all axes of `retract_um` at the end of their travel that
            way already, and nothing else in it.
    """

    sample_type = FineStageSample
    axis_names = ("x", "y", "z")

    axes_in_rig: Mapping[str, Vector] = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
    origin_um: Vector | None = None
    retract_um: Vector | None = None

    def __init__(self, name: str, *, clock: Clock, bus: Bus) -> None:
        super().__init__(name, clock=clock, bus=bus)
        self.retraction_share = 1.0
        self.retraction_at_end = False
        self._retraction: Move[FineStageSample] | None = None
        self._begins_retraction = False

    @property
    def retracting(self) -> bool:
        """Whether the tool is being taken away by `retract()`."""
        move = self._retraction
        return self._begins_retraction or (
            move is not None and move.state == "running" and self.clock.now_ns() < move.deadline_t_ns
        )

    def to_reference(self, axes: Iterable[str]) -> list[str]:
        """As of any stage; what comes before one of them in the order comes first here, since it clears the way."""
        order = self.reference_order
        last = max((order.index(axis) for axis in axes if not self.referenced[axis]), default=-1)
        return [axis for axis in order[: last + 1] if not self.referenced[axis]]

    def tip_um(self, position_um: Mapping[str, float]) -> Vector:
        """Where the tip of the tool is in the rig's frame when the axes are at this position.

        Raises:
            UnsupportedError: the rig file does not say where the tip is.
        """
        if self.origin_um is None:
            raise UnsupportedError(
                "the rig file does not say where the tip of the tool is",
                device=self.name,
                remedy="state origin_um: [x, y, z], the tip in the rig's frame when all axes of this stage are at 0",
            )
        return place_of_tip(self.origin_um, self.axes_in_rig, position_um)

    def move_to(
        self,
        *,
        x_um: float | None = None,
        y_um: float | None = None,
        z_um: float | None = None,
        speed_um_s: float | None = None,
    ) -> FineStageSample:
        """Move to an absolute position and block until settled; returns the observed pose.

        Raises:
            OutOfRange, NotReferenced, LinkLost: before anything moves.
            MotionError: the move began and did not end as asked; the stage was stopped.
        """
        return self.start_move_to(x_um=x_um, y_um=y_um, z_um=z_um, speed_um_s=speed_um_s).wait()

    def move_by(
        self, *, dx_um: float = 0.0, dy_um: float = 0.0, dz_um: float = 0.0, speed_um_s: float | None = None
    ) -> FineStageSample:
        """Move relative to the last target (or the present position if there is none) and block until settled.

        It is sent as an absolute target, once: a failed exchange is never repeated.
        """
        targets = self._shifted({"x": dx_um, "y": dy_um, "z": dz_um})
        return self.move_to(x_um=targets["x"], y_um=targets["y"], z_um=targets["z"], speed_um_s=speed_um_s)

    def start_move_to(
        self,
        *,
        x_um: float | None = None,
        y_um: float | None = None,
        z_um: float | None = None,
        speed_um_s: float | None = None,
    ) -> Move[FineStageSample]:
        """Command an absolute move and return at once; a newer move supersedes an older one.

        `speed_um_s` is the path speed: all axes start and arrive together. Default: the slowest moved axis' fastest.
        """
        return self._start({"x": x_um, "y": y_um, "z": z_um}, speed_um_s, "move")

    def _start(
        self, asked: Mapping[str, float | None], speed_um_s: float | None, kind: MotionKind
    ) -> Move[FineStageSample]:
        def speeds_of(start: Mapping[str, float], targets: Mapping[str, float]) -> dict[str, float]:
            return self._path_speeds(start, targets, self.axis_names, speed_um_s)

        return self._command(asked, speeds_of, kind)

    def retract(self) -> Move[FineStageSample]:
        """Take the tool away from the sample, as fast as the axes allow: by `retract_um` from where it is.

        If the travel ends on the way, or something stands in it, the tool goes as far along the vector as it can, which
        is logged and in `retraction_share`. No force and no lack of force data keeps it from being taken away.

        Raises:
            UnsupportedError: the rig file states no way. NotReferenced, LinkLost: nothing has moved.
        """
        if self.retract_um is None:
            raise UnsupportedError(
                "the rig file does not say which way leads away from the sample",
                device=self.name,
                remedy="state retract_um: [x, y, z] of this stage in its own axes, for example [0, 0, 500]",
            )
        self._begins_retraction = True
        try:
            self._retraction = self._start(self._way_out(self.retract_um), None, "retraction")
        finally:
            self._begins_retraction = False
        return self._retraction

    def _way_out(self, retract_um: Vector) -> dict[str, float | None]:
        """Targets that lie as far along the vector as travel and rules allow."""
        here = self.read().position
        way = dict(zip(self.axis_names, retract_um, strict=True))
        share = min(1.0, *(self._free_share(axis, here[axis], length) for axis, length in way.items()))
        targets = {axis: here[axis] + share * length for axis, length in way.items()}
        plan = MotionPlan(kind="retraction", start=here, targets=targets, sweep={}, straight=True)
        allowed = min((rule.free_share(self, plan) for rule in self.rules), default=1.0)
        self.retraction_at_end = allowed == 1.0 and all(
            self._room(axis, here[axis], length) <= _END_TOLERANCES * self.axes[axis].tolerance
            for axis, length in way.items()
            if length
        )
        share *= allowed
        self.retraction_share = share
        if share < 1.0:
            _log.warning("%s: only %.0f %% of retract_um is free", self.name, 100 * share)
        return {
            axis: self._within(axis, here[axis] + share * length) if length else None for axis, length in way.items()
        }

    def _within(self, axis: str, position: float) -> float:
        """A position that noise or rounding has put beyond the end of the travel, at that end."""
        return min(max(position, self.limits[axis].min), self.limits[axis].max)

    def _free_share(self, axis: str, position: float, length: float) -> float:
        """How much of a way along one axis its travel allows, 0 to 1."""
        return math.inf if length == 0 else self._room(axis, position, length) / abs(length)

    def _room(self, axis: str, position: float, length: float) -> float:
        """How far it is to the end of the travel on the side to which a way leads."""
        limits = self.limits[axis]
        return max(0.0, (limits.max - position) if length > 0 else (position - limits.min))
