"""Single-axis controllers behind one another on one serial line."""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence

from microdrivers.fakes.pi_gcs.controller import GcsController
from microdrivers.fakes.wire import Reply


class DaisyChain:
    """Up to 16 controllers on one line; implements `fakes.wire.WireEmulator`.

    Every controller hears every byte and answers what is meant for its address. Replies leave in the order in which
    they are ready, which need not be that of the requests, and one after the other.

    Attributes:
        boxes: the controllers by the axis that each of them moves.
    """

    def __init__(self, boxes: Mapping[str, GcsController]) -> None:
        self.boxes = dict(boxes)
        self._number_of_replies = 0
        self._waiting: list[tuple[int, int, int, bytes]] = []

    @property
    def events(self) -> list[tuple[int, str]]:
        """What concerned motion at any controller, in the order of time; see `ControllerState`."""
        return sorted((event for box in self.boxes.values() for event in box.events), key=lambda event: event[0])

    # ------------------------------------------------------------------ the wire's side

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        """Bytes arrive at all controllers; replies wait until they are ready."""
        for place, box in enumerate(self.boxes.values()):
            for reply in box.receive(data, start_ns, end_ns):
                self._number_of_replies += 1
                heapq.heappush(self._waiting, (reply.t_ns, place, self._number_of_replies, reply.data))
        return ()

    def advance(self, t_ns: int) -> Sequence[Reply]:
        """Send the replies that are ready; what has ended by itself is noted."""
        for box in self.boxes.values():
            box.advance(t_ns)
        ready = []
        while self._waiting and self._waiting[0][0] <= t_ns:
            ready_ns, _, _, data = heapq.heappop(self._waiting)
            ready.append(Reply(ready_ns, data))
        return ready

    def next_event_ns(self) -> int | None:
        """When the next reply is ready."""
        return self._waiting[0][0] if self._waiting else None

    # ------------------------------------------------------------------ what befalls the controllers

    def power_cycle(self, t_ns: int) -> None:
        """Switch all controllers off and on; `boxes` has them one by one."""
        for box in self.boxes.values():
            box.power_cycle(t_ns)

    def motion_error(self, key: str, t_ns: int) -> None:
        """Something holds the axis x, y or theta; see `GcsController`."""
        self.boxes[key].motion_error(key, t_ns)
