"""The line between a driver and an emulator, with the time that every byte takes."""

from __future__ import annotations

import itertools
import threading
from collections import deque
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from microdrivers.core.clock import Clock
from microdrivers.core.errors import LinkLost
from microdrivers.core.units import NS_PER_S

LOG_LENGTH = 100_000
"""Records that a wire keeps: the newest; at 100 requests a second, those of the last eight minutes."""


class Reply(NamedTuple):
    """Bytes that an emulator sends, and the earliest time at which the first of them may leave."""

    t_ns: int
    data: bytes


class WireEmulator(Protocol):
    """A device as its serial port sees it. All times are given to it; it never asks for the present."""

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        """Bytes arrive from the host, the first complete after `start_ns`, the last at `end_ns`."""

    def advance(self, t_ns: int) -> Sequence[Reply]:
        """Do what has fallen due by `t_ns` without further bytes (end of a frame by silence, time-outs)."""

    def next_event_ns(self) -> int | None:
        """When `advance` has something to do next, if ever."""


@runtime_checkable
class NetworkEmulator(WireEmulator, Protocol):
    """A device that is reached over a connection, and notices when a host makes one."""

    def connected(self, t_ns: int) -> None:
        """A host connects; whatever belonged to an earlier connection is over."""


class Temper(NamedTuple):
    """How impolite the line is: replies come in up to `max_fragments` pieces, pauses up to `max_pause_s`."""

    max_fragments: int = 3
    max_pause_s: float = 0.0008


class Wire:
    """A full-duplex serial line at a baud rate, seen from the host.

    Args:
        bits_per_byte: start, data, parity and stop bits together: 10 for 8N1, 11 for 8E1.

    Attributes:
        log: what passed, as (time at which the last byte is across in ns, "host" | "device", bytes); the newest
            `LOG_LENGTH` records. Take `list(log)` while the wire is in use.
        wakes_itself: whether the wire asks the clock for its emulator's events; False where somebody else turns it.
    """

    def __init__(
        self,
        emulator: WireEmulator,
        *,
        clock: Clock,
        seed: int,
        baudrate: int,
        bits_per_byte: int = 10,
        temper: Temper | None = None,
    ) -> None:
        self.emulator = emulator
        self.clock = clock
        self.byte_ns = round(bits_per_byte * NS_PER_S / baudrate)
        self.log: deque[tuple[int, str, bytes]] = deque(maxlen=LOG_LENGTH)
        self.plugged = True
        self.in_use = False
        self.wakes_itself = True
        self._temper = temper or Temper()
        self._random = np.random.default_rng(seed)
        self._to_device_free_ns = 0
        self._to_host_free_ns = 0
        self._to_host: deque[tuple[int, bytes]] = deque()
        self._wake_at_ns: int | None = None
        self._lock = threading.RLock()

    # ------------------------------------------------------------------ host side

    def connect(self) -> None:
        """A host opens its port: what arrived while nobody listened is lost.

        Over a network, where a reply belongs to a connection, what is still under way is lost as well.
        """
        with self._lock:
            self.read(self.waiting())
            if isinstance(self.emulator, NetworkEmulator):
                self._to_host.clear()
                self.emulator.connected(self.clock.now_ns())

    def write(self, data: bytes) -> None:
        """The host sends bytes; they take their time on the line."""
        with self._lock:
            self._require_plugged()
            start_ns = max(self.clock.now_ns(), self._to_device_free_ns)
            self._pump(start_ns)
            end_ns = start_ns + len(data) * self.byte_ns
            self._to_device_free_ns = end_ns
            self.log.append((end_ns, "host", data))
            self._transmit(self.emulator.receive(data, start_ns, end_ns))
        self._ask_to_be_woken()

    def read(self, size: int) -> bytes:
        """Up to `size` bytes that have arrived at the host by now."""
        with self._lock:
            self._require_plugged()
            now_ns = self.clock.now_ns()
            self._pump(now_ns)
            received = bytearray()
            while self._to_host and self._to_host[0][0] <= now_ns and len(received) < size:
                t_ns, piece = self._to_host.popleft()
                room = size - len(received)
                received += piece[:room]
                if len(piece) > room:
                    self._to_host.appendleft((t_ns, piece[room:]))
            return bytes(received)

    def waiting(self) -> int:
        """Bytes that have arrived at the host by now."""
        with self._lock:
            self._require_plugged()
            now_ns = self.clock.now_ns()
            self._pump(now_ns)
            return sum(len(piece) for t_ns, piece in self._to_host if t_ns <= now_ns)

    def next_arrival_ns(self) -> int | None:
        """When the host may next find something new; None if nothing is under way."""
        with self._lock:
            times = [self._to_host[0][0]] if self._to_host else []
            event_ns = self.emulator.next_event_ns()
            if event_ns is not None:
                times.append(event_ns)
            return min(times, default=None)

    def unplug(self) -> None:
        """Pull the cable: the host's port fails from now on, and what was under way is gone."""
        with self._lock:
            self.plugged = False
            self._to_host.clear()

    def plug_in(self) -> None:
        """Put the cable back; the host has to open its port again."""
        with self._lock:
            self.plugged = True

    # ------------------------------------------------------------------ device side

    def turn(self) -> None:
        """Let happen at the emulator what is due by now, also while the cable is pulled."""
        with self._lock:
            self._pump(self.clock.now_ns())

    def _ask_to_be_woken(self) -> None:
        with self._lock:
            due_ns = self.emulator.next_event_ns()
            if due_ns is None or not self.wakes_itself:
                return
            if self._wake_at_ns is not None and self._wake_at_ns <= due_ns:
                return  # that call asks again: an event that keeps moving away costs one pending call, not many
            self._wake_at_ns = due_ns
        self.clock.call_at(due_ns, partial(self._wake, due_ns), name="emulator")

    def _wake(self, due_ns: int) -> None:
        with self._lock:
            if self._wake_at_ns == due_ns:
                self._wake_at_ns = None
            self._pump(self.clock.now_ns())
        self._ask_to_be_woken()

    def _pump(self, now_ns: int) -> None:
        while (due_ns := self.emulator.next_event_ns()) is not None and due_ns <= now_ns:
            self._transmit(self.emulator.advance(due_ns))

    def _transmit(self, replies: Sequence[Reply]) -> None:
        for reply in replies:
            at_ns = max(reply.t_ns, self._to_host_free_ns)
            for number, piece in enumerate(self._fragments(reply.data)):
                if number:
                    at_ns += round(self._random.uniform(0.0, self._temper.max_pause_s) * NS_PER_S)
                at_ns += len(piece) * self.byte_ns
                if self.plugged:
                    self._to_host.append((at_ns, piece))
            self.log.append((at_ns, "device", reply.data))
            self._to_host_free_ns = at_ns

    def _fragments(self, data: bytes) -> list[bytes]:
        count = int(self._random.integers(1, self._temper.max_fragments + 1))
        if count == 1:
            return [data] if data else []
        cuts = sorted(int(cut) for cut in self._random.integers(0, len(data) + 1, size=count - 1))
        edges = [0, *cuts, len(data)]
        return [data[a:b] for a, b in itertools.pairwise(edges) if b > a]

    def _require_plugged(self) -> None:
        if not self.plugged:
            raise LinkLost("the emulated cable is unplugged", remedy="plug it in and open the device again")


_wires: dict[str, Wire] = {}


def register_wire(name: str, wire: Wire) -> str:
    """Make a wire known as `fake://NAME` to pyserial; returns that URL."""
    import serial

    package = "microdrivers.fakes.wire"
    if package not in serial.protocol_handler_packages:
        serial.protocol_handler_packages.append(package)
    _wires[name] = wire
    return f"fake://{name}"


def forget_wire(name: str, wire: Wire) -> None:
    """The URL is no longer known, unless another wire has taken it."""
    if _wires.get(name) is wire:
        del _wires[name]


def wire_named(name: str) -> Wire | None:
    """The wire behind `fake://NAME`."""
    return _wires.get(name)
