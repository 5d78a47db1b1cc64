"""Profile position mode: set-points are handed over, queued or followed at once (CiA 402-2, 10)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from microdrivers.core.units import NS_PER_MS
from microdrivers.fakes.cia402.following_error import FollowingErrorWatch
from microdrivers.fakes.cia402.motion import Motion, Profile
from microdrivers.fakes.cia402.objects import DriveObjects
from microdrivers.fakes.cia402.states import Control, Status

_DEMAND, _ACTUAL = 1, 2
_QUICK = 2


@dataclass(frozen=True)
class _SetPoint:
    target: int
    limited: bool
    profile: Profile


class ProfilePosition:
    """One set-point under way and room for one more.

    Args:
        homed: whether the software limits (607Dh) hold.
        log: is told "move TARGET" (counts), "halt" and "go on".
        on_motion: is called when the table is to move otherwise than before.
    """

    def __init__(
        self,
        motion: Motion,
        objects: DriveObjects,
        watch: FollowingErrorWatch,
        *,
        homed: Callable[[], bool],
        log: Callable[[int, str], None],
        on_motion: Callable[[int], None],
    ) -> None:
        self._motion = motion
        self._objects = objects
        self._watch = watch
        self._homed = homed
        self._log = log
        self._on_motion = on_motion
        self._active: _SetPoint | None = None
        self._queued: _SetPoint | None = None
        self._acknowledged = False
        self._halted = False
        self._given_up = False

    def begin(self, word: int) -> None:
        """Operation is enabled in this mode: the drive holds its position."""
        self.cancel(finished=True)
        self._halted = bool(word & Control.HALT)

    def cancel(self, *, finished: bool) -> None:
        """No set-points any more; unless the last one was `finished`, its target is not reached."""
        self._active = self._queued = None
        self._acknowledged = self._halted = False
        self._given_up = not finished

    # ------------------------------------------------------------------ commands

    def control(self, word: int, before: int, t_ns: int) -> None:
        """A control word in operation enabled."""
        if (word ^ before) & Control.HALT:
            self._halt(bool(word & Control.HALT), t_ns)
        if word & ~before & Control.START:
            self._hand_over(word, t_ns)
        elif not word & Control.START and self._queued is None:
            self._acknowledged = False

    def _hand_over(self, word: int, t_ns: int) -> None:
        immediately = bool(word & Control.IMMEDIATELY)
        if self._acknowledged and not immediately:
            return  # no room: the drive has not said that it can take another
        point = self._read_set_point(bool(word & Control.RELATIVE), t_ns)
        self._acknowledged = True
        if self._active is not None and not immediately and not self.reached_at(t_ns):
            self._queued = point
        else:
            self._queued = None
            self._start(point, t_ns)

    def _read_set_point(self, relative: bool, t_ns: int) -> _SetPoint:
        objects = self._objects
        wanted = int(objects.target.value)
        if relative:
            wanted += self._base(t_ns)
        target = wanted
        low, high = (int(limit.value) for limit in objects.limits)
        if self._homed() and low < high:
            # The limits count from the home position, targets from the zero that the home offset puts elsewhere.
            offset = int(objects.home_offset.value)
            target = min(max(wanted, low - offset), high - offset)
        profile = Profile(
            min(objects.speed.value, objects.max_speed.value), objects.acceleration.value, objects.deceleration.value
        )
        return _SetPoint(target, target != wanted, profile)

    def _base(self, t_ns: int) -> int:
        if self._objects.relative_to.value == _ACTUAL:
            return self._motion.position_at(t_ns)
        last = self._queued or self._active
        if self._objects.relative_to.value == _DEMAND or last is None:
            return self._motion.demand_at(t_ns)
        return last.target

    def _start(self, point: _SetPoint, t_ns: int) -> None:
        self._active = point
        self._given_up = False
        self._log(t_ns, f"move {point.target}")
        if not self._halted:
            self._motion.move(t_ns, point.target, point.profile)
            self._on_motion(t_ns)

    def _halt(self, halted: bool, t_ns: int) -> None:
        self._halted = halted
        if halted:
            quick = self._objects.halt_option.value == _QUICK
            rate = self._objects.quick_deceleration if quick else self._objects.deceleration
            self._motion.brake(t_ns, rate.value)
            self._on_motion(t_ns)
            self._log(t_ns, "halt")
        elif self._active is not None:
            self._log(t_ns, "go on")
            self._motion.move(t_ns, self._active.target, self._active.profile)
            self._on_motion(t_ns)

    # ------------------------------------------------------------------ time

    @property
    def due_ns(self) -> int | None:
        """When the queued set-point's turn comes."""
        return None if self._queued is None or self._halted else self._settled_ns()

    def advance(self, t_ns: int) -> None:
        """Follow the queued set-point."""
        assert self._queued is not None
        point, self._queued = self._queued, None
        if not self._objects.control_word.value & Control.START:
            self._acknowledged = False
        self._start(point, t_ns)

    # ------------------------------------------------------------------ status

    def status_at(self, t_ns: int) -> int:
        """Its bits of the status word."""
        bits = Status.ACKNOWLEDGED if self._acknowledged else 0
        if self._active is not None and self._active.limited:
            bits |= Status.INTERNAL_LIMIT
        if self.reached_at(t_ns):
            bits |= Status.TARGET_REACHED
        if self._watch.too_large:
            bits |= Status.FOLLOWING_ERROR
        return bits

    def reached_at(self, t_ns: int) -> bool:
        """Whether the target was reached; while halted, whether the profile has ended: the table lags behind it."""
        if self._halted:
            return not self._motion.moving_at(t_ns)
        if self._given_up:
            return False
        settled_ns = self._settled_ns()
        return settled_ns is not None and t_ns >= settled_ns

    def _settled_ns(self) -> int | None:
        since_ns = self._motion.settled_from_ns(self._objects.position_window.value)
        return None if since_ns is None else since_ns + self._objects.position_time_ms.value * NS_PER_MS
