"""The sample stage: two linear axes and one rotation."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence

from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.core.errors import NotReferenced, OutOfRange, StaleData
from microdrivers.core.samples import XYThetaSample
from microdrivers.core.units import Range, check_range, seconds_to_ns
from microdrivers.devices.base import Device
from microdrivers.devices.motion import AxisSpec, Move, MoveSlot, move_duration_s

AXES = ("x", "y", "theta")
MOVE_MARGIN_S = 0.5
_RECENT_POSE_S = 0.1


class XYThetaStage(Device[XYThetaSample]):
    """An XYθ stage: µm and degrees, absolute positions valid only after `reference()`.

    The public methods check (finite, within `limits`, referenced, speed) and raise BEFORE anything moves; nothing
    is ever clipped. A driver supplies `_start_move`, `_reference_axis` and the hooks of `Device`, and fills
    `axes` (its limits are the intersection of travel and rig limits) and `settle_s` when it opens.
    """

    sample_type = XYThetaSample

    axes: Mapping[str, AxisSpec]
    settle_s: float = 0.1

    def __init__(self, name: str, *, clock: Clock, bus: Bus) -> None:
        super().__init__(name, clock=clock, bus=bus)
        self._move: MoveSlot[XYThetaSample] = MoveSlot()

    # ------------------------------------------------------------------ what a driver supplies

    @abstractmethod
    def _start_move(self, targets: Mapping[str, float], speeds: Mapping[str, float]) -> None:
        """Command checked absolute targets (µm, deg) with a speed for each moved axis (µm/s, deg/s)."""

    @abstractmethod
    def _reference_axis(self, axis: str) -> None:
        """Reference one axis and return when the device reports that it is done."""

    @property
    @abstractmethod
    def referenced(self) -> Mapping[str, bool]:
        """Whether the reference of each axis is known, as the device last reported."""

    # ------------------------------------------------------------------ public

    @property
    def limits(self) -> Mapping[str, Range]:
        """Travel of each axis, µm or degrees."""
        return {name: Range(axis.min_position, axis.max_position) for name, axis in self.axes.items()}

    @property
    def max_speed(self) -> Mapping[str, float]:
        """Largest speed of each axis, µm/s or deg/s."""
        return {name: axis.max_speed for name, axis in self.axes.items()}

    @property
    def resolution(self) -> Mapping[str, float]:
        """Smallest commanded step of each axis, µm or degrees."""
        return {name: axis.resolution for name, axis in self.axes.items()}

    def move_to(
        self,
        *,
        x_um: float | None = None,
        y_um: float | None = None,
        theta_deg: float | None = None,
        speed_um_s: float | None = None,
        theta_speed_deg_s: float | None = None,
    ) -> XYThetaSample:
        """Move to an absolute position and block until settled; returns the observed pose.

        Raises:
            OutOfRange, NotReferenced, LinkLost: before anything moves.
            MotionError: the move began and did not end as asked; the stage was stopped.
        """
        move = self.start_move_to(
            x_um=x_um,
            y_um=y_um,
            theta_deg=theta_deg,
            speed_um_s=speed_um_s,
            theta_speed_deg_s=theta_speed_deg_s,
        )
        return move.wait()

    def move_by(
        self,
        *,
        dx_um: float = 0.0,
        dy_um: float = 0.0,
        dtheta_deg: float = 0.0,
        speed_um_s: float | None = None,
        theta_speed_deg_s: float | None = None,
    ) -> XYThetaSample:
        """Move relative to the last target (or the present pose if there is none) and block until settled.

        It is sent as an absolute target, once: a failed exchange is never repeated.
        """
        pose = self.read()
        last = {"x": pose.target_x_um, "y": pose.target_y_um, "theta": pose.target_theta_deg}
        base = {axis: last[axis] if math.isfinite(last[axis]) else here for axis, here in position_of(pose).items()}
        return self.move_to(
            x_um=base["x"] + dx_um if dx_um else None,
            y_um=base["y"] + dy_um if dy_um else None,
            theta_deg=base["theta"] + dtheta_deg if dtheta_deg else None,
            speed_um_s=speed_um_s,
            theta_speed_deg_s=theta_speed_deg_s,
        )

    def start_move_to(
        self,
        *,
        x_um: float | None = None,
        y_um: float | None = None,
        theta_deg: float | None = None,
        speed_um_s: float | None = None,
        theta_speed_deg_s: float | None = None,
    ) -> Move[XYThetaSample]:
        """Command an absolute move and return at once; a newer move supersedes an older one.

        `speed_um_s` is the path speed in the xy plane: x and y arrive together. Default: as fast as the axes allow.
        """
        with self._naming_errors():
            self._require_open()
            asked = {"x": x_um, "y": y_um, "theta": theta_deg}
            targets = {axis: value for axis, value in asked.items() if value is not None}
            self._check_targets(targets)
            start = position_of(self._recent_pose())
            speeds = self._axis_speeds(start, targets, speed_um_s, theta_speed_deg_s)
            stops_before = self._move.supersede()
            self._start_move(targets, speeds)
        return self._move.hold(self._supervise(start, targets, speeds), stops_before)

    def reference(self, axes: Sequence[str]) -> None:
        """Find the reference of the named axes, in exactly that order. Moves the stage to its switches.

        Raises:
            OutOfRange: an unknown or repeated axis. DeviceFault, NotReached: referencing failed.
        """
        with self._naming_errors():
            self._require_open()
            if not axes or len(set(axes)) != len(axes) or not set(axes) <= set(AXES):
                raise OutOfRange(f"axes to reference: {', '.join(axes) or 'none'}", remedy="name x, y, theta once each")
            self._move.supersede()
            for axis in axes:
                self._reference_axis(axis)
                self._publish_event("reference_found", reason=f"axis {axis}")

    def stop(self, *, by: str = "user", reason: str = "") -> None:
        """Stop all axes now; a running `Move` ends as cancelled."""
        self._move.stopped()
        super().stop(by=by, reason=reason)

    # ------------------------------------------------------------------ checks and supervision

    def _check_targets(self, targets: Mapping[str, float]) -> None:
        if not targets:
            raise OutOfRange("a move needs at least one target", remedy="give x_um, y_um or theta_deg")
        for axis, target in targets.items():
            unit = self.axes[axis].unit
            check_range(target, self.limits[axis], what=f"target of axis {axis}", unit=unit, device=self.name)
        unknown = [axis for axis in targets if not self.referenced[axis]]
        if unknown:
            raise NotReferenced(
                f"the reference of axis {', '.join(unknown)} is not known, so no absolute move is possible",
                remedy=f"make sure that the way is free, then reference({unknown!r})",
            )

    def _recent_pose(self) -> XYThetaSample:
        try:
            return self.latest(max_age_s=_RECENT_POSE_S)
        except StaleData:
            return self.read()

    def _axis_speeds(
        self,
        start: Mapping[str, float],
        targets: Mapping[str, float],
        speed_um_s: float | None,
        theta_speed_deg_s: float | None,
    ) -> dict[str, float]:
        """Split the path speed so that x and y arrive together; slow the path where an axis cannot follow."""
        distance = {axis: abs(targets[axis] - start[axis]) for axis in targets}
        speeds: dict[str, float] = {}
        linear = [axis for axis in ("x", "y") if axis in targets]
        path_um = math.hypot(*(distance[axis] for axis in linear))
        if linear:
            fastest = min(self.max_speed[axis] for axis in linear)
            asked = fastest if speed_um_s is None else speed_um_s
            check_range(asked, Range(1e-3, fastest), what="speed", unit="µm/s", device=self.name)
            for axis in linear:
                share = distance[axis] / path_um if path_um > 0 else 1.0
                speeds[axis] = max(asked * share, self.axes[axis].resolution)
        if "theta" in targets:
            fastest = self.max_speed["theta"]
            asked = fastest if theta_speed_deg_s is None else theta_speed_deg_s
            speeds["theta"] = check_range(
                asked, Range(1e-6, fastest), what="theta speed", unit="deg/s", device=self.name
            )
        return speeds

    def _supervise(
        self, start: Mapping[str, float], targets: Mapping[str, float], speeds: Mapping[str, float]
    ) -> Move[XYThetaSample]:
        longest_s = max(
            move_duration_s(
                distance=abs(targets[axis] - start[axis]),
                speed=speeds[axis],
                acceleration=self.axes[axis].acceleration,
            )
            for axis in targets
        )
        deadline_s = 1.2 * longest_s + self.settle_s + MOVE_MARGIN_S
        return Move(
            device=self.name,
            clock=self.clock,
            read=self.read,
            position_of=position_of,
            arrived=lambda sample: sample.on_target and not sample.moving,
            referenced=lambda _sample: all(self.referenced[axis] for axis in targets),
            stop=lambda: XYThetaStage.stop(self, by="supervision", reason="move failed or cancelled"),
            target=targets,
            start=start,
            axes=self.axes,
            deadline_t_ns=self.clock.now_ns() + seconds_to_ns(deadline_s),
        )


def position_of(pose: XYThetaSample) -> dict[str, float]:
    """The pose as a mapping from axis name to µm or degrees."""
    return {"x": pose.x_um, "y": pose.y_um, "theta": pose.theta_deg}
