"""Modbus TCP: frames with a header that carries a transaction number, a length and the unit.

Source: "MODBUS Messaging on TCP/IP, Implementation Guide V1.0b", section 3.1.3 (MBAP header).
"""

from __future__ import annotations

import itertools
import struct

from pymodbus.framer.socket import FramerSocket
from pymodbus.pdu import DecodePDU, ModbusPDU

from microdrivers.backends.lines.serial_line import Exchange, SerialLine
from microdrivers.backends.modbus.framing import EXCEPTION_BIT, EXCEPTION_LENGTH, Expected

_HEADER = struct.Struct(">HHHB")
_BEFORE_LENGTH_COUNTS = 6
_LENGTHS = range(3, 255)
"""What a header's length may be: it counts the unit id and a PDU of 2 to 253 bytes."""


class MbapFraming:
    """Modbus TCP to a device or a gateway; the gateway keeps the silences of the serial line behind it."""

    gap_s = 0.0
    description = "Modbus TCP"
    repeats = False

    def __init__(self) -> None:
        self._framer = FramerSocket(DecodePDU(is_server=False))
        self._numbers = itertools.count(1)

    def frame(self, request: ModbusPDU) -> bytes:
        """Header with the next transaction number, and PDU."""
        request.transaction_id = next(self._numbers) & 0xFFFF
        return self._framer.buildFrame(request)

    def finder(self, frame: bytes, expected: Expected) -> MbapReply:
        """Finds the reply that carries the frame's number."""
        return MbapReply(frame, expected)

    def settle(self, _line: SerialLine, _unit_id: int, /) -> None:
        """Nothing to do: a late reply tells by its number that it is not wanted."""

    def sampled_within(self, exchange: Exchange, start: int) -> tuple[int, int]:
        """From the request's start to the reply's arrival: a network has no byte times."""
        return exchange.request_start_ns, exchange.end_ns if start else exchange.first_byte_ns


class MbapReply:
    """Goes from header to header until the one with the request's number, and past bytes that are no header."""

    def __init__(self, frame: bytes, expected: Expected) -> None:
        self.pdu = b""
        self.start = 0
        self.complaint = ""
        self.received = b""
        self._number, _, _, self._unit_id = _HEADER.unpack_from(frame)
        self._own_head = frame[:4]
        self._expected = expected

    def complete(self, received: bytes) -> bool:
        """Whether `received` holds the reply, or cannot become it any more."""
        self.received = received
        start = 0
        while len(received) - start >= _HEADER.size:
            number, protocol, length, unit_id = _HEADER.unpack_from(received, start)
            end = start + _BEFORE_LENGTH_COUNTS + length
            if protocol or length not in _LENGTHS:
                self.complaint = f"no Modbus TCP header (protocol id {protocol:04X}h, length {length})"
                if number == self._number:
                    return True
                start = received.find(self._own_head, 1)  # an earlier header may have been none, too
                if start < 0:
                    return False
            elif number != self._number:
                start = end
            elif unit_id != self._unit_id:
                self.complaint = f"an answer of unit {unit_id}"
                return True
            elif len(received) < end:
                return False
            else:
                self._take(start, received[start + _HEADER.size : end])
                return True
        return False

    def _take(self, start: int, pdu: bytes) -> None:
        head, length = self._expected
        is_exception = pdu[0] == head[0] | EXCEPTION_BIT and len(pdu) == EXCEPTION_LENGTH
        if is_exception or (pdu.startswith(head) and len(pdu) == length):
            self.pdu, self.start = pdu, start
        else:
            self.complaint = "an answer that does not fit the request"
