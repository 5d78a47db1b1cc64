"""Homing mode: looks for a switch, an index mark or nothing at all (CiA 402-2, 11)."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum, auto
from typing import NamedTuple

from microdrivers.fakes.cia402.motion import Motion, Profile
from microdrivers.fakes.cia402.objects import DriveObjects
from microdrivers.fakes.cia402.states import Control, Status


class _Search(NamedTuple):
    """What a method looks for: the edge of a switch that is on beyond it, on the side of `sense`, or the index."""

    sense: int
    what: str


_SEARCHES = {
    17: _Search(-1, "limit"),
    18: _Search(1, "limit"),
    24: _Search(1, "home"),
    28: _Search(-1, "home"),
    33: _Search(-1, "index"),
    34: _Search(1, "index"),
}
_HERE = (35, 37)


class _Phase(Enum):
    """Where the procedure stands."""

    NOT_STARTED = auto()
    SEEKING = auto()
    TURNING = auto()
    BACKING_OFF = auto()
    ATTAINED = auto()
    DONE = auto()
    FAILED = auto()


_STATUS = {
    _Phase.NOT_STARTED: Status.TARGET_REACHED,
    _Phase.ATTAINED: Status.HOMED,
    _Phase.DONE: Status.HOMED | Status.TARGET_REACHED,
    _Phase.FAILED: Status.HOMING_ERROR,
}
_RUNNING = (_Phase.SEEKING, _Phase.TURNING, _Phase.BACKING_OFF, _Phase.ATTAINED)


class Homing:
    """One procedure at a time.

    A switch is sought at the fast speed (6099h.1); its edge, from the far side, at the slow one (6099h.2). The index
    is sought at the slow speed; if the method's direction leads to a limit switch, the other one is tried. Where the
    edge or the index is, the position is minus the home offset (607Ch). The table then stands a little beyond.

    Args:
        log: is told "home METHOD", "homed", "home interrupted" and "home error".
        on_started: is called when the table is to move.

    Attributes:
        homed: whether the zero is known.
    """

    def __init__(
        self,
        motion: Motion,
        objects: DriveObjects,
        *,
        log: Callable[[int, str], None],
        on_started: Callable[[int], None],
    ) -> None:
        self.homed = False
        self.due_ns: int | None = None
        self._motion = motion
        self._objects = objects
        self._log = log
        self._on_started = on_started
        self._phase = _Phase.NOT_STARTED
        self._search = _SEARCHES[17]
        self._turns = False

    # ------------------------------------------------------------------ commands

    def control(self, word: int, before: int, t_ns: int) -> None:
        """A control word in operation enabled."""
        if word & ~before & Control.START and not word & Control.HALT:
            self._start(t_ns)
        elif (before & ~word & Control.START or word & ~before & Control.HALT) and self.running:
            self._motion.brake(t_ns, self._objects.homing_acceleration.value)
            self.interrupt(t_ns)

    @property
    def running(self) -> bool:
        """Whether a procedure is under way."""
        return self._phase in _RUNNING

    def interrupt(self, t_ns: int) -> None:
        """Somebody else ends the procedure, if one is under way; what becomes of the motion is theirs."""
        if self._phase is _Phase.ATTAINED:
            self._to(_Phase.DONE, None)
        elif self.running:
            self._log(t_ns, "home interrupted")
            self._to(_Phase.NOT_STARTED, None)

    def fail(self, t_ns: int) -> None:
        """The drive has a fault: a procedure that was under way has found nothing."""
        if self.running:
            self._log(t_ns, "home error")
            self._to(_Phase.FAILED, None)

    def lose_reference(self) -> None:
        """The zero is not known any more."""
        self.homed = False
        self._to(_Phase.NOT_STARTED, None)

    def _start(self, t_ns: int) -> None:
        method = int(self._objects.homing_method.value)
        self._log(t_ns, f"home {method}")
        self.homed = False
        if method in _HERE:
            self._found(self._motion.place_at(t_ns), t_ns)
            self._to(_Phase.DONE, None)
        elif method not in _SEARCHES:
            self._log(t_ns, "home error")
            self._to(_Phase.FAILED, None)
        else:
            self._search = _SEARCHES[method]
            self._seek(t_ns)

    # ------------------------------------------------------------------ time

    def advance(self, t_ns: int) -> None:
        """What was due: a switch or the index is met, or the table has come to rest."""
        if self._motion.jammed:
            self.due_ns = None
        elif self._phase is _Phase.TURNING:
            self._turn(t_ns)
        elif self._phase is _Phase.ATTAINED:
            self._to(_Phase.DONE, None)
        elif self._phase is _Phase.SEEKING and self._turns:
            self._to(_Phase.TURNING, self._motion.brake(t_ns, self._objects.homing_acceleration.value))
        else:
            self._found(self._edge_um, t_ns)
            self._to(_Phase.ATTAINED, self._motion.brake(t_ns, self._objects.homing_acceleration.value))

    def _seek(self, t_ns: int) -> None:
        """Towards the far side of a switch, or towards the index."""
        sense, what = self._search
        beyond = sense * (self._motion.place_at(t_ns) - self._edge_um) >= 0.0
        if what == "index":
            self._turns = beyond
            edge_um = self._motion.limit_um(sense) if beyond else self._edge_um
            self._go(_Phase.SEEKING, sense, edge_um, t_ns, slow=True, far=beyond)
        elif beyond:
            self._go(_Phase.BACKING_OFF, -sense, self._edge_um, t_ns, slow=True)
        else:
            self._turns = True
            self._go(_Phase.SEEKING, sense, self._edge_um, t_ns, far=True)

    def _turn(self, t_ns: int) -> None:
        self._go(_Phase.BACKING_OFF, -self._search.sense, self._edge_um, t_ns, slow=True)

    def _go(
        self, phase: _Phase, sense: int, edge_um: float, t_ns: int, *, slow: bool = False, far: bool = False
    ) -> None:
        rate = self._objects.homing_acceleration.value
        self._motion.seek(t_ns, sense, Profile(self._objects.homing_speeds[slow].value, rate, rate))
        self._to(phase, self._motion.passes_ns(t_ns, edge_um, sense, far=far))
        self._on_started(t_ns)

    def _found(self, place_um: float, t_ns: int) -> None:
        self._motion.define(place_um, -int(self._objects.home_offset.value))
        self.homed = True
        self._log(t_ns, "homed")

    @property
    def _edge_um(self) -> float:
        sense, what = self._search
        return self._motion.limit_um(sense) if what == "limit" else self._motion.home_um

    def _to(self, phase: _Phase, due_ns: int | None) -> None:
        self._phase, self.due_ns = phase, due_ns

    # ------------------------------------------------------------------ status

    def status_at(self, t_ns: int) -> int:
        """Its bits of the status word."""
        bits = _STATUS.get(self._phase, 0)
        if self._phase is _Phase.FAILED and not self._motion.moving_at(t_ns):
            bits |= Status.TARGET_REACHED
        return bits
