"""The motorised zoom of a microscope."""

from __future__ import annotations

import bisect
import itertools
import math
from abc import abstractmethod
from collections.abc import Sequence
from functools import partial
from typing import Literal

import msgspec

from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.core.errors import NotReferenced, OutOfRange
from microdrivers.core.samples import ZoomSample
from microdrivers.core.units import Range, check_range, seconds_to_ns
from microdrivers.devices.base import Device
from microdrivers.devices.motion import AxisSpec, Move, MoveSlot

Approach = Literal["below", "above", "direct"]
"""From which side a target is approached: `below` and `above` overshoot first where needed to take up backlash."""


class ZoomCurve(msgspec.Struct, frozen=True):
    """Monotone table between motor steps and zoom; interpolated in log(zoom), the natural law of a zoom body.

    `steps` strictly increases, `zoom` strictly increases and is positive.
    """

    steps: tuple[int, ...]
    zoom: tuple[float, ...]

    @classmethod
    def from_points(cls, points: Sequence[tuple[int, float]]) -> ZoomCurve:
        """Build and check a curve.

        Raises:
            OutOfRange: fewer than two points, or not strictly increasing, or a zoom that is not positive.
        """
        steps = tuple(step for step, _ in points)
        zoom = tuple(value for _, value in points)
        rising = all(a < b for column in (steps, zoom) for a, b in itertools.pairwise(column))
        if len(points) < 2 or not rising or zoom[0] <= 0:
            raise OutOfRange(
                f"a zoom curve needs two or more points with rising steps and rising positive zoom, not {list(points)}",
                remedy="list [steps, zoom] pairs from the lowest zoom to the highest",
            )
        return cls(steps, zoom)

    def zoom_at(self, position_steps: float) -> float:
        """Zoom at a motor position; the end segments are continued beyond the table, to infinity at the very last."""
        i = min(max(bisect.bisect_right(self.steps, position_steps) - 1, 0), len(self.steps) - 2)
        share = (position_steps - self.steps[i]) / (self.steps[i + 1] - self.steps[i])
        try:
            return float(self.zoom[i] * (self.zoom[i + 1] / self.zoom[i]) ** share)
        except OverflowError:
            return math.inf

    def steps_at(self, zoom: float) -> int:
        """Motor position of a zoom, rounded to the nearest step.

        Raises:
            OutOfRange: the zoom is outside the table.
        """
        check_range(zoom, Range(self.zoom[0], self.zoom[-1]), what="zoom", unit="x")
        i = min(max(bisect.bisect_right(self.zoom, zoom) - 1, 0), len(self.zoom) - 2)
        share = math.log(zoom / self.zoom[i]) / math.log(self.zoom[i + 1] / self.zoom[i])
        return round(self.steps[i] + share * (self.steps[i + 1] - self.steps[i]))


class ZoomMotor(Device[ZoomSample]):
    """A zoom motor. `zoom` is the reading of the zoom body; the objective is not in it.

    A driver supplies `_start_move`, `_reference`, `referenced` and the hooks of `Device`, and fills `curve`,
    `zoom_range`, `axis` (in steps) and `backlash_steps`.
    """

    sample_type = ZoomSample

    curve: ZoomCurve
    zoom_range: Range
    axis: AxisSpec
    settle_s: float = 0.1

    def __init__(self, name: str, *, clock: Clock, bus: Bus) -> None:
        super().__init__(name, clock=clock, bus=bus)
        self._move: MoveSlot[ZoomSample] = MoveSlot()

    @abstractmethod
    def _start_move(self, position_steps: int) -> None:
        """Command a checked absolute position."""

    @abstractmethod
    def _reference(self) -> None:
        """Find the reference; returns when done."""

    @property
    @abstractmethod
    def referenced(self) -> bool:
        """Whether the absolute position is known, as the device last reported."""

    @abstractmethod
    def _approach_steps(self, start_steps: int, target_steps: int, approach: Approach) -> int | None:
        """An intermediate position that takes up the backlash, or None if the direct way is right."""

    def move_to(self, *, zoom: float, approach: Approach = "below") -> ZoomSample:
        """Move to a zoom and block until settled; returns the observed state.

        Raises:
            OutOfRange, NotReferenced, LinkLost: before anything moves.
            MotionError: the move began and did not end as asked; the motor was stopped.
        """
        self._check(zoom)
        start = self.read()
        via = self._approach_steps(start.position_steps, self.curve.steps_at(zoom), approach)
        if via is not None:
            self._command(via, start.position_steps).wait()
        return self.start_move_to(zoom=zoom).wait()

    def start_move_to(self, *, zoom: float) -> Move[ZoomSample]:
        """Command a zoom and return at once; goes the direct way. A newer move supersedes an older one."""
        self._check(zoom)
        latest = self.topic.latest if self.streaming else None
        start = latest if latest is not None else self.read()
        rest = self._rest_until_now(start)
        # Another's poll may be on the line, with an older reading: it goes before, in number and in time.
        with self.clock.transaction():
            move = self._command(self.curve.steps_at(zoom), start.position_steps)
            if rest is not None:
                self.clock.deliver(partial(self._publish_rest, msgspec.structs.replace(rest, seq=self._next_seq())))
        return move

    def reference(self) -> None:
        """Find the reference. Moves the motor."""
        with self._naming_errors():
            self._require_open()
            self._move.supersede()
            self._reference()
            self._publish_event("reference_found")

    def stop(self, *, by: str = "user", reason: str = "") -> None:
        """Stop the motor now; a running `Move` ends as cancelled."""
        self._move.stopped()
        super().stop(by=by, reason=reason)

    # ------------------------------------------------------------------ checks and supervision

    _commanded_ns = -1

    def _check(self, zoom: float) -> None:
        with self._naming_errors():
            self._require_open()
            check_range(zoom, self.zoom_range, what="zoom", unit="x", device=self.name)
            if not self.referenced:
                raise NotReferenced(
                    "the motor's absolute position is not known",
                    remedy="make sure that the way is free, then reference()",
                )

    def _rest_until_now(self, latest: ZoomSample) -> ZoomSample | None:
        """A motor that rested rests until it is commanded: samples before and after leave the instant open."""
        if latest.moving or latest.t_ns <= self._commanded_ns:
            return None
        return msgspec.structs.replace(latest, t_ns=self.clock.now_ns(), dt_ns=0, t_source="computed", order=-1)

    def _publish_rest(self, rest: ZoomSample) -> None:
        newest = self.topic.latest
        if newest is None or newest.t_ns < rest.t_ns:
            self.topic.publish(rest)
        elif not newest.moving:  # it was read before the command was sent, and the motor rested on
            self.topic.publish(msgspec.structs.replace(rest, t_ns=newest.t_ns + 1))

    def _command(self, target_steps: int, start_steps: int) -> Move[ZoomSample]:
        with self._naming_errors():
            stops_before = self._move.supersede()
            try:
                self._start_move(target_steps)
            finally:
                self._commanded_ns = self.clock.now_ns()
        travel_s = abs(target_steps - start_steps) / self.axis.max_speed
        ramps_s = 2.0 * self.axis.max_speed / self.axis.acceleration
        move = Move(
            device=self.name,
            clock=self.clock,
            read=self.read,
            position_of=lambda sample: {"zoom": float(sample.position_steps)},
            arrived=lambda sample: sample.on_target and not sample.moving,
            referenced=lambda _sample: self.referenced,
            stop=lambda: ZoomMotor.stop(self, by="supervision", reason="move failed or cancelled"),
            target={"zoom": float(target_steps)},
            start={"zoom": float(start_steps)},
            axes={"zoom": self.axis},
            deadline_t_ns=self.clock.now_ns() + seconds_to_ns(1.2 * (travel_s + ramps_s) + self.settle_s + 0.5),
        )
        return self._move.hold(move, stops_before)
