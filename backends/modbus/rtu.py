"""Modbus RTU: frames that end with a CRC and a silence, and carry no number.

Source: "MODBUS over Serial Line, Specification and Implementation Guide V1.02", section 2.5.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from typing import NamedTuple, Protocol

from pymodbus.framer.rtu import FramerRTU
from pymodbus.pdu import DecodePDU, ModbusPDU
from pymodbus.pdu.diag_message import ReturnQueryDataRequest
from pymodbus.pdu.register_message import ReadInputRegistersRequest

from microdrivers.backends.lines.serial_line import Exchange, SerialLine
from microdrivers.backends.lines.settings import SerialConnection
from microdrivers.backends.modbus.framing import EXCEPTION_BIT, EXCEPTION_LENGTH, Expected
from microdrivers.core.units import NS_PER_S, seconds_to_ns

_AROUND_PDU = 3
"""Bytes of a frame beside its PDU: unit id and CRC."""


class RtuTiming(NamedTuple):
    """Silences on the line, s.

    `silent_s` (t3.5) is what a device waits for before it takes a message as ended; `gap_s` is what the host must keep
    between the end of a reply and its next request.
    """

    silent_s: float
    gap_s: float


class Marks(Protocol):
    """Requests whose replies can be told from all that may still be under way."""

    def next(self, unit_id: int, /) -> tuple[ModbusPDU, Expected]:
        """The next such request, and how its reply begins."""


class EchoMarks:
    """A fresh number that the unit echoes (function 08h, sub-function 0)."""

    def __init__(self) -> None:
        self._numbers = itertools.count(1)

    def next(self, unit_id: int) -> tuple[ModbusPDU, Expected]:
        """A request with another number than those before."""
        number = (next(self._numbers) & 0xFFFF).to_bytes(2, "big")
        request = ReturnQueryDataRequest(message=number, dev_id=unit_id)
        echo = bytes((request.function_code,)) + request.encode()
        return request, Expected(echo, len(echo))


class LengthMarks:
    """Reads of input registers (function 04h) of changing length, for units that are silent on function 08h.

    Args:
        address: the first register.
        counts: how many registers to read, in turn; no other request may read as many input registers.
    """

    def __init__(self, address: int, counts: Sequence[int]) -> None:
        self._address = address
        self._counts = itertools.cycle(counts)

    def next(self, unit_id: int) -> tuple[ModbusPDU, Expected]:
        """A read of another length than the one before."""
        count = next(self._counts)
        request = ReadInputRegistersRequest(address=self._address, count=count, dev_id=unit_id)
        return request, Expected(bytes((request.function_code, 2 * count)), 2 + 2 * count)


class RtuFraming:
    """RTU over a serial line, or over TCP through a serial server.

    A reply says nothing of its request but function and length: the late reply to one read looks like the reply to
    another. So when a reply has failed to come, `settle` has the unit answer a mark. Units answer in order: behind that
    answer nothing older can follow.

    Args:
        marks: what the unit answers for certain; by default an echo.
    """

    repeats = True

    def __init__(self, connection: SerialConnection, timing: RtuTiming, marks: Marks | None = None) -> None:
        self.gap_s = timing.gap_s
        self.description = (
            f"{connection.baudrate} baud, parity {connection.parity}, "
            f"{connection.stopbits} stop bit{'s' * (connection.stopbits > 1)}"
        )
        self._framer = FramerRTU(DecodePDU(is_server=False))
        self._byte_ns = round(connection.bits_per_byte * NS_PER_S / connection.baudrate)
        self._silent_ns = seconds_to_ns(timing.silent_s)
        self._marks = EchoMarks() if marks is None else marks

    def frame(self, request: ModbusPDU) -> bytes:
        """Unit id, PDU, CRC."""
        return self._framer.buildFrame(request)

    def finder(self, frame: bytes, expected: Expected) -> RtuReply:
        """Finds the reply to a frame, also behind stray bytes; gives up at once if another message comes."""
        return RtuReply(frame[0], expected)

    def settle(self, line: SerialLine, unit_id: int) -> None:
        """Exchange a mark with the unit.

        Raises:
            LinkError: it was not answered.
        """
        request, expected = self._marks.next(unit_id)
        line.exchange(self.frame(request), RtuReply(unit_id, expected, patient=True).complete)

    def sampled_within(self, exchange: Exchange, start: int) -> tuple[int, int]:
        """From the silence that ends the request to the reply's first bit: where in between is not documented.

        A line without byte times (a pseudo-terminal, a serial server) leaves only the interval from the request's start
        to the reply's arrival.
        """
        earliest_ns = exchange.request_end_ns + self._silent_ns
        latest_ns = exchange.end_ns - (len(exchange.reply) - start) * self._byte_ns
        if not start:
            latest_ns = min(latest_ns, exchange.first_byte_ns - self._byte_ns)
        if latest_ns < earliest_ns:
            return exchange.request_start_ns, exchange.end_ns if start else exchange.first_byte_ns
        return earliest_ns, latest_ns


class RtuReply:
    """Knows the reply that a request must have, and finds it also behind stray bytes.

    Args:
        patient: wait on if a sound message comes that is not the reply, instead of giving up.
    """

    def __init__(self, unit_id: int, expected: Expected, *, patient: bool = False) -> None:
        self.pdu = b""
        self.start = 0
        self.complaint = ""
        self.received = b""
        self._unit_id = unit_id
        self._patient = patient
        self._head = bytes((unit_id,)) + expected.head
        self._length = expected.length + _AROUND_PDU
        self._exception_head = bytes((unit_id, expected.head[0] | EXCEPTION_BIT))
        self._exception_length = EXCEPTION_LENGTH + _AROUND_PDU

    def complete(self, received: bytes) -> bool:
        """Whether `received` holds the reply, or cannot become it any more."""
        self.received = received
        if self._find(self._head, self._length) or self._find(self._exception_head, self._exception_length):
            return True
        if self._patient:
            return False
        if len(received) >= self._exception_length and not received.startswith(self._head) and _is_sound(received):
            stranger = received[0] != self._unit_id
            self.complaint = f"an answer of unit {received[0]}" if stranger else "an answer to another request"
            return True
        if len(received) >= self._length and not self._under_way():
            self.complaint = "bad CRC or garbled bytes"
            return True
        return False

    def _find(self, head: bytes, length: int) -> bool:
        start = self.received.find(head)
        while start >= 0 and start + length <= len(self.received):
            frame = self.received[start : start + length]
            if _is_sound(frame):
                self.pdu, self.start = frame[1:-2], start
                return True
            start = self.received.find(head, start + 1)
        return False

    def _under_way(self) -> bool:
        """Whether the reply may have begun behind stray bytes and not ended yet."""
        received = self.received
        first_unfinished = max(1, len(received) - self._length + 1)
        return any(
            received[start : start + len(self._head)] == self._head[: len(received) - start]
            for start in range(first_unfinished, len(received))
        )


@functools.lru_cache(maxsize=256)  # a device that is polled says the same again most of the time
def _is_sound(frame: bytes) -> bool:
    return FramerRTU.check_CRC(frame[:-2], int.from_bytes(frame[-2:], "big"))
