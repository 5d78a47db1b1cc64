"""A serial-line CAN adapter (Lawicel's ASCII protocol, "slcan") as its serial port sees it.

Source: Lawicel CAN232/CANUSB manual. Where adapters differ, this one does as the recorded session in the tests: opening
an open channel and closing a closed one is answered by a carriage return, an empty line by a bell.
"""

from __future__ import annotations

import errno
import re
import threading
from collections import deque
from collections.abc import Callable, Sequence

from microdrivers.core.errors import OutOfRange
from microdrivers.fakes.can.arrival import Arrival
from microdrivers.fakes.can.frame import Frame
from microdrivers.fakes.can.medium import BITRATES, Medium
from microdrivers.fakes.can.port import Port, PortError
from microdrivers.fakes.wire import Reply

OK, BELL = b"\r", b"\a"

RECEIVE_QUEUE = 32
"""Frames that wait in the adapter while the serial line is busy."""

RECEIVE_FULL, TRANSMIT_FULL, BUS_ERROR = 0x01, 0x02, 0x80
"""Status flags; `F` tells and clears them."""

_STANDARD = re.compile(r"([0-9A-Fa-f]{3})([0-8])([0-9A-Fa-f]*)")
_EXTENDED = re.compile(r"([0-9A-Fa-f]{8})([0-8])([0-9A-Fa-f]*)")
_LONGEST_LINE = 26  # T, identifier, length and 8 bytes
_VERSION, _SERIAL_NUMBER = b"V1013\r", b"NA123\r"


class SlcanAdapter:
    """The adapter between a serial line and a medium; a `WireEmulator`.

    Commands: S0 to S8, O, L, C, t, T, r, R, F, V, N. A frame that was taken over is answered by `z` (29 bits: `Z`) and
    a carriage return, everything wrong by a bell. Frames from the bus go out as soon as the serial line is free; when
    `RECEIVE_QUEUE` of them wait, further ones are lost and `F` tells.

    Args:
        byte_ns: time of a byte on the serial line.

    Attributes:
        lost_frames: frames that came while the queue was full.
        held_up: whether the host takes no more bytes at the moment.
        wake: called in real time, by whoever holds the medium, when something waits for `advance`.
    """

    def __init__(self, medium: Medium, *, byte_ns: int) -> None:
        self.lost_frames = 0
        self.held_up: Callable[[], bool] = lambda: False
        self.wake: Callable[[], None] | None = None
        self._medium = medium
        self._byte_ns = byte_ns
        self._woken = False
        self._looker = 0
        self._turns = False
        self._line = bytearray()
        self._bitrate: int | None = None
        self._port: Port | None = None
        self._listen_only = False
        self._flags = 0
        self._line_free_ns = 0
        self._leaving_ns: deque[int] = deque()

    def switch_off(self) -> None:
        """The adapter loses its supply; everything starts anew afterwards."""
        self._close()
        self._line.clear()
        self._bitrate, self._flags, self._line_free_ns = None, 0, 0
        self._leaving_ns.clear()

    def turn_medium(self, turns: bool) -> None:
        """Let the medium go on whenever the adapter is asked to, or no more: in real time, once `wake` is set."""
        self._turns = turns
        self._medium.turned_by(self._tell if turns else None)

    # ------------------------------------------------------------------ as a WireEmulator

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        """Bytes from the host; each line is carried out when its last byte is there."""
        replies = list(self.advance(start_ns))
        for number, octet in enumerate(data, start=1):
            if octet != OK[0]:
                self._line.append(octet)
                continue
            t_ns = start_ns + (end_ns - start_ns) * number // len(data)
            line = bytes(self._line)
            self._line.clear()
            replies.append(self._reply(t_ns, self._execute(line, t_ns)))
        del self._line[_LONGEST_LINE + 1 :]  # enough to know that it is too long
        return replies

    def advance(self, t_ns: int) -> Sequence[Reply]:
        """Pass on what has arrived on the bus by `t_ns`."""
        replies: list[Reply] = []
        if self._turns:
            self._medium.turn(t_ns)
        port = self._port
        try:
            while port is not None and (arrival := port.poll(t_ns)) is not None:
                replies += self._pass_on(arrival)
        except PortError:
            self._lose_bus()
        return replies

    def next_event_ns(self) -> int | None:
        """When a frame can next have arrived; from now on `wake` is called for others."""
        self._looker = threading.get_ident()
        self._woken, port = False, self._port  # before looking: what comes after this look wakes again
        due_ns = None if port is None else port.next_arrival_ns()
        if not self._turns:
            return due_ns
        event_ns = self._medium.next_event_ns()
        return min(event_ns, event_ns if due_ns is None else due_ns)

    # ------------------------------------------------------------------ commands

    def _execute(self, line: bytes, t_ns: int) -> bytes:
        if not line or len(line) > _LONGEST_LINE or not line.isascii():
            return BELL
        command, text = chr(line[0]), line[1:].decode("ascii")
        if command in "tTrR":
            return self._transmit(command, text, t_ns)
        plain = {"O": self._open, "L": self._listen, "C": self._close, "F": self._status}
        if command in plain and not text:
            return plain[command]()
        if line == b"V":
            return _VERSION
        if line == b"N":
            return _SERIAL_NUMBER
        if command == "S" and self._port is None and text in "012345678" and len(text) == 1:
            self._bitrate = BITRATES[int(text)]
            return OK
        return BELL

    def _open(self) -> bytes:
        if self._port is not None:
            return OK
        if self._bitrate is None:
            return BELL
        try:
            self._port = self._medium.open_port(bitrate=self._bitrate)
        except PortError:
            return BELL
        self._port.on_arrival(self._tell)
        self._listen_only = False
        return OK

    def _listen(self) -> bytes:
        answer = self._open()
        self._listen_only = self._port is not None
        return answer

    def _close(self) -> bytes:
        if self._port is not None:
            self._port.close()
            self._port = None
        return OK

    def _status(self) -> bytes:
        if self._port is None and not self._flags:
            return BELL
        flags, self._flags = self._flags, 0
        return f"F{flags:02X}\r".encode()

    def _transmit(self, command: str, text: str, t_ns: int) -> bytes:
        frame = _parse(command, text)
        if frame is None or self._port is None or self._listen_only:
            return BELL
        try:
            self._port.send(frame, t_ns=t_ns)
        except OutOfRange:
            return BELL
        except PortError as error:
            if error.number == errno.ENOBUFS:
                self._flags |= TRANSMIT_FULL
            else:
                self._lose_bus()
            return BELL
        return b"Z\r" if frame.extended else b"z\r"

    def _lose_bus(self) -> None:
        self._flags |= BUS_ERROR
        self._port = None

    # ------------------------------------------------------------------ to the host

    def _tell(self) -> None:
        if self.wake is not None and not self._woken and threading.get_ident() != self._looker:
            self._woken = True
            self.wake()

    def _pass_on(self, arrival: Arrival) -> list[Reply]:
        if arrival.error:
            self._flags |= BUS_ERROR
            return []
        while self._leaving_ns and self._leaving_ns[0] <= arrival.t_ns:
            self._leaving_ns.popleft()
        if len(self._leaving_ns) >= RECEIVE_QUEUE or self.held_up():
            self._flags |= RECEIVE_FULL
            self.lost_frames += 1
            return []
        reply = self._reply(arrival.t_ns, _format(arrival.frame))
        self._leaving_ns.append(reply.t_ns)
        return [reply]

    def _reply(self, t_ns: int, data: bytes) -> Reply:
        start_ns = max(t_ns, self._line_free_ns)
        self._line_free_ns = start_ns + len(data) * self._byte_ns
        return Reply(start_ns, data)


def _parse(command: str, text: str) -> Frame | None:
    extended, remote = command in "TR", command in "rR"
    match = (_EXTENDED if extended else _STANDARD).fullmatch(text)
    if match is None:
        return None
    identifier, length, data = match.groups()
    count = int(length)
    if len(data) != (0 if remote else 2 * count):
        return None
    return Frame(int(identifier, 16), bytes(count) if remote else bytes.fromhex(data), extended, remote)


def _format(frame: Frame) -> bytes:
    command = ("r" if frame.remote else "t") if not frame.extended else ("R" if frame.remote else "T")
    identifier = f"{frame.id:08X}" if frame.extended else f"{frame.id:03X}"
    data = "" if frame.remote else frame.data.hex().upper()
    return f"{command}{identifier}{len(frame.data)}{data}\r".encode()
