"""Readings of several nodes at the instant of one SYNC."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

import msgspec

from microdrivers.backends.canopen.sync import LATE_NS, Pulse, SyncProducer
from microdrivers.backends.lines.can_line import CanLine, Listening, Received
from microdrivers.core.clock import ClockEvent
from microdrivers.core.errors import LinkTimeout
from microdrivers.core.units import NS_PER_S, seconds_to_ns

_ATTEMPTS = 2
_INTERFRAME_BITS = 3
_LONG_AGO_NS = -NS_PER_S


class SyncSet(msgspec.Struct, frozen=True, gc=False):
    """One frame of each of several PDOs, all of one SYNC.

    Attributes:
        number: of the SYNC.
        t_ns, dt_ns: when it reached the nodes, and the half-width of the interval in which that lies.
        frames: in the order in which the PDOs were named.
    """

    number: int
    t_ns: int
    dt_ns: int
    frames: tuple[Received, ...]


class PdosMissing(LinkTimeout):
    """Not all PDOs came after a SYNC; `missing` are the identifiers of the others."""

    def __init__(self, error: LinkTimeout, missing: Sequence[int]) -> None:
        super().__init__(error.what, remedy=error.remedy)
        self.missing = tuple(missing)


class _Round(msgspec.Struct):
    """The answers to one SYNC, as far as they have come: by identifier, in the order of their arrival."""

    pulse: Pulse
    wanted: bool
    on_trial: bool
    frames: dict[int, Received] = msgspec.field(default_factory=dict)


class SyncedPdos:
    """Transmit PDOs of type 1, each once after every SYNC, taken together.

    Nodes answer in order, and frames are handed over in order: each frame belongs to the oldest SYNC that its node has
    not answered, however late the host comes to read it. That holds as long as none is missing, which is known when
    every node has answered every SYNC; only then sets are given out. If one stays missing all that is awaited is lost.
    When all nodes are heard again, no SYNC is sent until nothing old can come any more, and the count begins anew.
    Whoever joins others' SYNCs leaves the first answers alone: they may be older.

    `take` asks for a set now; `run` has them come.

    Args:
        line: the bus.
        cob_ids: of the PDOs.
        on_set: called with each set that is a turn of a stream, in the thread that receives.
        on_lost: called for each turn that is lost, with the identifiers that were missing.

    Attributes:
        taken, lost, skipped: turns of streams that were answered; that were not; in which nothing was asked, because
            the computer or the bus was late.
    """

    def __init__(
        self, line: CanLine, cob_ids: Sequence[int], *, on_set: Callable[[SyncSet], object],
        on_lost: Callable[[Sequence[int]], object],
    ) -> None:  # fmt: skip
        self.taken = 0
        self.lost = 0
        self.skipped = 0
        self._line = line
        self._cob_ids = tuple(cob_ids)
        self._size = len(self._cob_ids)
        self._gap_ns = _INTERFRAME_BITS * NS_PER_S // line.connection.bitrate
        self._on_set = on_set
        self._on_lost = on_lost
        self._producer = line.service(SyncProducer)
        self._lock = threading.Lock()  # never held while anybody is called
        self._rounds: list[_Round] = []
        self._newest: SyncSet | None = None
        self._counting = False
        self._fresh = True
        self._paused = False
        self._quiet_until_ns: int | None = None
        self._discarded_ns = _LONG_AGO_NS
        self._heard: set[int] = set()
        self._last_missing: tuple[int, ...] = ()
        self._streams = 0
        self._waiting: tuple[ClockEvent, ...] = ()
        self._listening: list[Listening] = []

    # ------------------------------------------------------------------ life

    @property
    def listening(self) -> bool:
        """Whether it takes part in the line's SYNCs."""
        return bool(self._listening)

    def begin_listening(self) -> None:
        """Take part in the line's SYNCs; the nodes should be ready to answer."""
        if not self._listening:
            self.resume()
            self._listening = [self._line.listen(cob_id, self._hear) for cob_id in self._cob_ids]
            self._listening.append(self._producer.join(self))

    def end_listening(self) -> None:
        """Take part no longer; idempotent."""
        while self._listening:
            self._listening.pop().cancel()
        self._discard()

    def pause(self) -> None:
        """A node cannot answer: whoever waits gives up, and nobody is kept waiting, until `resume`."""
        self._paused = True
        self._discard()
        for flag in self._waiting:
            flag.set()

    def resume(self) -> None:
        """All nodes can answer again."""
        self._paused, self._fresh = False, True

    # ------------------------------------------------------------------ asking

    def take(self, timeout_s: float) -> SyncSet:
        """Send a SYNC and wait for its answers; asks once more if they do not come in half of the time.

        Raises:
            PdosMissing: they did not come. LinkLost: the adapter is gone. BusyError: others ask without a pause.
        """
        flag = self._line.clock.event()
        self._waiting = (*self._waiting, flag)
        try:
            with self._line.clock.transaction():
                for _ in range(_ATTEMPTS):
                    found = self._ask(flag, timeout_s / _ATTEMPTS)
                    if found is not None:
                        self._line.counters.exchanges += 1
                        return found
                    if self._paused:
                        break
        finally:
            self._waiting = tuple(each for each in self._waiting if each is not flag)
        self._line.counters.timeouts += 1
        missing = self._last_missing
        names = ", ".join(f"{cob_id:03X}h" for cob_id in missing) or "any PDO"
        others = f" ({self._producer.foreign} SYNCs of somebody else on this bus)" if self._producer.foreign else ""
        raise PdosMissing(self._line.silence(f"no answer to SYNC from {names}{others}", timeout_s), missing)

    def run(self, rate_hz: float) -> Listening:
        """Have sets come at that rate until cancelled."""
        running = self._producer.run(self, rate_hz)
        self._streams += 1

        def end() -> None:
            running.cancel()
            self._streams -= 1
            for awaited in tuple(self._rounds) if not self._streams else ():
                awaited.wanted = False

        return Listening(end)

    # ------------------------------------------------------------------ for the producer

    @property
    def oldest_ns(self) -> int | None:
        """When the oldest SYNC was sent whose answers are still to come; None if there is none."""
        rounds = self._rounds
        return rounds[0].pulse.sent_ns if rounds else None

    @property
    def quiet_until_ns(self) -> int:
        """Until then no SYNC may be sent: older answers could be taken for its own."""
        quiet_until_ns = self._quiet_until_ns
        return 0 if quiet_until_ns is None or self._paused else quiet_until_ns

    def begin(self, pulse: Pulse, *, wanted: bool) -> None:
        """A SYNC is about to be sent."""
        oldest_ns = self.oldest_ns
        if oldest_ns is not None and pulse.sent_ns - oldest_ns >= LATE_NS:
            self._discard()
        with self._lock:
            quiet = min(pulse.gap_ns, pulse.sent_ns - self._discarded_ns) >= LATE_NS
            fresh = self._fresh
            self._counting = not self._paused and (self._counting or quiet or fresh)
            if self._counting:
                self._quiet_until_ns, self._fresh = None, False
                self._rounds = [*self._rounds, _Round(pulse, wanted=wanted, on_trial=fresh and not quiet)]
                return
            if self._heard:
                self._last_missing = tuple(cob_id for cob_id in self._cob_ids if cob_id not in self._heard)
        if wanted:
            self._lose(self._last_missing)

    def skip(self) -> None:
        """A turn in a stream is left out."""
        self.skipped += 1

    def spoil(self) -> None:
        """Somebody else has sent a SYNC: what answers come now are not to be told apart."""
        self._discard()

    # ------------------------------------------------------------------ receiving

    def _ask(self, flag: ClockEvent, timeout_s: float) -> SyncSet | None:
        """One SYNC, and the set that answers it or a later one."""
        clock = self._line.clock
        with self._lock:
            if not (self._counting or self._fresh):
                self._quiet_until_ns = self._first_quiet_ns
        if self._fresh and clock.now_ns() - self._producer.last_ns < LATE_NS:
            self._producer.fire()  # on trial
        number = self._producer.fire().number
        deadline_ns = clock.now_ns() + seconds_to_ns(timeout_s)
        while True:
            flag.clear()
            newest = self._newest
            if newest is not None and newest.number >= number:
                return newest
            remaining_ns = deadline_ns - clock.now_ns()
            if remaining_ns <= 0 or self._paused:
                break
            self._line.wait(flag, remaining_ns / NS_PER_S)
        if any(awaited.pulse.number <= number for awaited in self._rounds):
            self._discard()
        return None

    def _hear(self, received: Received) -> None:
        cob_id = received.cob_id
        with self._lock:
            if not self._counting:
                self._ask_for_quiet(cob_id)
                return
            complete: list[_Round] = []
            for current in self._rounds:
                if cob_id not in current.frames:
                    if received.t_ns + received.dt_ns < current.pulse.earliest_ns:
                        return  # it was on the bus before: an answer that counts as lost
                    current.frames[cob_id] = received
                    for each in self._rounds:
                        if len(each.frames) < self._size:
                            return
                    complete, self._rounds = self._rounds, []
                    break
        if not complete:
            self._discard()  # an answer to no SYNC of ours: what is awaited cannot be told apart either
            return
        self._producer.answered()
        for each in complete:
            if not each.on_trial:
                self._give_out(each)

    @property
    def _first_quiet_ns(self) -> int:
        """From then on nothing old can come any more, if no SYNC is sent before."""
        return max(self._producer.last_ns, self._discarded_ns) + LATE_NS

    def _ask_for_quiet(self, cob_id: int) -> None:
        """Have the count begin anew once all nodes have been heard again; a silent one keeps nobody waiting."""
        self._heard.add(cob_id)
        if (
            self._streams
            and not self._paused
            and self._quiet_until_ns is None
            and len(self._heard) == len(self._cob_ids)
        ):
            self._quiet_until_ns = self._first_quiet_ns

    def _give_out(self, complete: _Round) -> None:
        frames = tuple([complete.frames[cob_id] for cob_id in self._cob_ids])
        t_ns, dt_ns = self._interval(complete)
        newest = self._newest = SyncSet(complete.pulse.number, t_ns, dt_ns, frames)
        for flag in self._waiting:
            flag.set()
        if complete.wanted:
            self.taken += 1
            self._on_set(newest)

    def _interval(self, complete: _Round) -> tuple[int, int]:
        """When the SYNC reached the nodes: not before it can have passed, nor after the first answer has begun."""
        first, earliest_ns = next(iter(complete.frames.values())), complete.pulse.earliest_ns
        begun_ns = first.t_ns - self._line.shortest_ns[len(first.data)] - self._gap_ns
        half_ns = max(0, begun_ns - earliest_ns) // 2
        return earliest_ns + half_ns, half_ns + first.dt_ns

    def _discard(self) -> None:
        """Give up what is awaited: from now on nobody knows which SYNC a frame answers."""
        with self._lock:
            self._counting = False
            self._discarded_ns = self._line.clock.now_ns()
            self._quiet_until_ns = None
            self._heard.clear()
            given_up, self._rounds = self._rounds, []
        self._producer.answered()
        for awaited in given_up:
            self._last_missing = tuple(cob_id for cob_id in self._cob_ids if cob_id not in awaited.frames)
            if awaited.wanted and not awaited.on_trial:
                self._lose(self._last_missing)

    def _lose(self, missing: Sequence[int]) -> None:
        self.lost += 1
        self._on_lost(missing)
