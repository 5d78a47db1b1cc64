"""Who turns a medium when something falls due on it: the simulated clock, or a thread in real time."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from contextlib import AbstractContextManager
from heapq import heappop, heappush
from typing import Protocol

from microdrivers.core.clock import Clock, SimulatedClock, Timer
from microdrivers.core.units import NS_PER_S
from microdrivers.fakes.can.timeline import NEVER_NS

_LONGEST_WAIT_S = 3600.0


Call = Callable[[int], object]
"""Is given the present, ns."""


class Pacer(Protocol):
    """Turns the medium when it is time, and calls what was asked for."""

    def plan(self, due_ns: int) -> None:
        """The bus' next event is at `due_ns`; called after everything that may have changed that."""

    def call_at(self, t_ns: int, call: Call) -> None:
        """Call at `t_ns`, or as soon as possible after it."""

    def close(self) -> None:
        """No call starts after this; idempotent."""


class SimulatedPacer:
    """Works off what falls due on a simulated clock: events of the bus, and calls to those who wait for frames.

    One call of the clock does all that comes before anybody else's turn, a whole burst of frames for instance. The
    clock then has one pending call; those behind it in `_pending` serve when the bus' next event moves away again.

    Args:
        play: lets happen on the bus what is due by a time, but no more after a frame's end at which its second
            argument tells so; returns when the bus' next event is.
    """

    def __init__(self, clock: SimulatedClock, play: Callable[[int, Callable[[], object]], int]) -> None:
        self._clock = clock
        self._play = play
        self._bus_ns = NEVER_NS
        self._calls: list[tuple[int, int, Call]] = []  # heap by time
        self._numbers = itertools.count()
        self._pending: list[tuple[int, Timer]] = []  # latest first
        self._will_ask = False
        self._closed = False

    def plan(self, due_ns: int) -> None:
        """See `Pacer.plan`."""
        self._bus_ns = due_ns
        if not self._will_ask:
            self._ask()

    def call_at(self, t_ns: int, call: Call) -> None:
        """See `Pacer.call_at`; calls at equal times keep their order."""
        heappush(self._calls, (t_ns, next(self._numbers), call))
        if not self._will_ask:
            self._ask()

    def close(self) -> None:
        """See `Pacer.close`."""
        self._closed = True
        while self._pending:
            self._pending.pop()[1].cancel()

    def _ask(self) -> None:
        """Have the clock call when something is due; in an exchange, where that changes often, when it has ended."""
        if self._clock.in_transaction:
            self._will_ask = True
            self._clock.after_exchange(self._ask_clock)
        else:
            self._ask_clock()

    def _ask_clock(self) -> None:
        self._will_ask = False
        due_ns, pending = self._bus_ns, self._pending
        if self._calls and self._calls[0][0] < due_ns:
            due_ns = self._calls[0][0]
        while pending and pending[-1][0] < due_ns:
            pending.pop()[1].cancel()
        if due_ns < NEVER_NS and not self._closed and (not pending or pending[-1][0] > due_ns):
            pending.append((due_ns, self._clock.call_at(due_ns, self._run, name="CAN medium")))

    def _run(self) -> None:
        clock, calls = self._clock, self._calls
        self._pending.pop()
        self._will_ask = True
        now_ns = clock.now_ns()
        try:
            while not self._closed:
                while calls and calls[0][0] <= now_ns:
                    heappop(calls)[2](now_ns)
                last_ns = clock.free_until_ns() - 1
                if calls and calls[0][0] < last_ns:
                    last_ns = calls[0][0]
                self._bus_ns = due_ns = self._play(last_ns if last_ns > now_ns else now_ns, calls.__len__)
                if calls and calls[0][0] < due_ns:
                    due_ns = calls[0][0]
                if due_ns == NEVER_NS or not clock.go_on_at(due_ns):
                    return
                if due_ns > now_ns:
                    now_ns = due_ns
        finally:
            self._ask_clock()


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
        self._tell: Callable[[], object] | None = None
        self._changed = clock.event()
        self._timer = clock.call_at(clock.now_ns(), self._run, name=f"CAN medium {name}")

    def plan(self, due_ns: int) -> None:
        """See `Pacer.plan`."""
        if self._tell is not None:
            self._tell()
        elif due_ns < self._due_ns:
            self._changed.set()

    def leave_to(self, tell: Callable[[], object] | None) -> None:
        """Somebody else turns the medium from now on, and is told when that changes; None ends this."""
        with self._lock:
            self._tell = tell
            self._changed.set()

    def call_at(self, t_ns: int, call: Call) -> None:
        """See `Pacer.call_at`: what has happened is told at once."""
        call(t_ns)

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
                self._due_ns = self._turn() if self._tell is None else NEVER_NS
                self._changed.clear()
            wait_s = (self._due_ns - self._clock.now_ns()) / NS_PER_S
            if wait_s > 0:
                self._changed.wait(min(wait_s, _LONGEST_WAIT_S))
