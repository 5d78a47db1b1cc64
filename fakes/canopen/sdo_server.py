"""The SDO server: expedited and segmented transfers in both directions; no block transfers (CiA 301, 7.2.4)."""

from __future__ import annotations

from dataclasses import dataclass, field

from microdrivers.core.units import NS_PER_S
from microdrivers.fakes.canopen.aborts import AbortCode, SdoAbort
from microdrivers.fakes.canopen.dictionary import Entry, ObjectDictionary

PATIENCE_NS = NS_PER_S
"""A half transfer is aborted when the client has been silent for so long."""

_SEGMENT = 7
_LONGEST_DOWNLOAD = 4096
_ABORT = 0x80
_NO_REST = bytes(7)


@dataclass(slots=True)
class _Transfer:
    """A segmented transfer under way; `size` is what the client has announced."""

    multiplexor: bytes
    entry: Entry
    upload: bool
    deadline_ns: int
    size: int | None = None
    data: bytearray = field(default_factory=bytearray)
    done: int = 0
    toggle: int = 0


def is_upload(request: bytes) -> bool:
    """Whether a request begins to read an object, which changes nothing in the device."""
    return bool(request) and request[0] & 0xE0 == 0x40


class SdoServer:
    """Answers requests; one transfer at a time, a new one takes the place of a half one.

    Attributes:
        transfer: the one that is under way in segments.
    """

    def __init__(self, dictionary: ObjectDictionary) -> None:
        self._dictionary = dictionary
        self.transfer: _Transfer | None = None

    def request(self, data: bytes, t_ns: int) -> bytes | None:
        """The reply to a request that was received at `t_ns`; None if there is none (an abort, not 8 bytes)."""
        if len(data) != 8:
            return None
        command = data[0]
        try:
            if command & 0xE0 == 0x40:
                return self._begin_upload(data, t_ns)
            if command & 0xE0 == 0x20:
                return self._begin_download(data, t_ns)
            if command & 0xE0 in (0x60, 0x00):
                return self._next_segment(data, t_ns)
            if command == _ABORT:
                self.transfer = None
                return None
            raise SdoAbort(AbortCode.UNKNOWN_SPECIFIER)
        except SdoAbort as refusal:
            multiplexor = data[1:4]
            if command & 0xE0 in (0x60, 0x00):
                multiplexor = bytes(3) if self.transfer is None else self.transfer.multiplexor
            self.transfer = None
            return _abort(multiplexor, refusal.code)

    def cancel(self) -> None:
        """Forget a half transfer."""
        self.transfer = None

    @property
    def deadline_ns(self) -> int | None:
        """When a half transfer is aborted."""
        return None if self.transfer is None else self.transfer.deadline_ns

    def time_out(self) -> bytes:
        """Give a half transfer up; what is to be sent."""
        assert self.transfer is not None
        multiplexor, self.transfer = self.transfer.multiplexor, None
        return _abort(multiplexor, AbortCode.TIMED_OUT)

    # ------------------------------------------------------------------ initiate

    def _begin_upload(self, data: bytes, t_ns: int) -> bytes:
        self.transfer = None
        entry = self._dictionary.find(data[1] | data[2] << 8, data[3])
        value = entry.upload(t_ns)
        size = len(value)
        multiplexor = data[1:4]
        if 0 < size <= 4:
            return bytes((0x43 | (4 - size) << 2,)) + multiplexor + value + bytes(4 - size)
        self.transfer = _Transfer(multiplexor, entry, True, t_ns + PATIENCE_NS, data=bytearray(value))
        return b"\x41" + multiplexor + size.to_bytes(4, "little")

    def _begin_download(self, data: bytes, t_ns: int) -> bytes:
        self.transfer = None
        command, multiplexor = data[0], data[1:4]
        entry = self._dictionary.find(data[1] | data[2] << 8, data[3])
        expedited, sized = command & 2, command & 1
        if expedited:
            size = 4 - (command >> 2 & 3) if sized else min(entry.type.size or 4, 4)
            entry.download(data[4 : 4 + size], t_ns)
        else:
            announced = int.from_bytes(data[4:8], "little") if sized else None
            entry.check_download(announced)
            self.transfer = _Transfer(multiplexor, entry, False, t_ns + PATIENCE_NS, size=announced)
        return b"\x60" + multiplexor + bytes(4)

    # ------------------------------------------------------------------ segments

    def _next_segment(self, data: bytes, t_ns: int) -> bytes:
        transfer, command = self.transfer, data[0]
        if transfer is None or transfer.upload != (command & 0xE0 == 0x60):
            raise SdoAbort(AbortCode.UNKNOWN_SPECIFIER)
        if command & 0x10 != transfer.toggle:
            raise SdoAbort(AbortCode.TOGGLE_NOT_ALTERNATED)
        toggle = transfer.toggle
        transfer.toggle ^= 0x10
        transfer.deadline_ns = t_ns + PATIENCE_NS
        if transfer.upload:
            return self._give_segment(transfer, toggle)
        self._take_segment(transfer, data, t_ns)
        return bytes((0x20 | toggle,)) + _NO_REST

    def _give_segment(self, transfer: _Transfer, toggle: int) -> bytes:
        piece = bytes(transfer.data[transfer.done : transfer.done + _SEGMENT])
        transfer.done += len(piece)
        last = transfer.done == len(transfer.data)
        if last:
            self.transfer = None
        unused = _SEGMENT - len(piece)
        return bytes((toggle | unused << 1 | last,)) + piece + bytes(unused)

    def _take_segment(self, transfer: _Transfer, data: bytes, t_ns: int) -> None:
        transfer.data += data[1 : 8 - (data[0] >> 1 & 7)]
        announced = transfer.size
        if len(transfer.data) > (_LONGEST_DOWNLOAD if announced is None else announced):
            raise SdoAbort(AbortCode.TOO_LONG)
        if data[0] & 1:
            if announced is not None and len(transfer.data) < announced:
                raise SdoAbort(AbortCode.TOO_SHORT)
            transfer.entry.download(bytes(transfer.data), t_ns)
            self.transfer = None


def _abort(multiplexor: bytes, code: AbortCode) -> bytes:
    return b"\x80" + multiplexor + code.to_bytes(4, "little")
