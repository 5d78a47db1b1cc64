"""From what a drive reports to what may be said of its axis: moving, on target, at fault, switched off."""

from __future__ import annotations

import math

import msgspec

from microdrivers.backends.cia402.objects import HOMING, PROFILE_POSITION
from microdrivers.backends.cia402.states import State, Status, state_of
from microdrivers.core.units import NS_PER_MS

REST_NS = 10 * NS_PER_MS
"""An axis that holds no target counts as at rest when it has not moved for so long."""

_STILL_COUNTS = 2
_ENABLED, _AT_FAULT = State.OPERATION_ENABLED, (State.FAULT, State.FAULT_REACTION)
_REACHED = Status.TARGET_REACHED
_LONG_AGO_NS = -(1 << 62)


class Reading(msgspec.Struct, frozen=True, gc=False):
    """What one drive reports at one instant: status word, position in counts, mode of operation."""

    status_word: int
    position: int
    mode: int

    @property
    def state(self) -> State | None:
        """State of the drive."""
        return state_of(self.status_word)

    @property
    def at_fault(self) -> bool:
        """Whether the drive is at fault, or about to be."""
        return state_of(self.status_word) in _AT_FAULT

    def has(self, bit: int) -> bool:
        """Whether the status word has this bit."""
        return bool(self.status_word & bit)


class AxisWatch:
    """One axis, as far as it is known. Feed it with all readings in order, and with what is commanded.

    Args:
        tolerance: how far from its target a settled axis may stand, in counts.

    Attributes:
        moving, on_target: as of the last reading. An axis without a target is never on it.
        target: the last commanded one that still holds, in counts.
        braking: it was told to stop, and has not been seen at rest since.
        dropped: the drive has left "operation enabled" although nobody here has told it to.
        at_fault: whether the last reading shows a fault, or that one is coming.
    """

    def __init__(self, *, tolerance: int) -> None:
        self.moving = False
        self.on_target = False
        self.target: int | None = None
        self.braking = False
        self.dropped = False
        self.at_fault = False
        self._tolerance = tolerance
        self._still = max(_STILL_COUNTS, tolerance)
        self._acknowledged = False
        self._homing = False
        self._enabled = False
        self._rest_position: int | None = None
        self._rest_since_ns = _LONG_AGO_NS

    def enabled(self) -> None:
        """The drive was seen to hold its position at our request."""
        self._enabled = True
        self.dropped = self.braking = False

    def commanded(self, target: int) -> None:
        """A move is about to be commanded: from now on the axis counts as moving."""
        self.target = target
        self._acknowledged = self.on_target = self._homing = False
        self.moving = True

    def acknowledged(self) -> None:
        """The drive has taken the target: what it reports from now on is about that one."""
        self._acknowledged = True

    def homing(self) -> None:
        """The axis is about to search its reference."""
        self.forget_target()
        self._homing = self.moving = True

    def homed(self) -> None:
        """The search is over, and the axis at rest: the drive says so. Its counts have another origin now."""
        self._homing = self.moving = False
        self._rest_position = None
        self._rest_since_ns = _LONG_AGO_NS

    def ended(self, t_ns: int) -> None:
        """A stop is sent, or the drive has gone: the axis counts as moving until it has been seen at rest.

        What the drive does with its power stage now is its own matter.
        """
        self.switched_off()
        self._rest_since_ns = t_ns
        self.moving = self.braking = True

    def switched_off(self) -> None:
        """The drive's power stage is off at our request, or after a restart."""
        self.forget_target()
        self._enabled = self._homing = self.dropped = False

    def forget_target(self) -> None:
        """The axis has no target any more."""
        self.target = None
        self._acknowledged = self.on_target = False

    def see(self, t_ns: int, reading: Reading) -> None:
        """Take in what the drive reported at `t_ns`."""
        status_word, position, mode = reading.status_word, reading.position, reading.mode
        if self._rest_position is None or abs(position - self._rest_position) > self._still:
            if self._rest_position is not None:  # the first reading ever shows an axis at rest, as far as anybody knows
                self._rest_since_ns = t_ns
            self._rest_position = position
        at_rest = t_ns - self._rest_since_ns >= REST_NS
        state = state_of(status_word)
        holds = state is _ENABLED
        if self._enabled and not holds and state is not None:
            self.dropped = True
            self.forget_target()
        self.at_fault = state in _AT_FAULT
        reached = bool(status_word & _REACHED)
        if holds and self.target is not None and mode == PROFILE_POSITION:
            self.moving = not (reached and self._acknowledged)
            self.on_target = not self.moving and abs(position - self.target) <= self._tolerance
        elif holds and self._homing and mode == HOMING:
            self.moving, self.on_target = not reached, False
        else:
            self.moving, self.on_target = not at_rest, False
            self.braking = self.braking and not at_rest

    def target_um(self, um_per_count: float) -> float:
        """The target in µm, NaN if there is none."""
        return math.nan if self.target is None else self.target * um_per_count
