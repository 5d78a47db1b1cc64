"""Who turns a medium when something falls due on it: the simulated clock, or a thread in real time."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Protocol

from microdrivers.core.clock import Clock, Timer
from microdrivers.core.units import NS_PER_S
from microdrivers.fakes.can.timeline import NEVER_NS

_LONGEST_WAIT_S = 3600.0


class Pacer(Protocol):
    """Calls `turn` when it is time."""

    def plan(self, due_ns: int) -> None:
        """The next event is at `due_ns`; called after everything that may have changed that."""

    def close(self) -> None:
        """No call starts after this; idempotent."""


class SimulatedPacer:
    """One pending call on the simulated clock, at the next event or before it."""

    def __init__(self, clock: Clock, turn: Callable[[], int]) -> None:
        self._clock = clock
        self._turn = turn
        self._due_ns = NEVER_NS
        self._timer: Timer | None = None

    def plan(self, due_ns: int) -> None:
        """See `Pacer.plan`."""
        if due_ns >= self._due_ns:
            return  # the pending call plans again
        if self._timer is not None:
            self._timer.cancel()
        self._due_ns = due_ns
        self._timer = self._clock.call_at(due_ns, self._fire, name="CAN medium")

    def close(self) -> None:
        """See `Pacer.close`."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer, self._due_ns = None, NEVER_NS

    def _fire(self) -> None:
        self._timer, self._due_ns = None, NEVER_NS
        self._turn()


class RealTimePacer:
    """A thread that sleeps until the next event, or until that has moved forward.

    Args:
        lock: the medium's; `plan` is called by whoever holds it.
    """

    def __init__(self, clock: Clock, turn: Callable[[], int], *, lock: AbstractContextManager[bool], name: str) -> None:
        self._clock = clock
        self._turn = turn
        self._lock = lock
        self._closed = False
        self._due_ns = NEVER_NS
        self._changed = clock.event()
        self._timer = clock.call_at(clock.now_ns(), self._run, name=f"CAN medium {name}")

    def plan(self, due_ns: int) -> None:
        """See `Pacer.plan`."""
        if due_ns < self._due_ns:
            self._changed.set()

    def close(self) -> None:
        """See `Pacer.close`."""
        with self._lock:
            self._closed = True
            self._changed.set()
        self._timer.cancel()

    def _run(self) -> None:
        while True:
            with self._lock:
                if self._closed:
                    return
                self._due_ns = self._turn()
                self._changed.clear()
            wait_s = (self._due_ns - self._clock.now_ns()) / NS_PER_S
            if wait_s > 0:
                self._changed.wait(min(wait_s, _LONGEST_WAIT_S))
