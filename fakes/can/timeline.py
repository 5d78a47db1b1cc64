"""What happens on one CAN bus, frame by frame, as a function of the times that are handed in."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Container, Sequence
from heapq import heapify, heappop, heappush
from typing import Final, Protocol

from microdrivers.core.units import NS_PER_S
from microdrivers.fakes.can.frame import ERROR_FRAME_BITS, INTERFRAME_BITS, MOST_BITS, Due, Frame, frame_shape

NEVER_NS = 1 << 63


class CanNode(Protocol):
    """A device on the bus. All times are given to it; it never asks for the present, and they never run backwards.

    A node may have an attribute `listens_to`, a container that is replaced by another one, never altered: frames of
    identifiers that are not in it leave the node as it is, and need not be given to it. Without one, it is given all.
    It may have a method `excuse_hosts`, see `BusTimeline`.
    """

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


# Rank in arbitration, number of the offer, frame, sender, whether the others can read it, how long it takes (ns). A
# plain tuple: one is made for each frame.
_Offer = tuple[int, int, Frame, object, bool, int]


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
        bit_ns = NS_PER_S / bitrate
        self.interframe_ns: int = round(INTERFRAME_BITS * bit_ns)
        self._times_ns: list[int] = [round(bits * bit_ns) for bits in range(MOST_BITS + 1)]
        self._error_ns = self._times_ns[ERROR_FRAME_BITS]
        self._on_passed = on_passed
        self._nodes: list[CanNode] = []
        self._listens_to: list[Container[int]] = []
        self._routes: dict[int, list[tuple[int, CanNode]]] = {}  # by identifier, whom a frame concerns
        self._events_ns: list[int] = []
        self._next_node_ns = NEVER_NS
        self._future: list[tuple[int, _Offer]] = []  # heap by time; they compete later
        self._waiting: list[_Offer] = []  # heap by rank; they have competed and lost
        self._next_number = itertools.count().__next__
        self._current: _Offer | None = None
        self._end_ns = -self.interframe_ns  # of the frame on the bus, or of the last one
        self._horizon_ns = 0  # when something has happened last
        self._playing = False

    # ------------------------------------------------------------------ who is there

    def attach(self, node: CanNode, t_ns: int) -> None:
        """A node is switched on."""
        self._horizon_ns = max(t_ns, self._horizon_ns)
        self._nodes.append(node)
        self._listens_to.append(_NOTHING)
        self._events_ns.append(NEVER_NS)
        self._advance(len(self._nodes) - 1, self._horizon_ns)

    def detach(self, node: CanNode, t_ns: int) -> None:
        """A node is gone, and its frames with it."""
        index = next(index for index, known in enumerate(self._nodes) if known is node)
        del self._nodes[index], self._listens_to[index], self._events_ns[index]
        self._routes.clear()
        self._next_node_ns = min(self._events_ns, default=NEVER_NS)
        self.withdraw(node, t_ns)

    def ask_nodes(self) -> None:
        """Ask all nodes for their next events again."""
        for index in range(len(self._nodes)):
            self._look_at(index)

    def excuse_hosts(self, late_ns: int, until_ns: int) -> None:
        """Have nodes grant hosts `late_ns` more for what they have to send, and until `until_ns` at least."""
        for index, node in enumerate(self._nodes):
            excuse = getattr(node, "excuse_hosts", None)
            if excuse is not None:
                excuse(late_ns, until_ns)
                self._look_at(index)

    # ------------------------------------------------------------------ frames

    def offer(self, sender: object, frame: Frame, t_ns: int, readable: bool = True) -> None:
        """A frame that competes from `t_ns` on, or from what has happened last if that is later.

        It is `readable` unless the others can only see an error in it (another bit rate).

        Raises:
            OutOfRange: it is no classic frame.
        """
        rank, bits = frame_shape(frame)
        duration_ns = self._times_ns[bits] if readable else self._error_ns
        ready_ns = t_ns if t_ns > self._horizon_ns else self._horizon_ns
        heappush(self._future, (ready_ns, (rank, self._next_number(), frame, sender, readable, duration_ns)))

    def withdraw(self, sender: object, t_ns: int) -> None:
        """Take back all frames of a sender, also the one that is on the bus."""
        self._future = [item for item in self._future if item[1][_SENDER] is not sender]
        self._waiting = [entry for entry in self._waiting if entry[_SENDER] is not sender]
        heapify(self._future)
        heapify(self._waiting)
        if self._current is not None and self._current[_SENDER] is sender:
            self._current = None
            self._end_ns = max(t_ns, self._horizon_ns)

    def disturb(self, t_ns: int) -> object:
        """An error frame, now; the frame that it destroys competes again. Returns whose that was, or None."""
        hit, now_ns = self._current, max(t_ns, self._horizon_ns)
        sender = None if hit is None else hit[_SENDER]
        if hit is not None and sender is not None:
            heappush(self._waiting, hit)
        self._horizon_ns = now_ns
        self._current, self._end_ns = (0, 0, _NOBODYS_ERROR, None, False, self._error_ns), now_ns + self._error_ns
        return sender

    # ------------------------------------------------------------------ time

    def duration_ns(self, frame: Frame | None) -> int:
        """What a frame takes on the bus, without the interframe space; None is an error frame."""
        return self._error_ns if frame is None else self._times_ns[frame_shape(frame)[1]]

    @property
    def last_event_ns(self) -> int:
        """When something has happened last."""
        return self._horizon_ns

    def next_event_ns(self) -> int:
        """When something happens next; `NEVER_NS` if all is quiet."""
        bus_ns = self._end_ns if self._current is not None else self._next_start_ns()
        return bus_ns if bus_ns < self._next_node_ns else self._next_node_ns

    def play(self, until_ns: int, reached: Callable[[], object] | None = None) -> int:
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
                bus_ns = self._end_ns if current is not None else self._next_start_ns()
                if node_ns < bus_ns or (node_ns == bus_ns and current is None):
                    if until_ns < node_ns:
                        return node_ns
                    self._advance(self._events_ns.index(node_ns), node_ns)
                elif until_ns < bus_ns:
                    return bus_ns
                elif current is None:
                    self._horizon_ns = bus_ns
                    self._begin(bus_ns)
                else:
                    self._end(current)
                    if reached is not None and reached():
                        break
        finally:
            self._playing = False
        return self.next_event_ns()

    def _next_start_ns(self) -> int:
        if not (self._waiting or self._future):
            return NEVER_NS
        free_ns = self._end_ns + self.interframe_ns
        if not self._waiting and self._future[0][0] > free_ns:
            return self._future[0][0]
        return free_ns

    def _begin(self, t_ns: int) -> None:
        """Arbitrate among what is ready by `t_ns`."""
        waiting, future = self._waiting, self._future
        if not waiting and len(future) == 1:  # nobody contends
            winner = future.pop()[1]
        else:
            while future and future[0][0] <= t_ns:
                heappush(waiting, heappop(future)[1])
            winner = heappop(waiting)
        free_ns = self._end_ns + self.interframe_ns
        self._current, self._end_ns = winner, (t_ns if t_ns > free_ns else free_ns) + winner[_DURATION]

    def _end(self, entry: _Offer) -> None:
        _, _, frame, sender, intact, duration_ns = entry
        end_ns = self._horizon_ns = self._end_ns
        self._current = None
        self._on_passed(sender, frame, end_ns - duration_ns, end_ns, intact)
        if intact:
            identifier = frame.id
            concerned = self._routes.get(identifier)
            if concerned is None or self._next_node_ns <= end_ns:
                concerned = self._concerned(identifier, end_ns)
            for index, node in concerned:
                if node is not sender:
                    for due in node.receive(frame, end_ns):
                        self.offer(node, due.frame, due.t_ns)
                    self._look_at(index)
        if self._waiting or (self._future and self._future[0][0] <= end_ns):
            self._begin(end_ns)

    def _concerned(self, identifier: int, t_ns: int) -> list[tuple[int, CanNode]]:
        """To whom a frame is to be given: who listens, and who has something to do at that time."""
        all_of_them = list(enumerate(self._nodes))
        if identifier <= _HIGHEST_STANDARD_ID:
            self._routes[identifier] = [each for each in all_of_them if identifier in self._listens_to[each[0]]]
        return [
            (index, node)
            for index, node in all_of_them
            if identifier in self._listens_to[index] or self._events_ns[index] <= t_ns
        ]

    def _advance(self, index: int, t_ns: int) -> None:
        node = self._nodes[index]
        self._horizon_ns = max(t_ns, self._horizon_ns)
        for due in node.advance(self._horizon_ns):
            self.offer(node, due.frame, due.t_ns)
        self._look_at(index)

    def _look_at(self, index: int) -> None:
        """Something may have happened in a node."""
        node, events_ns = self._nodes[index], self._events_ns
        event_ns = node.next_event_ns()
        if event_ns is None:
            event_ns = NEVER_NS
        if event_ns != events_ns[index]:
            events_ns[index] = event_ns
            self._next_node_ns = min(events_ns)
        listens_to = getattr(node, "listens_to", _ALL_IDS)
        if listens_to is not self._listens_to[index]:
            self._listens_to[index] = listens_to
            self._routes.clear()


_SENDER: Final = 3
_DURATION: Final = 5
_NOBODYS_ERROR = Frame(0)
_ALL_IDS, _NOTHING, _HIGHEST_STANDARD_ID = range(1 << 29), (), 0x7FF
