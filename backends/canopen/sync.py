"""SYNC, and the PDOs that answer it: one reading of several nodes at one instant, never a mixture of two.

A line has one `SyncProducer`, whose rate is the highest that anybody asked for. What answers a SYNC does not say which:
answers are counted, so none may be missing without being noticed.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterable
from typing import Protocol

import msgspec

from microdrivers.backends.lines.can_line import CanLine, Listening, Received
from microdrivers.core.clock import Timer
from microdrivers.core.errors import BusyError, LinkError
from microdrivers.core.units import NS_PER_MS, NS_PER_S

SYNC_ID = 0x080

PATIENCE_NS = 5 * NS_PER_MS
"""How long a SYNC keeps the next one waiting for its answers."""

LONG_NS = 10 * NS_PER_MS
"""From then on an unanswered SYNC keeps all others waiting, until its answers count as lost."""

LATE_NS = 40 * NS_PER_MS
"""An answer that has not come by then is lost. For as long again it may still come, and must not be counted."""


_LOCK_S = 1.0

_log = logging.getLogger(__name__)


class Pulse(msgspec.Struct, frozen=True, gc=False):
    """One SYNC.

    Attributes:
        number: counts those of the line.
        sent_ns: when it was handed to the adapter.
        earliest_ns: it cannot have reached the nodes before this.
        gap_ns: time since the one before.
    """

    number: int
    sent_ns: int
    earliest_ns: int
    gap_ns: int


class Answering(Protocol):
    """What is answered after a SYNC."""

    def begin(self, pulse: Pulse, *, wanted: bool) -> None:
        """A SYNC is about to be sent; `wanted` if it is this one's turn in a stream."""

    def skip(self) -> None:
        """A turn in a stream is left out."""

    @property
    def oldest_ns(self) -> int | None:
        """When the oldest SYNC was sent whose answers are still to come; None if there is none."""

    @property
    def quiet_until_ns(self) -> int:
        """Until then no SYNC may be sent: older answers could be taken for its own."""

    def spoil(self) -> None:
        """Somebody else has sent a SYNC: what answers come now are not to be told apart."""


class _Turn:
    """One stream and when it is due."""

    def __init__(self, answering: Answering, period_ns: int, now_ns: int) -> None:
        self.answering = answering
        self.period_ns = period_ns
        self._due_ns = now_ns

    def take(self, now_ns: int, beat_ns: int) -> bool:
        """Whether it is due at this beat; it then waits for its next turn. Turns that have passed by are skipped."""
        late_ns = now_ns - self._due_ns + beat_ns // 2
        if late_ns < 0:
            return False
        passed_by = late_ns // self.period_ns
        self._due_ns += self.period_ns * (passed_by + 1)
        for _ in range(passed_by):
            self.answering.skip()
        return True


class SyncProducer:
    """Sends all SYNCs of a line; get it with `line.service(SyncProducer)`.

    Attributes:
        foreign: SYNCs of others that were received. They spoil what is read.
    """

    def __init__(self, line: CanLine) -> None:
        self.foreign = 0
        self._line = line
        self._lock = threading.Lock()
        self._number = 0
        self._pulse: Pulse | None = None
        self._answering: tuple[Answering, ...] = ()
        self._answered = line.clock.event()
        self._turns: tuple[_Turn, ...] = ()
        self._beat_ns = NS_PER_S
        self._timer: Timer | None = None
        self._listening = line.listen(SYNC_ID, self._hear_foreign)

    @property
    def last_ns(self) -> int:
        """When the last SYNC was sent."""
        return -NS_PER_S if self._pulse is None else self._pulse.sent_ns

    def join(self, answering: Answering) -> Listening:
        """Be told of every SYNC."""
        self._answering = (*self._answering, answering)
        return Listening(lambda: self._leave(answering))

    def run(self, answering: Answering, rate_hz: float) -> Listening:
        """Give a turn at that rate until cancelled; the line's rate is the highest of all."""
        turn = _Turn(answering, round(NS_PER_S / rate_hz), self._line.clock.now_ns())
        self._set_turns((*self._turns, turn))
        return Listening(lambda: self._set_turns(tuple(each for each in self._turns if each is not turn)))

    def fire(self) -> Pulse:
        """Send a SYNC as soon as the one before is answered, or has had its time.

        Raises:
            LinkError: it cannot be sent. BusyError: others do not leave a gap.
        """
        line = self._line
        line.acquire(self._lock, timeout_s=_LOCK_S, what="a SYNC")
        try:
            quiet_ns = self._quiet_until_ns() - line.clock.now_ns()
            if quiet_ns > 0:  # as an exchange waits, and not asleep: our heartbeat goes on, and theirs are watched
                line.wait(line.clock.event(), quiet_ns / NS_PER_S)
            self._await_answers()
            return self._fire(())
        finally:
            self._lock.release()

    def answered(self) -> None:
        """Told by those who take part when nothing is awaited any more."""
        self._answered.set()

    # ------------------------------------------------------------------ inside

    def _fire(self, wanted_by: Iterable[Answering]) -> Pulse:
        line = self._line
        self._number += 1
        now_ns = line.clock.now_ns()
        # What has been received was on the bus before it.
        earliest_ns = max(now_ns, line.newest_ns) + line.shortest_ns[0]
        pulse = self._pulse = Pulse(self._number, now_ns, earliest_ns, now_ns - self.last_ns)
        for answering in self._answering:
            answering.begin(pulse, wanted=answering in wanted_by)
        line.send(SYNC_ID)
        return pulse

    def _await_answers(self) -> None:
        """Let the last SYNC be answered, within limits, and none stay unanswered for long."""
        pulse, clock = self._pulse, self._line.clock
        if pulse is None:
            return
        while awaited := [oldest_ns for each in self._answering if (oldest_ns := each.oldest_ns) is not None]:
            now_ns, oldest_ns = clock.now_ns(), min(awaited)
            patient_until_ns = pulse.sent_ns + PATIENCE_NS
            if now_ns >= patient_until_ns:
                if not LONG_NS <= now_ns - oldest_ns < LATE_NS:
                    return
                patient_until_ns = oldest_ns + LATE_NS
            self._answered.clear()
            if any(each.oldest_ns is not None for each in self._answering):
                self._line.wait(self._answered, (patient_until_ns - now_ns) / NS_PER_S)

    def _quiet_until_ns(self) -> int:
        latest_ns = 0
        for each in self._answering:
            if (own_ns := each.quiet_until_ns) > latest_ns:
                latest_ns = own_ns
        return latest_ns

    def _beat(self) -> None:
        """One beat of the fastest stream."""
        line, now_ns, beat_ns = self._line, self._line.clock.now_ns(), self._beat_ns
        due = [turn.answering for turn in self._turns if turn.take(now_ns, beat_ns)]
        if not due:
            return
        behind = line.newest_ns > now_ns + beat_ns  # a long exchange on a simulated clock has gone before
        if behind or now_ns < self._quiet_until_ns():
            for answering in due:
                answering.skip()
            return
        try:
            line.acquire(self._lock, timeout_s=_LOCK_S, what="a SYNC")
            try:
                self._await_answers()  # somebody may just have asked
                self._fire(due)
            finally:
                self._lock.release()
        except (LinkError, BusyError):
            for answering in due:
                answering.skip()

    def _set_turns(self, turns: tuple[_Turn, ...]) -> None:
        self._turns = turns
        timer, self._timer = self._timer, None
        if timer is not None:
            timer.cancel()
        self._beat_ns = min((turn.period_ns for turn in turns), default=NS_PER_S)
        if turns:
            period_s = self._beat_ns / NS_PER_S
            name = f"CAN {self._line.connection.channel} SYNC"
            self._timer = self._line.clock.every(period_s, self._beat, name=name)

    def _leave(self, answering: Answering) -> None:
        self._answering = tuple(each for each in self._answering if each is not answering)

    def _hear_foreign(self, _received: Received) -> None:
        self.foreign += 1
        if self.foreign == 1:
            _log.warning("CAN bus %s: somebody else sends SYNCs too", self._line.connection.channel)
        for answering in self._answering:
            answering.spoil()
