"""What moving devices share: deadlines, and a supervised wait that believes only what it observes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Generic, Literal

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
        poll_s: float = 0.02,
    ) -> None:
        self.target = dict(target)
        self.deadline_t_ns = deadline_t_ns
        self.state: MoveState = "running"
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

    def mark_stopped(self) -> None:
        """The device was stopped by somebody."""
        if self.state == "running":
            self.state = "cancelled"

    def wait(self, timeout_s: float | None = None) -> SampleT:
        """Wait until the device is settled at the target and within tolerance of it.

        Raises:
            MoveSuperseded, MoveCancelled: it was replaced or stopped.
            WrongDirection: an axis moves away from its target; the device was stopped.
            ReferenceLost: the device forgot its reference on the way, as after a power failure; it was stopped.
            NotReached: the deadline (or `timeout_s`) passed; the device was stopped.
        """
        limit_ns = self.deadline_t_ns
        if timeout_s is not None:
            limit_ns = min(limit_ns, self._clock.now_ns() + seconds_to_ns(timeout_s))
        while True:
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
            self._clock.sleep(self._poll_s)

    def _raise_if_ended(self) -> None:
        if self.state == "superseded":
            raise MoveSuperseded("a newer move replaced this one", device=self._device)
        if self.state == "cancelled":
            raise MoveCancelled(
                "the move was stopped before it reached its target",
                device=self._device,
                remedy="check why the stop was requested, read the position, then command a new move",
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
            remedy="check the controller's power, make sure that the way is free, then reference again",
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
    """

    def __init__(self) -> None:
        self._current: Move[SampleT] | None = None
        self._stops = 0

    def supersede(self) -> int:
        """A newer move is about to be commanded; returns what `hold` needs to know whether a stop came meanwhile."""
        if self._current is not None:
            self._current.supersede()
        return self._stops

    def hold(self, move: Move[SampleT], stops_before: int) -> Move[SampleT]:
        """The newer move has been commanded."""
        self._current = move
        if self._stops != stops_before:
            move.mark_stopped()
        return move

    def stopped(self) -> None:
        """The device is being stopped."""
        self._stops += 1
        if self._current is not None:
            self._current.mark_stopped()
