"""Transmit PDOs: on every n-th SYNC, on a change, or when the event timer has run out (CiA 301, 7.2.2.5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from microdrivers.core.units import NS_PER_MS
from microdrivers.fakes.canopen.data_types import U8, U16
from microdrivers.fakes.canopen.dictionary import Entry, ObjectDictionary
from microdrivers.fakes.canopen.pdo_record import EVENT_DRIVEN, PdoDefaults, PdoRecord

Send = Callable[[int, bytes, int], None]

CYCLE_NS = NS_PER_MS
"""How often a node looks whether something has changed."""

_INHIBIT_UNIT_NS = 100_000
_FOREVER_AGO_NS = -(1 << 62)


class TransmitPdo(PdoRecord):
    """One transmit PDO: what it carries, when it was sent and when it is due.

    Args:
        number: from 1 on.
        timer_scale: how much slower than the bus' time the node's own clock runs.
    """

    def __init__(
        self,
        number: int,
        defaults: PdoDefaults,
        *,
        default_id: int,
        dictionary: ObjectDictionary,
        locked: Callable[[], bool],
        changed: Callable[[int], None],
        timer_scale: float = 1.0,
    ) -> None:
        communication = 0x1800 + number - 1
        self._timer_scale = timer_scale
        self._inhibit = Entry(
            communication, 3, U16, "rw", defaults.inhibit_100us, write=lambda _value, _t_ns: self.check_unlocked()
        )
        self._timer = Entry(
            communication, 5, U16, "rw", defaults.event_timer_ms, write=lambda _value, t_ns: self.timing_changed(t_ns)
        )
        super().__init__(
            communication,
            0x1A00 + number - 1,
            "tpdo",
            defaults,
            default_id=default_id,
            dictionary=dictionary,
            locked=locked,
            changed=changed,
        )
        dictionary.add([Entry(communication, 0, U8, "const", 5), self._inhibit, self._timer])
        self.timer_due_ns: int | None = None
        self._last_data = b""
        self._sent_ns = _FOREVER_AGO_NS
        self._syncs = 0
        self._waits = False

    def start(self, t_ns: int) -> None:
        """The node has become OPERATIONAL: only what changes from now on is an event."""
        self._last_data = self.sample(t_ns)
        self._sent_ns = _FOREVER_AGO_NS
        self._syncs = 0
        self._waits = False
        self._set_timer(t_ns)

    def sample(self, t_ns: int) -> bytes:
        """The bytes at `t_ns`."""
        return self.pack(*[entry.value if entry.read is None else entry.read(t_ns) for entry in self._entries])

    def _use(self, cob: int, count: int) -> None:
        super()._use(cob, count)
        self._entries = [entry for entry in self.mapped if entry is not None]

    @property
    def event_driven(self) -> bool:
        """Whether changes and the event timer send it."""
        return self.transmission.value in EVENT_DRIVEN

    def at_sync(self, t_ns: int) -> bytes | None:
        """What a SYNC makes it send, if anything."""
        every = self.transmission.value
        if every == 0:
            data = self.sample(t_ns)
            return self._sent(data, t_ns) if data != self._last_data else None
        self._syncs += 1
        if self._syncs < every:
            return None
        self._syncs = 0
        self._last_data = data = self.sample(t_ns)
        self._sent_ns, self._waits = t_ns, False
        return data

    def on_change(self, t_ns: int) -> bytes | None:
        """What a change makes it send now; within the inhibit time that has to wait."""
        if t_ns <= self._sent_ns:
            return None
        data = self.sample(t_ns)
        self._waits = data != self._last_data and t_ns < self._inhibited_until_ns()
        return None if self._waits or data == self._last_data else self._sent(data, t_ns)

    def at_time(self, t_ns: int) -> bytes | None:
        """What the event timer or the end of the inhibit time makes it send."""
        if self.timer_due_ns is not None and self.timer_due_ns <= t_ns:
            return self._sent(self.sample(t_ns), self.timer_due_ns)
        return self.on_change(t_ns)

    @property
    def due_ns(self) -> int | None:
        """When `at_time` has something to do."""
        if not self._waits:
            return self.timer_due_ns
        end_ns = self._inhibited_until_ns()
        return end_ns if self.timer_due_ns is None else min(end_ns, self.timer_due_ns)

    def _inhibited_until_ns(self) -> int:
        return self._sent_ns + int(self._inhibit.value) * _INHIBIT_UNIT_NS

    def _sent(self, data: bytes, t_ns: int) -> bytes:
        self._last_data, self._sent_ns, self._waits = data, t_ns, False
        if self.timer_due_ns is not None:
            self._set_timer(t_ns)
        return data

    def timing_changed(self, t_ns: int) -> None:
        """The transmission type or the event timer has been written."""
        self._set_timer(t_ns)
        super().timing_changed(t_ns)

    def _set_timer(self, t_ns: int) -> None:
        period_ms = self._timer.value
        running = period_ms and self.event_driven
        self.timer_due_ns = t_ns + round(period_ms * NS_PER_MS * self._timer_scale) if running else None


class TransmitPdos:
    """All transmit PDOs of a node.

    Args:
        send: puts a PDO on the bus, from (COB-ID, data, t_ns).
        changes_are_events: whether a changed value sends an event-driven PDO; else only its timer does.

    Attributes:
        synchronous: those that a SYNC may send.
        cycle_ns: when it is looked next whether something has changed; None if a change sends nothing.
    """

    def __init__(self, pdos: Sequence[TransmitPdo], *, send: Send, changes_are_events: bool) -> None:
        self._pdos = pdos
        self._send = send
        self._changes_are_events = changes_are_events
        self.synchronous: list[TransmitPdo] = []
        self._by_event: list[TransmitPdo] = []
        self.cycle_ns: int | None = None
        self._running = False

    def start(self, t_ns: int) -> None:
        """The node has become OPERATIONAL."""
        self._running = True
        for pdo in self._pdos:
            pdo.start(t_ns)
        self.sort(t_ns)

    def stop(self) -> None:
        """It is so no longer."""
        self._running = False
        self.synchronous, self._by_event, self.cycle_ns = [], [], None

    def sort(self, t_ns: int) -> None:
        """A PDO has been set to something else."""
        if not self._running:
            return
        valid = [pdo for pdo in self._pdos if pdo.valid and pdo.mapped]
        self.synchronous = [pdo for pdo in valid if not pdo.event_driven]
        self._by_event = [pdo for pdo in valid if pdo.event_driven]
        self.cycle_ns = t_ns + CYCLE_NS if self._by_event and self._changes_are_events else None

    def look(self, t_ns: int) -> None:
        """Something may have changed."""
        if self.cycle_ns is None:
            return
        for pdo in self._by_event:
            data = pdo.on_change(t_ns)
            if data is not None:
                self._send(pdo.cob_id, data, t_ns)

    @property
    def due_ns(self) -> int | None:
        """When `advance` has something to do."""
        due_ns = self.cycle_ns
        for pdo in self._by_event:
            own_ns = pdo.due_ns
            if own_ns is not None and (due_ns is None or own_ns < due_ns):
                due_ns = own_ns
        return due_ns

    def advance(self, t_ns: int) -> None:
        """Send what the timers have made due by `t_ns`, and what has changed."""
        for pdo in self._by_event:
            own_ns = pdo.due_ns
            if own_ns is not None and own_ns <= t_ns:
                data = pdo.at_time(t_ns)
                if data is not None:
                    self._send(pdo.cob_id, data, t_ns)
        if self.cycle_ns is not None and self.cycle_ns <= t_ns:
            self.cycle_ns += CYCLE_NS
        self.look(t_ns)
