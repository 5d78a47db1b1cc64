"""What happens on one CAN bus, frame by frame, as a function of the times that are handed in."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Sequence
from typing import Protocol

from microdrivers.core.units import NS_PER_S
from microdrivers.fakes.can.frame import (
    ERROR_FRAME_BITS,
    INTERFRAME_BITS,
    Due,
    Frame,
    arbitration_rank,
    frame_bits,
)

NEVER_NS = 1 << 63


class CanNode(Protocol):
    """A device on the bus. All times are given to it; it never asks for the present, and they never run backwards."""

    def receive(self, frame: Frame, t_ns: int) -> Sequence[Due]:
        """A frame of somebody else has ended at `t_ns`."""

    def advance(self, t_ns: int) -> Sequence[Due]:
        """Do what has fallen due by `t_ns`; also called when the node is attached."""

    def next_event_ns(self) -> int | None:
        """When `advance` has something to do next, if ever; asked after each call of `receive` and `advance`."""


class OnPassed(Protocol):
    """Is told what took the bus from `start_ns` to `end_ns`."""

    def __call__(self, sender: object, frame: Frame, start_ns: int, end_ns: int, intact: bool, /) -> None:
        """`sender`'s frame has arrived, or was destroyed if not `intact`; None sends an error frame of nobody's."""


# Rank in arbitration, number of the offer, frame, sender, whether the others can read it. A plain tuple: one is made
# for each frame.
_Offer = tuple[int, int, Frame, object, bool]


class BusTimeline:
    """Arbitration, frame times and the nodes' own events, in the order of their times.

    A frame takes the time of its bits, stuff bits included. It has arrived, at all others at once, with the last bit
    of its end of frame; the next one starts 3 bits later at the earliest. Of the frames that are ready when one ends,
    or that become ready at the same time later on, the one with the lowest arbitration field wins; of equal ones, the
    one that was offered first (a real bus would see an error). Every frame is acknowledged.

    At equal times a frame's end comes first, then the nodes' events, then the start of a frame.

    Args:
        bitrate: bit/s.
        on_passed: is told of each frame and each error frame when it has ended, before the nodes.
    """

    def __init__(self, *, bitrate: int, on_passed: OnPassed) -> None:
        self.bit_ns = NS_PER_S / bitrate
        self.interframe_ns = round(INTERFRAME_BITS * self.bit_ns)
        self._on_passed = on_passed
        self._nodes: list[CanNode] = []
        self._events_ns: list[int] = []
        self._next_node_ns = NEVER_NS
        self._future: list[tuple[int, _Offer]] = []  # heap by time; they compete later
        self._waiting: list[_Offer] = []  # heap by rank; they have competed and lost
        self._numbers = itertools.count()
        self._current: _Offer | None = None
        self._start_ns = self._end_ns = 0
        self._free_ns = 0
        self._horizon_ns = 0  # when something has happened last
        self._playing = False

    # ------------------------------------------------------------------ who is there

    def attach(self, node: CanNode, t_ns: int) -> None:
        """A node is switched on."""
        self._horizon_ns = max(t_ns, self._horizon_ns)
        self._nodes.append(node)
        self._events_ns.append(NEVER_NS)
        self._advance(len(self._nodes) - 1, self._horizon_ns)

    def detach(self, node: CanNode, t_ns: int) -> None:
        """A node is gone, and its frames with it."""
        index = next(index for index, known in enumerate(self._nodes) if known is node)
        del self._nodes[index], self._events_ns[index]
        self._next_node_ns = min(self._events_ns, default=NEVER_NS)
        self.withdraw(node, t_ns)

    def ask_nodes(self) -> None:
        """Ask all nodes for their next events again."""
        for index in range(len(self._nodes)):
            self._note_event(index)

    # ------------------------------------------------------------------ frames

    def offer(self, sender: object, frame: Frame, t_ns: int, *, readable: bool = True) -> None:
        """A frame that competes from `t_ns` on, or from what has happened last if that is later.

        It is `readable` unless the others can only see an error in it (another bit rate).

        Raises:
            OutOfRange: it is no classic frame.
        """
        entry = (arbitration_rank(frame), next(self._numbers), frame, sender, readable)
        heapq.heappush(self._future, (max(t_ns, self._horizon_ns), entry))

    def withdraw(self, sender: object, t_ns: int) -> None:
        """Take back all frames of a sender, also the one that is on the bus."""
        self._future = [item for item in self._future if item[1][_SENDER] is not sender]
        self._waiting = [entry for entry in self._waiting if entry[_SENDER] is not sender]
        heapq.heapify(self._future)
        heapq.heapify(self._waiting)
        if self._current is not None and self._current[_SENDER] is sender:
            self._current = None
            self._free_ns = max(t_ns, self._horizon_ns) + self.interframe_ns

    def disturb(self, t_ns: int) -> object:
        """An error frame, now; the frame that it destroys competes again. Returns whose that was, or None."""
        hit, now_ns = self._current, max(t_ns, self._horizon_ns)
        sender = None if hit is None else hit[_SENDER]
        if hit is not None and sender is not None:
            heapq.heappush(self._waiting, hit)
        self._horizon_ns = now_ns
        self._occupy((0, 0, _NOBODYS_ERROR, None, False), now_ns, ERROR_FRAME_BITS)
        return sender

    # ------------------------------------------------------------------ time

    @property
    def last_event_ns(self) -> int:
        """When something has happened last."""
        return self._horizon_ns

    def next_event_ns(self) -> int:
        """When something happens next; `NEVER_NS` if all is quiet."""
        return min(self._end_ns if self._current is not None else self._next_start_ns(), self._next_node_ns)

    def play(self, until_ns: int, *, reached: Callable[[], bool] | None = None) -> int:
        """Let happen what is due by `until_ns`, in order; returns when something happens next.

        It ends early when `reached()` after the end of a frame. Times that have been played already do nothing, nor
        does a call from within: what it asks for happens when its turn comes.
        """
        if self._playing:
            return self.next_event_ns()
        self._playing = True
        try:
            while True:
                node_ns, current = self._next_node_ns, self._current
                if current is not None:
                    bus_ns = self._end_ns
                    on_bus = bus_ns <= node_ns
                else:
                    bus_ns = self._next_start_ns()
                    on_bus = bus_ns < node_ns
                if until_ns < (bus_ns if on_bus else node_ns):
                    return bus_ns if on_bus else node_ns
                if not on_bus:
                    self._advance(self._events_ns.index(node_ns), node_ns)
                elif current is None:
                    self._horizon_ns = bus_ns
                    self._begin(bus_ns)
                else:
                    self._end(current)
                    if reached is not None and reached():
                        return self.next_event_ns()
        finally:
            self._playing = False

    def _next_start_ns(self) -> int:
        if self._waiting:
            return self._free_ns
        if self._future:
            return max(self._future[0][0], self._free_ns)
        return NEVER_NS

    def _begin(self, t_ns: int) -> None:
        """Arbitrate among what is ready by `t_ns`."""
        waiting, future = self._waiting, self._future
        while future and future[0][0] <= t_ns:
            heapq.heappush(waiting, heapq.heappop(future)[1])
        winner = heapq.heappop(waiting)
        bits = frame_bits(winner[2]) if winner[4] else ERROR_FRAME_BITS
        self._occupy(winner, max(t_ns, self._free_ns), bits)

    def _occupy(self, entry: _Offer, start_ns: int, bits: int) -> None:
        self._current = entry
        self._start_ns = start_ns
        self._end_ns = end_ns = start_ns + round(bits * self.bit_ns)
        self._free_ns = end_ns + self.interframe_ns

    def _end(self, entry: _Offer) -> None:
        _, _, frame, sender, intact = entry
        end_ns = self._horizon_ns = self._end_ns
        self._current = None
        self._on_passed(sender, frame, self._start_ns, end_ns, intact)
        if intact:
            self._hear(frame, sender, end_ns)
        if self._waiting or (self._future and self._future[0][0] <= end_ns):
            self._begin(end_ns)

    def _hear(self, frame: Frame, sender: object, t_ns: int) -> None:
        events_ns = self._events_ns
        for index, node in enumerate(self._nodes):
            if node is not sender:
                dues = node.receive(frame, t_ns)
                if dues:
                    self._offer_dues(node, dues)
                event_ns = node.next_event_ns()
                events_ns[index] = NEVER_NS if event_ns is None else event_ns
        self._next_node_ns = min(events_ns, default=NEVER_NS)

    def _advance(self, index: int, t_ns: int) -> None:
        node = self._nodes[index]
        self._horizon_ns = max(t_ns, self._horizon_ns)
        self._offer_dues(node, node.advance(self._horizon_ns))
        self._note_event(index)

    def _offer_dues(self, node: CanNode, dues: Sequence[Due]) -> None:
        for t_ns, frame in dues:
            self.offer(node, frame, t_ns)

    def _note_event(self, index: int) -> None:
        event_ns = self._nodes[index].next_event_ns()
        self._events_ns[index] = NEVER_NS if event_ns is None else event_ns
        self._next_node_ns = min(self._events_ns)


_SENDER = 3
_NOBODYS_ERROR = Frame(0)
