"""What the two framings of Modbus have in common: a request, the PDU that must answer it, and when it was sampled."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from pymodbus.pdu import ModbusPDU

from microdrivers.backends.lines.serial_line import Exchange, SerialLine

EXCEPTION_BIT = 0x80
EXCEPTION_LENGTH = 2


class Expected(NamedTuple):
    """The PDU (function code and data) that answers a request: how it begins, and its number of bytes."""

    head: bytes
    length: int


class ReplyFinder(Protocol):
    """Looks for the reply to one request in what arrives.

    Attributes:
        pdu: the reply that is expected, or an exception (another length), without its framing; empty until it is found.
        start: where in the received bytes its frame begins.
        complaint: what is wrong with what arrived instead; empty if nothing is known to be.
        received: all that has arrived.
    """

    pdu: bytes
    start: int
    complaint: str
    received: bytes

    def complete(self, received: bytes) -> bool:
        """Whether `received` holds the reply, or cannot become it any more."""


class Framing(Protocol):
    """How requests and replies are told apart on the way.

    Attributes:
        gap_s: silence that the host keeps between a reply and its next request.
        description: for messages.
        repeats: whether the same request always gives the same frame.
    """

    gap_s: float
    description: str
    repeats: bool

    def frame(self, request: ModbusPDU) -> bytes:
        """The bytes to send."""

    def finder(self, frame: bytes, expected: Expected) -> ReplyFinder:
        """What finds the reply to a frame."""

    def settle(self, line: SerialLine, unit_id: int, /) -> None:
        """Make sure that what arrives from here on answers no earlier request.

        Raises:
            LinkError: the unit gave no sign.
        """

    def sampled_within(self, exchange: Exchange, start: int) -> tuple[int, int]:
        """The interval in which the device sampled what it reports, ns; the reply begins at byte `start`."""
