"""What moving devices share: deadlines, and a supervised wait that believes only what it observes."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Generic, Literal, NamedTuple

import msgspec

from microdrivers.core.clock import Clock
from microdrivers.core.errors import MoveCancelled, MoveSuperseded, NotReached, ReferenceLost, WrongDirection
from microdrivers.core.samples import SampleT
from microdrivers.core.units import NS_PER_S, seconds_to_ns

MoveState = Literal["running", "done", "superseded", "cancelled", "failed"]

WRONG_WAY_FRACTION = 0.2
"""An axis whose distance to its target grows by this share of the whole move (and by more than its tolerance)
moves the wrong way, once it is also more than full speed needs for braking."""


class AxisSpec(msgspec.Struct, frozen=True, kw_only=True):
    """What a supervised move must know of one axis; `unit` is µm or deg.

    `resolution` is the smallest commanded step, `tolerance` what counts as arrived.
    """

    unit: str
    min_position: float
    max_position: float
    max_speed: float
    acceleration: float
    resolution: float
    tolerance: float


class StopNote(NamedTuple):
    """Who stopped a device, why, and what to do about it; empty where nobody has said."""

    by: str = ""
    reason: str = ""
    remedy: str = ""

    def explain(self, error: MoveCancelled) -> MoveCancelled:
        """Add it to the error of what was stopped."""
        if self.reason and self.reason not in error.what:
            error.what = f"{error.what} ({self.by}: {self.reason})"
            error.remedy = self.remedy or error.remedy
        return error


def move_duration_s(*, distance: float, speed: float, acceleration: float) -> float:
    """Duration of a trapezoidal profile from rest to rest; the three share one length unit."""
    if distance <= 0:
        return 0.0
    if distance < speed * speed / acceleration:
        return 2.0 * math.sqrt(distance / acceleration)
    return distance / speed + speed / acceleration


class Move(Generic[SampleT]):
    """A move under way. `wait()` polls the device on the clock and returns the settled sample.

    A newer move of the same device supersedes this one; `stop()` cancels it.

    Attributes:
        due_ns: when each axis should be at rest at the latest, also axes that an older move still has on their way: a
            device is settled once all its axes are.
        deadline_t_ns: the latest of these.
    """

    def __init__(
        self,
        *,
        device: str,
        clock: Clock,
        read: Callable[[], SampleT],
        position_of: Callable[[SampleT], Mapping[str, float]],
        arrived: Callable[[SampleT], bool],
        referenced: Callable[[SampleT], bool],
        stop: Callable[[], None],
        target: Mapping[str, float],
        start: Mapping[str, float],
        axes: Mapping[str, AxisSpec],
        deadline_t_ns: int,
        others_due_ns: Mapping[str, int] | None = None,
        poll_s: float = 0.02,
    ) -> None:
        self.target = dict(target)
        self.due_ns = {**(others_due_ns or {}), **dict.fromkeys(target, deadline_t_ns)}
        self.deadline_t_ns = max(self.due_ns.values())
        self.state: MoveState = "running"
        self.stop_note = StopNote()
        self._device = device
        self._clock = clock
        self._read = read
        self._position_of = position_of
        self._arrived = arrived
        self._referenced = referenced
        self._stop = stop
        self._start = dict(start)
        self._axes = axes
        self._poll_s = poll_s

    @property
    def done(self) -> bool:
        """Whether the move was seen to end at its target."""
        return self.state == "done"

    def supersede(self) -> None:
        """A newer move has been commanded."""
        if self.state == "running":
            self.state = "superseded"

    def cancel(self) -> None:
        """Stop the device and give the move up."""
        if self.state == "running":
            self.state = "cancelled"
            self._stop()

    def mark_stopped(self, note: StopNote) -> None:
        """The device was stopped by somebody."""
        if self.state == "running":
            self.stop_note = note
            self.state = "cancelled"

    def wait(self, timeout_s: float | None = None) -> SampleT:
        """Wait until the device is settled at the target and within tolerance of it.

        Raises:
            MoveSuperseded, MoveCancelled: it was replaced or stopped; by whom and why, if they said so.
            WrongDirection: an axis moves away from its target; the device was stopped.
            ReferenceLost: the device forgot its reference on the way, as after a power failure; it was stopped.
            NotReached: the deadline (or `timeout_s`) passed; the device was stopped.
        """
        limit_ns = self.deadline_t_ns
        if timeout_s is not None:
            limit_ns = min(limit_ns, self._clock.now_ns() + seconds_to_ns(timeout_s))
        while (sample := self._look(limit_ns)) is None:
            self._clock.sleep(self._poll_s)
        return sample

    def look(self) -> SampleT | None:
        """Look at the device once, without waiting: the settled sample, or None while the move is under way.

        Raises:
            MotionError: as `wait`.
        """
        return self._look(self.deadline_t_ns)

    def _look(self, limit_ns: int) -> SampleT | None:
        sample = self._read()
        self._raise_if_ended()
        position = self._position_of(sample)
        if self._arrived(sample) and not self._misses(position):
            self.state = "done"
            return sample
        self._stop_if_reference_lost(sample)
        self._stop_if_wrong_way(position)
        if self._clock.now_ns() >= limit_ns:
            self._fail_unreached(position, limit_ns)
        return None

    def _raise_if_ended(self) -> None:
        if self.state == "superseded":
            raise MoveSuperseded("a newer move replaced this one", device=self._device)
        if self.state == "cancelled":
            raise self.stop_note.explain(
                MoveCancelled(
                    "the move was stopped before it reached its target",
                    device=self._device,
                    remedy="check why the stop was requested, read the position, then command a new move",
                )
            )

    def _misses(self, position: Mapping[str, float]) -> list[str]:
        return [
            f"{axis} is at {position[axis]:.4g} {self._axes[axis].unit}, "
            f"{position[axis] - goal:+.3g} from its target {goal:.6g}"
            for axis, goal in self.target.items()
            if not abs(position[axis] - goal) <= self._axes[axis].tolerance
        ]

    def _stop_if_reference_lost(self, sample: SampleT) -> None:
        if self._referenced(sample):
            return
        self.state = "failed"
        self._stop()
        raise ReferenceLost(
            "the reference was lost during the move; stopped",
            device=self._device,
            remedy="check the controller's power, make sure that the way is free, then reference()",
        )

    def _stop_if_wrong_way(self, position: Mapping[str, float]) -> None:
        for axis, goal in self.target.items():
            spec = self._axes[axis]
            distance = abs(self._start[axis] - goal)
            excess = abs(position[axis] - goal) - distance
            # A move that supersedes another may first have to brake from full speed.
            braking = spec.max_speed**2 / spec.acceleration
            if excess > WRONG_WAY_FRACTION * distance + braking + 10 * spec.tolerance:
                self.state = "failed"
                self._stop()
                raise WrongDirection(
                    f"axis {axis} moved away from its target by {excess:.3g} {spec.unit}; stopped",
                    device=self._device,
                    remedy=f"check the sign and the unit of axis {axis} in the rig file, and the encoder",
                )

    def _fail_unreached(self, position: Mapping[str, float], limit_ns: int) -> None:
        self.state = "failed"
        self._stop()
        missing = "; ".join(self._misses(position)) or "the device never reported on target"
        late_s = (self._clock.now_ns() - limit_ns) / NS_PER_S
        raise NotReached(
            f"the move did not end in time ({late_s:.2g} s past its deadline): {missing}; stopped",
            device=self._device,
            remedy="check servo, load, obstacles and the speed in the rig file",
        )


class MoveSlot(Generic[SampleT]):
    """The one move that a device may have under way.

    A stop may come from any thread, also between commanding a move and putting it here: it counts all the same.

    Attributes:
        stops: how often the device was stopped. last_stop: by whom and why the last time.
    """

    def __init__(self) -> None:
        self.stops = 0
        self.last_stop = StopNote()
        self._current: Move[SampleT] | None = None
        self._commanding = 0
        self._counting = threading.Lock()

    @property
    def due_ns(self) -> Mapping[str, int]:
        """`Move.due_ns` of what is under way: also of a move that was superseded, for its axes go on."""
        move = self._current
        return move.due_ns if move is not None and move.state in ("running", "superseded") else {}

    @property
    def commanding(self) -> bool:
        """Whether somebody is about to set the device in motion, or is searching a reference."""
        return self._commanding > 0

    @contextmanager
    def begin(self) -> Iterator[int]:
        """While the context is open somebody sets the device in motion; gives what `stops` was before."""
        with self._counting:
            self._commanding += 1
        stops_before = self.stops
        try:
            yield stops_before
        except MoveCancelled as error:
            if self.stops != stops_before:
                self.last_stop.explain(error)
            raise
        finally:
            with self._counting:
                self._commanding -= 1

    def refuse_after_stop(self, stops_before: int) -> None:
        """Go on only if nobody has stopped the device since.

        Raises:
            MoveCancelled: somebody has; nothing was commanded.
        """
        if self.stops != stops_before:
            raise MoveCancelled(
                "a stop was sent while the move was being prepared", moved="no",
                remedy="check why the stop was requested, then command a new move",
            )  # fmt: skip

    def supersede(self) -> int:
        """A newer move is about to be commanded; returns what `hold` needs to know whether a stop came meanwhile."""
        if self._current is not None:
            self._current.supersede()
        return self.stops

    def hold(self, move: Move[SampleT], stops_before: int) -> Move[SampleT]:
        """The newer move has been commanded."""
        self._current = move
        if self.stops != stops_before:
            move.mark_stopped(self.last_stop)
        return move

    def stopped(self, note: StopNote | None = None) -> None:
        """The device is being stopped."""
        self.last_stop = note or StopNote()
        self.stops += 1
        if self._current is not None:
            self._current.mark_stopped(self.last_stop)
