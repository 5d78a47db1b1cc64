"""SDO client: one object of one node at a time, expedited or in segments (CiA 301).

A reply names the object that it belongs to, a segment does not. After a transfer that did not end as it should, the
node is therefore asked for another object first: it answers in order, so nothing older can follow that answer.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

from microdrivers.backends.canopen.aborts import OUT_OF_MEMORY, TIMED_OUT, TOGGLE_BIT, SdoAbort
from microdrivers.backends.canopen.objects import Entry, Value, object_name
from microdrivers.backends.lines.can_line import SILENCE_REMEDY, CanLine
from microdrivers.core.errors import LinkError, LinkTimeout, ProtocolError

Result = TypeVar("Result")

REQUEST_ID, REPLY_ID = 0x600, 0x580
LONGEST = 65536
"""Bytes of an object; a device that sends more does not stop."""

_ABORT = 0x80
_DOWNLOAD, _DOWNLOADED = 0x20, 0x60
_UPLOAD, _UPLOADED = 0x40, 0x40
_NEXT_UPLOAD, _UPLOADED_SEGMENT = 0x60, 0x00
_NEXT_DOWNLOAD, _DOWNLOADED_SEGMENT = 0x00, 0x20
_SPECIFIER, _TOGGLE, _LAST = 0xE0, 0x10, 0x01
_EXPEDITED, _SIZE_SAID = 0x02, 0x01

_MARKERS = ((0x1000, 0), (0x1001, 0), (0x1018, 0))
"""Mandatory objects, any of which shows that all older requests have been answered."""

_HOLD_S = 5.0
_READING, _WRITING = "reading", "writing"
_UPLOAD_HEAD, _NO_DATA = bytes([_UPLOAD]), bytes(4)

_Accept = Callable[[bytes], bool]


class SdoClient:
    """Reads and writes the objects of one node; from any thread, one transfer at a time.

    Args:
        line: an open line, when it comes to that.
        node_id: 1 to 127.
        timeout_s: how long the node may take for each of its frames.
        name: whom messages speak of: "axis x (node 11)".
    """

    def __init__(self, line: CanLine, node_id: int, *, timeout_s: float, name: str) -> None:
        self._line = line
        self._name = name
        self._transfer_name = f"{name}: a transfer"
        self._timeout_s = timeout_s
        self._request_id = REQUEST_ID + node_id
        self._reply_id = REPLY_ID + node_id
        self._lock = threading.Lock()
        self._unsettled = False
        self._markers = deque(_MARKERS)

    # ------------------------------------------------------------------ typed

    def read(self, entry: Entry[Value]) -> Value:
        """The value of an entry.

        Raises:
            SdoAbort: the node refuses. LinkTimeout: it is silent. ProtocolError: it answers something else.
        """
        data, sized = self._transfer(self._upload, entry.index, entry.sub, _READING, entry)
        length = entry.bits // 8
        if not sized and length:
            data = data[:length]
        if length and len(data) != length:
            raise ProtocolError(
                f"{self._name}: {entry} has {len(data)} bytes, not {length}", received=data,
                remedy="check that it is the device of the rig file",
            )  # fmt: skip
        return entry.decode(data)

    def read_optional(self, entry: Entry[Value]) -> Value | None:
        """The value of an entry, None if the node has no such object."""
        try:
            return self.read(entry)
        except SdoAbort as abort:
            if abort.is_missing:
                return None
            raise

    def write(self, entry: Entry[Value], value: Value) -> None:
        """Write an entry; never repeated. Errors as `read`."""
        self.download(entry.index, entry.sub, entry.encode(value))

    # ------------------------------------------------------------------ bytes

    def upload(self, index: int, sub: int) -> bytes:
        """The bytes of an object; 4 of a shorter one if the node does not say how many are valid."""
        data, _ = self._transfer(self._upload, index, sub, _READING)
        return data

    def download(self, index: int, sub: int, data: bytes) -> None:
        """Write the bytes of an object."""
        self._transfer(partial(self._download, data), index, sub, _WRITING)

    def request_write(self, entry: Entry[Value], value: Value) -> None:
        """Send the request to write an entry of 1 to 4 bytes past whatever is under way, and await no reply: a stop.

        It may cut a transfer in segments short; that transfer then fails.
        """
        data = entry.encode(value)
        head = bytes([_DOWNLOAD | (4 - len(data)) << 2 | _EXPEDITED | _SIZE_SAID])
        self._line.send(self._request_id, head + _mux(entry.index, entry.sub) + data.ljust(4, b"\0"))

    # ------------------------------------------------------------------ inside

    def _upload(self, index: int, sub: int) -> tuple[bytes, bool]:
        """The bytes of an object, and whether the node says how many they are."""
        mux = _mux(index, sub)
        reply = self._ask(_UPLOAD_HEAD + mux + _NO_DATA, _answers(_UPLOADED, mux), index, sub, _READING)
        sized = bool(reply[0] & _SIZE_SAID)
        if reply[0] & _EXPEDITED:
            return (reply[4 : 8 - (reply[0] >> 2 & 3)], True) if sized else (reply[4:], False)
        size = int.from_bytes(reply[4:8], "little") if sized else None
        data, toggle, last = bytearray(), 0, False
        while not last:
            head = bytes([_NEXT_UPLOAD | toggle])
            reply = self._ask(head + bytes(7), _segment(_UPLOADED_SEGMENT, mux), index, sub, _READING)
            self._check_toggle(reply, toggle, index, sub)
            data += reply[1 : 8 - (reply[0] >> 1 & 7)]
            last, toggle = bool(reply[0] & _LAST), toggle ^ _TOGGLE
            if len(data) > (LONGEST if size is None else size) or (last and size is not None and len(data) < size):
                self._abort(index, sub, OUT_OF_MEMORY)
                said = "no end" if size is None else f"{size} bytes"
                raise ProtocolError(
                    f"{self._name}: {object_name(index, sub)} has {len(data)} bytes and announces {said}"
                )
        return bytes(data), True

    def _download(self, data: bytes, index: int, sub: int) -> None:
        mux, length = _mux(index, sub), len(data)
        if 1 <= length <= 4:
            head = bytes([_DOWNLOAD | (4 - length) << 2 | _EXPEDITED | _SIZE_SAID])
            self._ask(head + mux + data.ljust(4, b"\0"), _answers(_DOWNLOADED, mux), index, sub, _WRITING)
            return
        head = bytes([_DOWNLOAD | _SIZE_SAID])
        self._ask(head + mux + length.to_bytes(4, "little"), _answers(_DOWNLOADED, mux), index, sub, _WRITING)
        toggle = 0
        for start in range(0, max(length, 1), 7):
            part = data[start : start + 7]
            last = _LAST if start + 7 >= length else 0
            head = bytes([_NEXT_DOWNLOAD | toggle | (7 - len(part)) << 1 | last])
            answers = _segment(_DOWNLOADED_SEGMENT, mux)
            reply = self._ask(head + part.ljust(7, b"\0"), answers, index, sub, _WRITING)
            self._check_toggle(reply, toggle, index, sub)
            toggle ^= _TOGGLE

    def _ask(self, request: bytes, accept: _Accept, index: int, sub: int, what: str) -> bytes:
        reply = self._line.exchange(self._request_id, request, self._reply_id, accept, self._timeout_s).data
        if reply[0] == _ABORT:
            code = int.from_bytes(reply[4:8], "little")
            raise SdoAbort(f"{self._name} refuses {what}", code=code, index=index, sub=sub)
        return reply

    def _transfer(
        self, steps: Callable[[int, int], Result], index: int, sub: int, what: str, entry: Entry[Any] | None = None
    ) -> Result:
        """One transfer: alone with the node, and settled before the next one if it does not end."""
        with self._line.clock.transaction():
            self._line.acquire(self._lock, timeout_s=_HOLD_S, what=self._transfer_name)
            try:
                if self._unsettled:
                    self._settle((index, sub))
                return steps(index, sub)
            except SdoAbort:
                raise
            except LinkTimeout as error:
                self._unsettled = True
                self._abort(index, sub, TIMED_OUT)
                named = f"{self._name}, {what} {entry or object_name(index, sub)}"
                raise LinkTimeout(f"{named}: {error.what}", remedy=error.remedy) from error
            except BaseException:
                self._unsettled = True  # also when interrupted: the reply may still be coming
                raise
            finally:
                self._lock.release()

    def _settle(self, wanted: tuple[int, int]) -> None:
        """Wait for the answer to a question that nobody has asked of late: older ones cannot follow it."""
        self._markers.rotate(-1)
        if self._markers[0] == wanted:
            self._markers.rotate(-1)
        mux = _mux(*self._markers[0])
        request = _UPLOAD_HEAD + mux + _NO_DATA
        self._line.exchange(self._request_id, request, self._reply_id, _answers(_UPLOADED, mux), self._timeout_s)
        self._unsettled = False

    def _check_toggle(self, reply: bytes, toggle: int, index: int, sub: int) -> None:
        if reply[0] & _TOGGLE == toggle:
            return
        self._abort(index, sub, TOGGLE_BIT)
        raise ProtocolError(
            f"{self._name}: a segment of {object_name(index, sub)} came twice or is missing (toggle bit)",
            received=reply, remedy=SILENCE_REMEDY,
        )  # fmt: skip

    def _abort(self, index: int, sub: int, code: int) -> None:
        """Tell the node that the transfer is over; it does not answer."""
        try:
            self._line.send(self._request_id, bytes([_ABORT]) + _mux(index, sub) + code.to_bytes(4, "little"))
        except LinkError:
            return  # the transfer has failed already; its own error says why


def _mux(index: int, sub: int) -> bytes:
    return (index | sub << 16).to_bytes(3, "little")


def _answers(specifier: int, mux: bytes) -> _Accept:
    """Whether a frame answers the request for that object: with this command specifier, or with an abort."""

    def accept(data: bytes) -> bool:
        return len(data) == 8 and data[1:4] == mux and (data[0] & _SPECIFIER == specifier or data[0] == _ABORT)

    return accept


def _segment(specifier: int, mux: bytes) -> _Accept:
    """Whether a frame may be the answer to a segment: with this command specifier, or an abort of this transfer."""

    def accept(data: bytes) -> bool:
        return len(data) == 8 and (data[0] & _SPECIFIER == specifier or (data[0] == _ABORT and data[1:4] == mux))

    return accept
