"""Takes what arrives at a CAN adapter in real time: one thread, which also receives for those that it calls."""

from __future__ import annotations

import threading
from typing import Protocol

from microdrivers.backends.lines.can_adapter import CanAdapter
from microdrivers.core.clock import Clock, ClockEvent
from microdrivers.core.errors import LinkError, LinkLost
from microdrivers.core.units import NS_PER_MS, NS_PER_S, seconds_to_ns

_RECEIVE_S = 0.1
_LOCK_STEP_NS = NS_PER_MS


class ReceivingLine(Protocol):
    """What a receiver needs of its line."""

    clock: Clock
    lost: LinkLost | None
    """Why the adapter is gone, if it is."""

    def hear(self, cob_id: int, data: bytes, t_ns: int, dt_ns: int) -> None:
        """A data frame with 11 bits of identifier has arrived at `t_ns` ± `dt_ns`."""

    def pass_by(self, length: int) -> None:
        """Another frame, of so many bytes, has arrived."""

    def fail(self, adapter: CanAdapter, cause: Exception) -> LinkError:
        """The adapter has failed."""


class Receiver(Protocol):
    """Who takes what arrives, and waits for it."""

    def end(self) -> None:
        """Receive no more: the adapter is about to be closed."""

    def wait(self, flag: ClockEvent, timeout_s: float) -> None:
        """Return when the flag is up, the time over or the adapter lost."""

    def acquire(self, lock: threading.Lock, timeout_s: float) -> bool:
        """Take a lock that others hold while they wait for frames; tells whether it was free in time."""


class ThreadReceiver:
    """The thread, from the beginning. It receives for itself when one of its listeners waits: see `CanLine`."""

    def __init__(self, line: ReceivingLine, adapter: CanAdapter, *, name: str) -> None:
        self._line = line
        self._clock = line.clock
        self._adapter = adapter
        self._ended = False
        self._thread = 0
        self._timer = self._clock.call_at(self._clock.now_ns(), self._run, name=name)

    def end(self) -> None:
        """See `Receiver.end`."""
        self._ended = True
        self._timer.cancel()

    def wait(self, flag: ClockEvent, timeout_s: float) -> None:
        """See `Receiver.wait`."""
        if threading.get_ident() != self._thread:
            if self._line.lost is None:
                flag.wait(timeout_s)
            return
        deadline_ns = self._clock.now_ns() + seconds_to_ns(timeout_s)
        while not flag.is_set() and self._goes_on and self._clock.now_ns() < deadline_ns:
            self._receive(deadline_ns)

    def acquire(self, lock: threading.Lock, timeout_s: float) -> bool:
        """See `Receiver.acquire`."""
        if threading.get_ident() != self._thread:
            return lock.acquire(timeout=timeout_s)
        deadline_ns = self._clock.now_ns() + seconds_to_ns(timeout_s)
        while not (taken := lock.acquire(blocking=False)) and (now_ns := self._clock.now_ns()) < deadline_ns:
            self._receive(min(deadline_ns, now_ns + _LOCK_STEP_NS))
        return taken

    @property
    def _goes_on(self) -> bool:
        return not self._ended and self._line.lost is None

    def _run(self) -> None:
        self._thread = threading.get_ident()
        while self._goes_on:
            self._receive(self._clock.now_ns() + seconds_to_ns(_RECEIVE_S))

    def _receive(self, until_ns: int) -> None:
        """Take the next frame that comes by then."""
        adapter = self._adapter
        if not self._goes_on:
            return
        try:
            message = adapter.receive(max(0, until_ns - self._clock.now_ns()) / NS_PER_S)
        except adapter.failures as error:
            if not self._ended:
                self._line.fail(adapter, error)
            return
        if message is None:
            return
        if message.is_extended_id or message.is_remote_frame:
            self._line.pass_by(len(message.data))
        else:
            self._line.hear(message.arbitration_id, bytes(message.data), *adapter.stamp(message))
