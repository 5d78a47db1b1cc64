"""The heartbeat that a node produces, and those that it consumes (CiA 301, 7.2.8)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from microdrivers.core.units import NS_PER_MS
from microdrivers.fakes.canopen.data_types import U8, U16, U32, Value
from microdrivers.fakes.canopen.dictionary import Entry

HEARTBEAT_ID = 0x700
_CONSUMED = 2
_HIGHEST = 0x007FFFFF  # bits 16 to 22 the node, 0 to 15 ms


class HeartbeatProducer:
    """Object 1017h: after each so many ms the node's state; 0 is never."""

    def __init__(self) -> None:
        self.period = Entry(0x1017, 0, U16, "rw", write=self._written)
        self.due_ns: int | None = None

    def start(self, t_ns: int) -> None:
        """The node has booted."""
        self._written(self.period.value, t_ns)

    def beat(self) -> None:
        """One is being sent; the next is due a period after it was due."""
        assert self.due_ns is not None
        self.due_ns += self.period.value * NS_PER_MS

    def _written(self, value: Value, t_ns: int) -> None:
        self.due_ns = t_ns + value * NS_PER_MS if value else None


@dataclass
class _Watch:
    """Somebody's heartbeat; `due_ns` is None until one has been heard, and after one was missed."""

    node_id: int
    period_ns: int
    due_ns: int | None = None
    missed: bool = False


class HeartbeatConsumer:
    """Object 1016h: whose heartbeats must come within so many ms. Watching begins with the first one.

    Args:
        on_missed, on_back: are told whose heartbeats have ended, or come again, and when.
        on_changed: is called when others are watched.
    """

    def __init__(
        self,
        *,
        on_missed: Callable[[int, int], None],
        on_back: Callable[[int, int], None],
        on_changed: Callable[[], None],
    ) -> None:
        self._on_missed = on_missed
        self._on_back = on_back
        self._on_changed = on_changed
        self._times = [
            Entry(0x1016, sub, U32, "rw", high=_HIGHEST, write=self._writer(sub)) for sub in range(1, _CONSUMED + 1)
        ]
        self._watches: dict[int, _Watch] = {}

    @property
    def node_ids(self) -> set[int]:
        """Whose heartbeats are awaited."""
        return {watch.node_id for watch in self._watches.values()}

    def entries(self) -> list[Entry]:
        """1016h."""
        return [Entry(0x1016, 0, U8, "const", _CONSUMED), *self._times]

    def start(self) -> None:
        """The node has booted: nothing has been heard yet."""
        for time in self._times:
            self._watch(time.sub, time.value)

    def heard(self, node_id: int, t_ns: int) -> None:
        """A heartbeat of whatever state, or a boot-up."""
        for watch in self._watches.values():
            if watch.node_id == node_id:
                watch.due_ns = t_ns + watch.period_ns
                if watch.missed:
                    watch.missed = False
                    self._on_back(node_id, t_ns)

    @property
    def due_ns(self) -> int | None:
        """When the next one is missed."""
        return min((watch.due_ns for watch in self._watches.values() if watch.due_ns is not None), default=None)

    def postpone(self, by_ns: int, until_ns: int) -> None:
        """Await those that are awaited so much longer, and until then at least."""
        for watch in self._watches.values():
            if watch.due_ns is not None:
                watch.due_ns = max(watch.due_ns + by_ns, until_ns)

    def advance(self, t_ns: int) -> None:
        """Tell of those that have not come in time."""
        for watch in self._watches.values():
            if watch.due_ns is not None and watch.due_ns <= t_ns:
                due_ns, watch.due_ns, watch.missed = watch.due_ns, None, True
                self._on_missed(watch.node_id, due_ns)

    def _writer(self, sub: int) -> Callable[[Value, int], None]:
        return lambda value, _t_ns: self._watch(sub, value)

    def _watch(self, sub: int, value: int) -> None:
        node_id, milliseconds = value >> 16, value & 0xFFFF
        self._watches.pop(sub, None)
        if node_id and milliseconds:
            self._watches[sub] = _Watch(node_id, milliseconds * NS_PER_MS)
        self._on_changed()
