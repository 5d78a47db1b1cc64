"""Errors of a device: its error register, their history, and the emergency messages (CiA 301, 7.2.7)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from microdrivers.fakes.canopen.aborts import AbortCode, SdoAbort
from microdrivers.fakes.canopen.data_types import U8, U32, Value
from microdrivers.fakes.canopen.dictionary import Entry

HEARTBEAT_LOST = 0x8130
PDO_LENGTH = 0x8210
BUS_COMMUNICATION = 0x8100

_KEPT = 8
_GENERIC = 0x01
_REGISTER_BITS = (
    (0x2000, 0x2FFF, 0x02),  # current
    (0x3000, 0x3FFF, 0x04),  # voltage
    (0x4000, 0x4FFF, 0x08),  # temperature
    (0x8100, 0x82FF, 0x10),  # communication
    (0x7000, 0x7FFF, 0x20),  # what the device profile knows: sensors, motors
    (0x8400, 0x86FF, 0x20),  # controllers of velocity and position
    (0xFF00, 0xFFFF, 0x80),  # the maker's own
)


def register_of(code: int) -> int:
    """The bits of the error register (1001h) that an error code sets: generic, and the class that it belongs to."""
    return _GENERIC | sum(bit for low, high, bit in _REGISTER_BITS if low <= code <= high)


class Emergencies:
    """What is wrong with a device at present, and what was.

    Each error is told once, when it happens; when it is over, code 0000h is sent with the register of what remains.

    Args:
        send: puts the 8 bytes of an emergency message on the bus.
    """

    def __init__(self, send: Callable[[bytes, int], None]) -> None:
        self._send = send
        self._present: dict[int, int] = {}
        self._history: deque[int] = deque(maxlen=_KEPT)

    @property
    def register(self) -> int:
        """The error register, 1001h."""
        bits = 0
        for each in self._present.values():
            bits |= each
        return bits

    def happen(self, code: int, t_ns: int, *, info: bytes = b"", register: int | None = None) -> None:
        """Tell of an error, unless it is known already.

        `info` are up to 5 bytes of the maker's. `register` are bits of the error register, where they are not those of
        the code's class.
        """
        if code in self._present:
            return
        self._present[code] = register_of(code) if register is None else register
        self._history.appendleft(code | int.from_bytes(info[:2], "little") << 16)
        self._send(code.to_bytes(2, "little") + bytes((self.register,)) + info.ljust(5, b"\0"), t_ns)

    def pass_by(self, t_ns: int, *codes: int) -> None:
        """These errors, or all of them, are over."""
        before = len(self._present)
        for code in codes or tuple(self._present):
            self._present.pop(code, None)
        if len(self._present) < before:
            self._send(bytes((0, 0, self.register)) + bytes(5), t_ns)

    def forget(self) -> None:
        """As after power-on; nothing is sent."""
        self._present.clear()
        self._history.clear()

    def entries(self) -> list[Entry]:
        """1001h and 1003h."""

        def clear(value: Value, _t_ns: int) -> None:
            if value:
                raise SdoAbort(AbortCode.VALUE_RANGE)
            self._history.clear()

        def past(number: int) -> Callable[[int], int]:
            def read(_t_ns: int) -> int:
                if number > len(self._history):
                    raise SdoAbort(AbortCode.NO_DATA)
                return self._history[number - 1]

            return read

        return [
            Entry(0x1001, 0, U8, "ro", mapping="tpdo", read=lambda _: self.register),
            Entry(0x1003, 0, U8, "rw", read=lambda _: len(self._history), write=clear),
            *(Entry(0x1003, number, U32, "ro", read=past(number)) for number in range(1, _KEPT + 1)),
        ]
