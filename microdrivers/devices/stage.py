"""What stages of several axes share: checks before anything moves, referencing in order, supervised moves."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar, Protocol, TypeVar

from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.core.errors import NotReferenced, OutOfRange, StaleData
from microdrivers.core.samples import PoseSample
from microdrivers.core.units import Range, check_range, seconds_to_ns
from microdrivers.devices.base import Device
from microdrivers.devices.motion import AxisSpec, Move, MoveSlot, StopNote, move_duration_s
from microdrivers.devices.motion_plan import MotionKind, MotionPlan

MOVE_MARGIN_S = 0.5
_RECENT_AT_REST_S = 0.1
_RECENT_IN_MOTION_S = 0.03
"""How old a pose may be that a move is said to start from: at full speed a stage gets less far than it brakes."""
_SLOWEST_UM_S = 1e-3

PoseT = TypeVar("PoseT", bound=PoseSample)


class MotionRule(Protocol):
    """A rule of the rig for a stage's motion, asked before anything moves."""

    def check(self, stage: Stage[Any], plan: MotionPlan) -> None:
        """Let the motion pass.

        Raises:
            UnsafeError: the rule forbids it.
        """

    def free_share(self, stage: Stage[Any], plan: MotionPlan) -> float:
        """How much of the way from the start is allowed, 0 to 1."""

    def found_references(self, stage: Stage[Any]) -> None:
        """A search for references has succeeded; the stage is where the drives have left it."""


class Stage(Device[PoseT]):
    """A stage of several axes: absolute positions are valid only after `reference()`.

    The public methods check (finite, within `limits`, referenced, speed) and raise BEFORE anything moves; nothing is
    ever clipped. A driver supplies `_start_move`, `_reference_axis`, `referenced` and the hooks of `Device`, and fills
    `axes` (its limits are the intersection of travel and rig limits) and `settle_s` when it opens.

    Attributes:
        axis_names: all axes, in their order.
        axes: what is known of each.
        settle_s: how long a move may take to settle after its profile has ended.
        rules: what the rig allows, asked after the stage's own checks and before anything moves.
    """

    axis_names: ClassVar[tuple[str, ...]]

    axes: Mapping[str, AxisSpec]
    settle_s: float = 0.1

    def __init__(self, name: str, *, clock: Clock, bus: Bus) -> None:
        super().__init__(name, clock=clock, bus=bus)
        self.rules: tuple[MotionRule, ...] = ()
        self._move: MoveSlot[PoseT] = MoveSlot()
        self._commanded_ns = -1
        self._fastest: dict[str, float] = {}

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

    @property
    def reference_order(self) -> tuple[str, ...]:
        """The order in which all axes are referenced where nobody names another."""
        return self.axis_names

    def to_reference(self, axes: Iterable[str]) -> list[str]:
        """What to call `reference()` with so that these axes have their reference, as far as they have none."""
        return [axis for axis in self.reference_order if axis in set(axes) and not self.referenced[axis]]

    def start_axis_to(self, axis: str, position: float, *, speed: float) -> Move[PoseT]:
        """Move one axis by its name, in its own unit (µm, deg) and speed (µm/s, deg/s); otherwise as `start_move_to`.

        Raises:
            OutOfRange, NotReferenced, LinkLost: before anything moves.
        """
        if axis not in self.axes:
            raise OutOfRange(f"there is no axis {axis!r}", device=self.name, remedy=f"name one of {list(self.axes)}")
        limits, unit = Range(_SLOWEST_UM_S, self.max_speed[axis]), self.axes[axis].unit
        what = f"speed of axis {axis}"
        check_range(speed, limits, what=what, unit=f"{unit}/s", device=self.name, in_file="max")
        return self._command({axis: position}, lambda _start, _targets: {axis: speed})

    @property
    def may_be_moving(self) -> bool:
        """Whether something was commanded, or is being searched, that is not known to have ended."""
        return self._move.commanding or self.clock.now_ns() < max(self._move.due_ns.values(), default=-1)

    @property
    def being_commanded(self) -> bool:
        """Whether somebody is about to set the stage in motion, or is searching a reference."""
        return self._move.commanding

    @property
    def commanded_ns(self) -> int:
        """When the last move had been commanded, ns; −1 before the first."""
        return self._commanded_ns

    @property
    def braking_s(self) -> float:
        """How long it may take to come to rest, were it told to now: from the speeds that were commanded last."""
        return max(self._fastest.get(name, axis.max_speed) / axis.acceleration for name, axis in self.axes.items())

    def reference(self, axes: Sequence[str]) -> None:
        """Find the reference of the named axes, in exactly that order. Moves the stage to its switches.

        Raises:
            OutOfRange: an unknown or repeated axis. UnsafeError: a rule of the rig forbids it now.
            DeviceFault, NotReached: referencing failed. MoveCancelled: it was stopped.
        """
        with self._naming_errors(), self._move.begin() as stops_before:
            self._require_open()
            if not axes or len(set(axes)) != len(axes) or not set(axes) <= set(self.axis_names):
                raise OutOfRange(
                    f"axes to reference: {', '.join(axes) or 'none'}",
                    remedy=f"name {', '.join(self.axis_names)} once each",
                )
            self._ask_rules(MotionPlan(kind="reference", start={}, targets={}, sweep={}, straight=False))
            self._move.supersede()
            self._fastest = {}
            for axis in axes:
                self._move.refuse_after_stop(stops_before)
                self._reference_axis(axis)
                self._publish_event("reference_found", reason=f"axis {axis}")
        for rule in self.rules:
            rule.found_references(self)

    def stop(self, *, by: str = "user", reason: str = "", remedy: str = "") -> None:
        """Stop all axes now; a running `Move` ends as cancelled, which tells these three."""
        self._move.stopped(StopNote(by, reason, remedy))
        super().stop(by=by, reason=reason)

    # ------------------------------------------------------------------ for the kinds of stages

    def _command(
        self,
        asked: Mapping[str, float | None],
        speeds_of: Callable[[Mapping[str, float], Mapping[str, float]], dict[str, float]],
        kind: MotionKind = "move",
    ) -> Move[PoseT]:
        """Check targets, command them and supervise; `speeds_of` splits the speed for a start and its targets."""
        with self._naming_errors(), self._move.begin() as stops_before:
            self._require_open()
            targets = {axis: value for axis, value in asked.items() if value is not None}
            self._check_targets(targets)
            pose = self._recent_pose()
            start = pose.position
            speeds = speeds_of(start, targets)
            plan, fastest = self._plan(pose, targets, speeds, kind)
            self._ask_rules(plan)
            self._move.refuse_after_stop(stops_before)
            self._move.supersede()
            self._fastest = fastest
            try:
                self._start_move(targets, speeds)
            finally:
                self._commanded_ns = self.clock.now_ns()
            if self._move.stops != stops_before:
                self._stop()  # it may have reached the device before the move
            return self._move.hold(self._supervise(start, targets, speeds), stops_before)

    def _shifted(self, shifts: Mapping[str, float]) -> dict[str, float | None]:
        """Absolute targets that lie so far from the last targets, or from the present position if there is none."""
        pose = self.read()
        last, here = pose.target, pose.position
        return {
            axis: (last[axis] if math.isfinite(last[axis]) else here[axis]) + shift if shift else None
            for axis, shift in shifts.items()
        }

    def _path_speeds(
        self, start: Mapping[str, float], targets: Mapping[str, float], axes: Sequence[str], speed_um_s: float | None
    ) -> dict[str, float]:
        """Split a path speed so that the linear `axes` that move arrive together.

        Default is the speed of the slowest of them.
        """
        moved = [axis for axis in axes if axis in targets]
        if not moved:
            return {}
        distance = {axis: abs(targets[axis] - start[axis]) for axis in moved}
        path_um = math.hypot(*distance.values())
        fastest = min(self.max_speed[axis] for axis in moved)
        asked = fastest if speed_um_s is None else speed_um_s
        limits = Range(_SLOWEST_UM_S, fastest)
        check_range(asked, limits, what="speed", unit="µm/s", device=self.name, in_file="max")
        shares = {axis: distance[axis] / path_um if path_um > 0 else 1.0 for axis in moved}
        return {axis: max(asked * share, self.axes[axis].resolution) for axis, share in shares.items()}

    # ------------------------------------------------------------------ checks and supervision

    def _check_targets(self, targets: Mapping[str, float]) -> None:
        if not targets:
            raise OutOfRange(
                "a move needs at least one target, or a distance that is not 0",
                remedy=f"give one of {', '.join(self.axis_names)} with its unit",
            )
        for axis, target in targets.items():
            unit = self.axes[axis].unit
            check_range(target, self.limits[axis], what=f"target of axis {axis}", unit=unit, device=self.name)
        unknown = [axis for axis in self.reference_order if axis in targets and not self.referenced[axis]]
        if unknown:
            raise NotReferenced(
                f"the reference of axis {', '.join(unknown)} is not known, so its limits cannot be kept: it moves "
                "neither to a position nor by a distance",
                remedy=f"make sure that the way is free, then reference({self.to_reference(unknown)!r})",
            )

    def _ask_rules(self, plan: MotionPlan) -> None:
        for rule in self.rules:
            rule.check(self, plan)

    def _plan(
        self, pose: PoseT, targets: Mapping[str, float], speeds: Mapping[str, float], kind: MotionKind
    ) -> tuple[MotionPlan, dict[str, float]]:
        """What a move will sweep, and how fast each axis may then be.

        One that does not begin at rest brakes first, from any speed that was commanded since.
        """
        start, sweep, fastest = pose.position, {}, {}
        path_speed = math.hypot(*speeds.values())
        for axis, spec in self.axes.items():
            goal, speed, now = targets.get(axis, start[axis]), speeds.get(axis, 0.0), 0.0
            if pose.moving:
                now = self._fastest.get(axis, spec.max_speed)
                speed = max(now, path_speed if axis in targets else 0.0)
                older = pose.target[axis]
                goal = goal if axis in targets or math.isnan(older) else older
            aside = now * _RECENT_IN_MOTION_S + now * now / (2.0 * spec.acceleration)
            sweep[axis] = Range(min(start[axis] - aside, goal), max(start[axis] + aside, goal))
            fastest[axis] = min(speed, spec.max_speed)
        plan = MotionPlan(
            kind=kind, start=start, targets=targets, sweep=sweep, straight=not pose.moving,
            speed_um_s=math.hypot(*(speed for axis, speed in speeds.items() if self.axes[axis].unit == "µm")),
        )  # fmt: skip
        return plan, fastest

    def _recent_pose(self) -> PoseT:
        newest = self.topic.latest
        rests = newest is not None and not newest.moving and newest.t_ns > self._commanded_ns
        try:
            return self.latest(max_age_s=_RECENT_AT_REST_S if rests else _RECENT_IN_MOTION_S)
        except StaleData:
            return self.read()

    def _supervise(
        self, start: Mapping[str, float], targets: Mapping[str, float], speeds: Mapping[str, float]
    ) -> Move[PoseT]:
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
            position_of=lambda sample: sample.position,
            arrived=lambda sample: sample.on_target and not sample.moving,
            referenced=lambda _sample: all(self.referenced[axis] for axis in targets),
            stop=lambda: Stage.stop(self, by="supervision", reason="move failed or cancelled"),
            target=targets,
            start=start,
            axes=self.axes,
            deadline_t_ns=self.clock.now_ns() + seconds_to_ns(deadline_s),
            others_due_ns=self._move.due_ns,
        )
