"""Real time: the operating system's monotonic clock, one thread per periodic call."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

from microdrivers.core.clock.base import Clock, ClockError, ClockEvent, Timer
from microdrivers.core.clock.interruption import INTERRUPTION
from microdrivers.core.units import NS_PER_S, seconds_to_ns

_log = logging.getLogger(__name__)

_JOIN_S = 5.0
_NO_TRANSACTION = nullcontext()


class SystemClock(Clock):
    """The operating system's monotonic clock.

    An error in a callback ends that callback's source and is raised again in the main program's next `sleep`, so
    that it cannot go unnoticed.
    """

    simulated = False

    def __init__(self) -> None:
        self._sources: list[_Source] = []
        self._failures: list[Exception] = []
        self._owner = threading.get_ident()

    now_ns = staticmethod(time.monotonic_ns)

    def sleep_until(self, t_ns: int) -> None:
        if threading.get_ident() != self._owner:
            _sleep_until(t_ns)
            return
        self.check()
        with INTERRUPTION.waiting():
            _sleep_until(t_ns)

    def call_at(self, t_ns: int, call: Callable[[], object], *, name: str = "") -> Timer:
        return self._start(_Source(self, t_ns, 0, call, name))

    def every(
        self, period_s: float, call: Callable[[], object], *, start_ns: int | None = None, name: str = ""
    ) -> Timer:
        period_ns = seconds_to_ns(period_s)
        if period_ns <= 0:
            raise ClockError(f"the period of {name or 'a periodic call'} must be positive, not {period_s} s")
        first_ns = time.monotonic_ns() if start_ns is None else start_ns
        return self._start(_Source(self, first_ns, period_ns, call, name))

    def deliver(self, call: Callable[[], object]) -> None:
        call()

    def transaction(self) -> AbstractContextManager[None]:
        return _NO_TRANSACTION

    def event(self) -> ClockEvent:
        return _SystemEvent()

    def close(self) -> None:
        for source in tuple(self._sources):
            source.cancel()

    def check(self) -> None:
        """Raise the first error of a callback, once."""
        if self._failures:
            raise self._failures.pop(0)

    def _start(self, source: _Source) -> _Source:
        self._sources = [known for known in self._sources if known.is_alive()]
        self._sources.append(source)
        source.start()
        return source

    def fail(self, error: Exception) -> None:
        """Keep an error of a callback for the main program."""
        self._failures.append(error)


class _Source(threading.Thread):
    """Waits for its time, calls, and repeats if it has a period."""

    def __init__(
        self, clock: SystemClock, first_ns: int, period_ns: int, call: Callable[[], object], name: str
    ) -> None:
        super().__init__(name=name or "clock", daemon=True)
        self._clock = clock
        self._due_ns = first_ns
        self._period_ns = period_ns
        self._call = call
        self._cancelled = threading.Event()

    def run(self) -> None:
        while not self._cancelled.wait(max(0, self._due_ns - time.monotonic_ns()) / NS_PER_S):
            try:
                self._call()
            except Exception as error:  # noqa: BLE001 - a thread has no caller: the clock hands it to the main program
                _log.error("%s stopped: %s", self.name, error)
                self._clock.fail(error)
                return
            if not self._period_ns:
                return
            late_ns = max(0, time.monotonic_ns() - self._due_ns)
            self._due_ns += self._period_ns * max(1, -(-late_ns // self._period_ns))

    def cancel(self) -> None:
        self._cancelled.set()
        if self.is_alive() and threading.current_thread() is not self:
            self.join(_JOIN_S)
            if self.is_alive():
                _log.error("%s does not end; it is left behind", self.name)


class _SystemEvent:
    def __init__(self) -> None:
        self._event = threading.Event()

    def set(self) -> None:
        self._event.set()

    def is_set(self) -> bool:
        return self._event.is_set()

    def clear(self) -> None:
        self._event.clear()

    def wait(self, timeout_s: float) -> bool:
        if threading.current_thread() is not threading.main_thread():
            return self._event.wait(timeout_s)
        with INTERRUPTION.waiting():
            return self._event.wait(timeout_s)


def _sleep_until(t_ns: int) -> None:
    remaining_ns = t_ns - time.monotonic_ns()
    if remaining_ns > 0:
        time.sleep(remaining_ns / NS_PER_S)
