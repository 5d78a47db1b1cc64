"""Small nodes for an emulated CAN bus."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from microdrivers.core.clock import Clock
from microdrivers.core.units import NS_PER_MS
from microdrivers.fakes.can import Due, Frame

BIT_NS = 2000  # 500 kbit/s
REPLY_NS = 100_000
PATIENCE_S = 5.0

SDO_REQUEST = Frame(0x605, bytes.fromhex("4000100000000000"))
SDO_REPLY = Frame(0x585, bytes.fromhex("4300100092010200"))


def wait_until(clock: Clock, condition: Callable[[], bool]) -> None:
    for _ in range(round(PATIENCE_S / 0.002)):
        if condition():
            return
        clock.sleep(0.002)
    raise AssertionError("it did not happen")


class Listener:
    """Notes what it hears."""

    def __init__(self) -> None:
        self.heard: list[tuple[int, Frame]] = []

    def receive(self, frame: Frame, t_ns: int) -> Sequence[Due]:
        self.heard.append((t_ns, frame))
        return ()

    def advance(self, t_ns: int) -> Sequence[Due]:
        return ()

    def next_event_ns(self) -> int | None:
        return None


class Answering(Listener):
    """Answers each frame of `answers` after 0.1 ms."""

    def __init__(self, answers: dict[Frame, Frame]) -> None:
        super().__init__()
        self.answers = answers

    def receive(self, frame: Frame, t_ns: int) -> Sequence[Due]:
        super().receive(frame, t_ns)
        return (Due(t_ns + REPLY_NS, self.answers[frame]),) if frame in self.answers else ()


class Periodic(Listener):
    """Sends a boot-up when it is switched on, then a counter every `period_ms`, and notes when it was asked."""

    def __init__(self, identifier: int, *, period_ms: float = 10) -> None:
        super().__init__()
        self.identifier = identifier
        self.period_ns = round(period_ms * NS_PER_MS)
        self.count = 0
        self.due_ns: int | None = None
        self.advanced: list[int] = []

    def advance(self, t_ns: int) -> Sequence[Due]:
        self.advanced.append(t_ns)
        if self.due_ns is None:
            self.due_ns = t_ns + self.period_ns
            return (Due(t_ns, Frame(0x700 + (self.identifier & 0x7F), b"\x00")),)
        if t_ns < self.due_ns:
            return ()
        due_ns, self.due_ns = self.due_ns, self.due_ns + self.period_ns
        self.count += 1
        return (Due(due_ns, Frame(self.identifier, self.count.to_bytes(4, "little"))),)

    def next_event_ns(self) -> int | None:
        return self.due_ns
