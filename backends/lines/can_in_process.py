"""An emulated bus in the same process: on a simulated clock frames pass without python-can's messages and threads."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Protocol, cast

from microdrivers.backends.lines.can_adapter import CanAdapter
from microdrivers.backends.lines.can_listeners import CanCounters, Upkeep
from microdrivers.backends.lines.can_receiving import ReceivingLine
from microdrivers.backends.lines.settings import CanConnection
from microdrivers.core.clock import Clock, ClockEvent
from microdrivers.core.units import seconds_to_ns
from microdrivers.devices.wire_tap import CanTap

_HIGHEST_ID = 0x7FF
_EXTENDED, _REMOTE, _ERROR = 1 << 31, 1 << 30, 1 << 29
"""Flags in an identifier, as in linux/can.h."""

_STAMP_NS = 1_000


class InProcessBus(Protocol):
    """What an emulated bus offers beside python-can's interface; identifiers have SocketCAN's flags."""

    def send_data(self, identifier: int, data: bytes) -> None:
        """Send a data frame."""

    def deliver_to(self, take: Callable[[int, bytes, int], object], lost: Callable[[Exception], object]) -> None:
        """Have the clock call `take` with identifier, data and end of all frames, and `lost` when the bus has failed.

        The end, ns on the rig's clock, is exact.
        """

    def receive_until(self, enough: Callable[[], bool], deadline_ns: int) -> None:
        """In an exchange, have `take` called with what arrives until `enough()`, or until the deadline."""


class InProcessAdapter(CanAdapter):
    """An emulated bus, past python-can's messages.

    Attributes:
        port: the bus.
        tapped: where somebody may listen who wants to be told of all frames.
    """

    def __init__(
        self, connection: CanConnection, *, clock: Clock, counters: CanCounters, tap: CanTap | None = None
    ) -> None:
        super().__init__(connection, clock=clock, counters=counters, tap=tap)
        self.port = cast("InProcessBus", self._bus)
        self.tapped = None if tap is None else tap.topic

    def send(self, cob_id: int, data: bytes) -> None:
        """Hand a data frame over."""
        tap = self._tap
        if tap is not None and tap.topic.heard:
            tap.frame(self._clock.now_ns(), "sent", cob_id, data)
        self.port.send_data(cob_id, data)

    def look_at(self, identifier: int, data: bytes, t_ns: int) -> None:
        """A frame that is no data frame with 11 bits of identifier, or one that a tap wants to be told of."""
        tap, error = self._tap, identifier & _ERROR
        plain_id = identifier & ~(_EXTENDED | _REMOTE | _ERROR)
        if tap is not None and tap.topic.heard:
            if error:
                tap.error_frame(t_ns, plain_id, data)
            else:
                extended, remote = bool(identifier & _EXTENDED), bool(identifier & _REMOTE)
                tap.frame(t_ns, "received", plain_id, data, extended=extended, remote=remote)
        if error:
            self._note_error_frame(plain_id)


class InProcessReceiver:
    """Has the clock hand over what arrives; in an exchange, whoever waits receives meanwhile, for everybody.

    Args:
        line: for which it receives.
        upkeep: what has to be done while an exchange waits.
    """

    def __init__(self, line: ReceivingLine, adapter: InProcessAdapter, *, upkeep: Upkeep) -> None:
        self._line = line
        self._clock = line.clock
        self._adapter = adapter
        self._upkeep = upkeep
        self._hear = line.hear
        self._tapped = adapter.tapped
        adapter.port.deliver_to(self._take, self._fail)

    def end(self) -> None:
        """Receive no more: the adapter is about to be closed."""

    def wait(self, flag: ClockEvent, timeout_s: float) -> None:
        """Receive until the flag is up, the time over or the adapter lost."""
        if not self._clock.in_transaction:
            with self._clock.transaction():
                self.wait(flag, timeout_s)
            return
        clock, upkeep, up = self._clock, self._upkeep, flag.is_set
        now_ns = clock.now_ns()
        deadline_ns = now_ns + seconds_to_ns(timeout_s)
        try:
            while not up() and now_ns < deadline_ns and self._line.lost is None:
                self._adapter.port.receive_until(up, min(deadline_ns, upkeep.do(now_ns)))
                now_ns = clock.now_ns()
        except self._adapter.failures as error:
            self._fail(error)

    def acquire(self, lock: threading.Lock, timeout_s: float) -> bool:
        """Where there is one thread only, whoever holds a lock cannot go on meanwhile."""
        del timeout_s
        return lock.acquire(blocking=False)

    def _take(self, identifier: int, data: bytes, t_ns: int) -> None:
        topic = self._tapped
        if identifier > _HIGHEST_ID or (topic is not None and topic.heard):
            try:
                self._adapter.look_at(identifier, data, t_ns)
            except self._adapter.failures as error:
                self._fail(error)
        if identifier <= _HIGHEST_ID:
            self._hear(identifier, data, t_ns, _STAMP_NS)
        elif not identifier & _ERROR:
            self._line.pass_by(len(data))

    def _fail(self, error: Exception) -> None:
        self._line.fail(self._adapter, error)
