"""A CAN adapter on a serial port (Lawicel's ASCII protocol, "slcan"), read and written in bulk.

python-can opens and closes it. It would also read byte by byte, three system calls each, which keeps a processor busy
for a third of the time at 1000 frames a second; and it takes a frame for failed that was written if the computer lets
the program wait right afterwards (docs/decisions/0014).
"""

from __future__ import annotations

import os
import select
import socket
from collections import deque

import can
from can.interfaces.slcan import slcanBus

from microdrivers.backends.lines.can_listeners import CanCounters
from microdrivers.backends.lines.ports import DescriptorPort
from microdrivers.core.units import NS_PER_S

_END, _BELL, _TAKEN = b"\r", b"\a", b"z"
_LONGEST_LINE = 32
_CLOSE_WAIT_S = 0.05
_OPENING_COMMANDS = 5
_SPOILT = b"!" + _END
"""Ends a line that was written in part, so that it cannot be a frame."""
_FRAMES = (b"t", b"T", b"r", b"R")


def in_bulk(opened: can.BusABC, counters: CanCounters) -> can.BusABC:
    """The same bus, read and written in bulk if it is such an adapter on a port that can be polled."""
    if not isinstance(opened, slcanBus) or os.name != "posix":
        return opened
    try:
        return BulkSlcan(opened, counters)
    except NotImplementedError:  # a port of pyserial's that is no descriptor
        return opened


class BulkSlcan(can.BusABC):
    """The adapter behind an open bus of python-can's. What arrived before this was made is left out.

    Args:
        opened: the bus.
        counters: where frames are counted that the adapter refuses: it is off the bus, or has no room.

    Raises:
        NotImplementedError: its port has no descriptor.
    """

    def __init__(self, opened: slcanBus, counters: CanCounters) -> None:
        descriptor = opened.fileno()
        super().__init__(opened.serialPortOrig.port)
        self._opened = opened
        self._port = DescriptorPort(descriptor, self._write_rest, lambda: None)
        self._room = select.poll()
        self._room.register(descriptor, select.POLLOUT)
        self._descriptor = descriptor
        self._counters = counters
        self._unanswered = _OPENING_COMMANDS
        self._wait_ms = 0.0
        self._torn = False
        self._lines: deque[bytes] = deque()
        self._begun = b""
        self._in_step = False  # the first line may be the rest of one
        opened.serialPortOrig.write_timeout = _CLOSE_WAIT_S
        if opened.serialPortOrig.port.startswith("socket://"):
            _send_at_once(descriptor)
        self._port.read_available()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Hand a classic frame over; waits up to `timeout` (s) for room.

        Raises:
            CanTimeoutError: the adapter takes no more bytes.
            OSError: it is gone.
        """
        kind = ("R" if msg.is_extended_id else "r") if msg.is_remote_frame else "T" if msg.is_extended_id else "t"
        digits = 8 if msg.is_extended_id else 3
        data = "" if msg.is_remote_frame else msg.data.hex().upper()
        line = f"{kind}{msg.arbitration_id:0{digits}X}{msg.dlc:d}{data}\r".encode()
        self._wait_ms = 1000.0 * (timeout or 0.0)
        if self._torn:
            line = _SPOILT + line
        self._port.write(line)
        self._torn = False

    def shutdown(self) -> None:
        """Close the channel and the port."""
        super().shutdown()
        self._opened.shutdown()

    def fileno(self) -> int:
        """Of the port."""
        return self._descriptor

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        """The next line, if it is a frame; waits for it.

        Raises:
            ValueError: it is neither a frame nor an answer.
        """
        if not self._lines:
            self._take_in(round((timeout or 0.0) * NS_PER_S))
        while self._lines:
            line = self._lines.popleft()
            if line[:1] in _FRAMES:
                return _decode(line), False
        return None, False

    def _take_in(self, wait_ns: int) -> None:
        data = self._begun + self._port.read_within(wait_ns)
        if _BELL in data or (self._unanswered and _TAKEN in data):
            self._count_refusals(data)
        *lines, self._begun = data.replace(_BELL, _END).split(_END)
        if lines and not self._in_step:
            self._in_step = True
            del lines[0]
        self._lines.extend(lines)
        if len(self._begun) > _LONGEST_LINE:
            self._begun, self._in_step = b"", False
            raise ValueError("a line without an end")

    def _count_refusals(self, data: bytes) -> None:
        """Adapters also refuse to close what is closed, and the empty command: python-can begins with both."""
        opening, taken, running = data.partition(_TAKEN) if self._unanswered else (b"", _TAKEN, data)
        count = opening.count(_BELL)
        self._counters.refused += max(0, count - self._unanswered) + running.count(_BELL)
        self._unanswered = 0 if taken else max(0, self._unanswered - count)  # it is open, and has taken a frame

    def _write_rest(self, rest: bytes) -> None:
        """Wait for room; what has no room in time is given up, so that it is not sent at another time."""
        while rest:
            if not self._room.poll(self._wait_ms):
                self._torn = True
                raise can.CanTimeoutError("the adapter takes no more bytes")
            try:
                rest = rest[os.write(self._descriptor, rest) :]
            except BlockingIOError:
                continue


def _decode(line: bytes) -> can.Message:
    text = line.decode("ascii")
    extended, remote = text[0] in "TR", text[0] in "rR"
    digits = 8 if extended else 3
    length, data = int(text[1 + digits]), text[2 + digits :]
    if length > 8 or len(data) != (0 if remote else 2 * length):
        raise ValueError(f"{text!r} is no frame")
    return can.Message(
        arbitration_id=int(text[1 : 1 + digits], 16), is_extended_id=extended, is_remote_frame=remote, dlc=length,
        data=None if remote else bytes.fromhex(data),
    )  # fmt: skip


def _send_at_once(descriptor: int) -> None:
    """A stop must not wait until what was sent before it has been acknowledged (Nagle's algorithm)."""
    with socket.socket(fileno=os.dup(descriptor)) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
