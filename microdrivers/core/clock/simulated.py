"""Virtual time: deterministic, single-threaded, as fast as the processor."""

from __future__ import annotations

import heapq
import itertools
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from types import TracebackType

import msgspec

from microdrivers.core.clock.base import Clock, ClockError, ClockEvent, Timer
from microdrivers.core.clock.interruption import INTERRUPTION
from microdrivers.core.units import seconds_to_ns


class SimulatedClock(Clock):
    """Calls happen in the order of their times while the main program waits; equal times keep their order of entry.

    There are two kinds of time. *Global* time moves when the main program waits. *Local* time belongs to one
    activity (a callback, or an exchange of the main program): it may run ahead of global time without
    dispatching anything, as a thread that blocks on a port would. An exchange of the main program is caught up
    with when it ends: what fell due meanwhile is dispatched then, in order.
    """

    simulated = True

    def __init__(self, start_ns: int = 0) -> None:
        self._global_ns = start_ns
        self._local_ns: int | None = None
        self._in_callback = False
        self._free_ns = start_ns
        self._transactions = 0
        self._transaction = _Transaction(self)
        self._after_exchange: list[Callable[[], object]] = []
        self._queue: list[tuple[int, int, _Call]] = []
        self._numbers = itertools.count()
        self._thread = threading.get_ident()

    def now_ns(self) -> int:
        return self._global_ns if self._local_ns is None else self._local_ns

    def sleep_until(self, t_ns: int) -> None:
        if self._transactions:
            if self._local_ns is None or t_ns > self._local_ns:
                self._local_ns = t_ns
            return
        self._check_thread()
        if self._in_callback:
            raise ClockError(
                "a clock callback must not wait",
                remedy="exchange inside clock.transaction(), or schedule the rest with clock.call_at()",
            )
        self._dispatch_until(t_ns)

    def call_at(self, t_ns: int, call: Callable[[], object], *, name: str = "") -> Timer:
        pending = _Call(call, name)
        self._push(t_ns, pending)
        return pending

    def every(
        self, period_s: float, call: Callable[[], object], *, start_ns: int | None = None, name: str = ""
    ) -> Timer:
        period_ns = seconds_to_ns(period_s)
        if period_ns <= 0:
            raise ClockError(f"the period of {name or 'a periodic call'} must be positive, not {period_s} s")
        first_ns = self.now_ns() if start_ns is None else start_ns
        beat = _Call(lambda: None, name)
        due_ns = first_ns

        def run() -> None:
            nonlocal due_ns
            call()
            late = self.now_ns() - due_ns
            due_ns += period_ns if late <= 0 else period_ns * -(-late // period_ns)
            if not beat.cancelled:
                self._push(due_ns, beat)

        beat.call = run
        self._push(first_ns, beat)
        return beat

    def deliver(self, call: Callable[[], object]) -> None:
        if self._local_ns is None or self._local_ns <= self._global_ns:
            call()
        else:
            self.call_at(self._local_ns, call)

    def transaction(self) -> AbstractContextManager[None]:
        return self._transaction

    @property
    def in_transaction(self) -> bool:
        return self._transactions > 0

    def event(self) -> ClockEvent:
        return _SimulatedEvent(self)

    def close(self) -> None:
        self._queue.clear()

    # ------------------------------------------------------------------ for emulators

    def after_exchange(self, call: Callable[[], object]) -> None:
        """In a transaction: call when the outermost one ends, before anything else happens."""
        self._after_exchange.append(call)

    def free_until_ns(self) -> int:
        """Before which instant nothing else can happen, as seen from a callback; the present if that is not known.

        Until then an emulator may work off what falls due in itself at once: nobody can look at it, or ask it for
        anything, before.
        """
        queue, free_ns = self._queue, self._free_ns
        while queue and queue[0][2].cancelled:
            heapq.heappop(queue)
        if queue and queue[0][0] < free_ns:
            free_ns = queue[0][0]
        return free_ns if self._in_callback and free_ns > self._global_ns else self._global_ns

    def go_on_at(self, t_ns: int) -> bool:
        """Inside a callback: let the present be `t_ns` if nothing else happens before; tells whether it does so.

        It is then as if the callback had ended and what follows had been asked for with `call_at`, without the detour.
        """
        queue = self._queue
        if t_ns >= self._free_ns or (queue and queue[0][0] <= t_ns) or not self._in_callback or INTERRUPTION.requested:
            return False
        self._global_ns = self._local_ns = max(self._global_ns, t_ns)
        return True

    def wait_for(self, reached: Callable[[], bool], deadline_ns: int) -> None:
        """Dispatch until `reached()` or `deadline_ns`, the main program's only other way to wait."""
        self._check_thread()
        if self._in_callback or self._transactions:
            raise ClockError("a clock callback must not wait", remedy="schedule the rest with clock.call_at()")
        self._free_ns = self._global_ns  # whoever waits may go on after any call
        while not reached() and self._queue and self._queue[0][0] <= deadline_ns:
            self._dispatch_next()
        if not reached():
            self._global_ns = max(self._global_ns, deadline_ns)

    def _push(self, t_ns: int, call: _Call) -> None:
        due_ns = t_ns if t_ns > self._global_ns else self._global_ns
        heapq.heappush(self._queue, (due_ns, next(self._numbers), call))

    def _dispatch_until(self, t_ns: int) -> None:
        INTERRUPTION.check()
        queue, self._free_ns = self._queue, t_ns + 1
        while queue and queue[0][0] <= t_ns:
            self._dispatch_next()
        self._global_ns = max(self._global_ns, t_ns)

    def _dispatch_next(self) -> None:
        if INTERRUPTION.requested:
            INTERRUPTION.check()
        due_ns, _, pending = heapq.heappop(self._queue)
        if pending.cancelled:
            return
        if due_ns > self._global_ns:
            self._global_ns = due_ns
        self._in_callback, self._local_ns = True, due_ns
        try:
            pending.call()
        finally:
            self._in_callback, self._local_ns, self._transactions = False, None, 0

    def _check_thread(self) -> None:
        if threading.get_ident() != self._thread:
            raise ClockError(
                "a simulated clock belongs to the thread that made it",
                remedy="use SystemClock in programs with threads of their own",
            )


class _Transaction:
    """A clock's exchanges, which may be nested: one object will do for all."""

    __slots__ = ("_clock",)

    def __init__(self, clock: SimulatedClock) -> None:
        self._clock = clock

    def __enter__(self) -> None:
        clock = self._clock
        clock._check_thread()
        if clock._local_ns is None:
            clock._local_ns = clock._global_ns
        clock._transactions += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        clock = self._clock
        clock._transactions -= 1
        if clock._transactions:
            return
        while clock._after_exchange:
            clock._after_exchange.pop()()
        if not clock._in_callback and clock._local_ns is not None:
            end_ns, clock._local_ns = clock._local_ns, None
            clock._dispatch_until(end_ns)


class _Call(msgspec.Struct):
    """One entry of the queue."""

    call: Callable[[], object]
    name: str
    cancelled: bool = False

    def cancel(self) -> None:
        self.cancelled = True


class _SimulatedEvent:
    __slots__ = ("_clock", "_set_at_ns")

    def __init__(self, clock: SimulatedClock) -> None:
        self._clock = clock
        self._set_at_ns: int | None = None

    def set(self) -> None:
        if self._set_at_ns is None:
            self._set_at_ns = self._clock.now_ns()

    def is_set(self) -> bool:
        return self._set_at_ns is not None

    def clear(self) -> None:
        self._set_at_ns = None

    def wait(self, timeout_s: float) -> bool:
        self._clock.wait_for(self.is_set, self._clock.now_ns() + seconds_to_ns(timeout_s))
        if self._set_at_ns is None:
            return False
        # Whoever set it may have been ahead of global time; the effect must not precede its cause.
        self._clock.sleep_until(self._set_at_ns)
        return True
