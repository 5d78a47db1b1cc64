"""Modbus RTU over a serial line: one request, one exact reply, and every failure by its name.

Frames are built and decoded with pymodbus; waiting, time-outs and stamps are the line's, on the clock. Timing and
exceptions: Oriental Motor HP-5142E, "Communication timing" and "Exception response".
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from pymodbus.framer.rtu import FramerRTU
from pymodbus.pdu import DecodePDU, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from microdrivers.backends.lines.serial_line import Exchange, SerialLine
from microdrivers.core.errors import LinkTimeout, Moved, ProtocolError, RefusedError
from microdrivers.core.units import NS_PER_S, seconds_to_ns

READ_REPEATS = 1
"""How often a read without a sound reply is repeated. Writes never are: the first one may have been carried out."""

_EXCEPTION_BIT = 0x80
_EXCEPTION_BYTES = 5
_ECHO_BYTES = 8
_EXCEPTIONS = {
    1: "the function is not supported",
    2: "the register addresses go beyond FFFFh",
    3: "the number of registers or bytes is wrong",
    4: "a setting is out of range, or the command is not executable now",
}


class RtuTiming(NamedTuple):
    """Silences on the line (HP-5142E, "Communication timing"), s.

    `silent_s` is C3.5, after which the drive takes a message as ended; `gap_s` is Tb4, what the host must keep
    between the end of a reply and its next request (less: the drive drops the request and counts an error).
    """

    silent_s: float
    gap_s: float


TIMING_9600 = RtuTiming(silent_s=0.004, gap_s=0.005)
"""HP-5142E: C3.5 and Tb4 at 9600 baud."""

TIMING_19200_UP = RtuTiming(silent_s=0.0025, gap_s=0.003)
"""HP-5142E: C3.5 and Tb4 at 19200 baud and more."""


def rtu_timing(baudrate: int) -> RtuTiming:
    """The silences that belong to a baud rate."""
    return TIMING_19200_UP if baudrate >= 19200 else TIMING_9600


class RtuRefusal(RefusedError):
    """The device answered with a Modbus exception; `exception_code` is 1 to 4."""

    def __init__(self, what: str, *, exception_code: int) -> None:
        super().__init__(what, remedy="check the device's model, its settings and its state")
        self.exception_code = exception_code


class Registers(NamedTuple):
    """Registers as read, and when the device sampled them: `t_ns` ± `dt_ns` on the line's clock."""

    values: tuple[int, ...]
    t_ns: int
    dt_ns: int


class RtuMaster:
    """Speaks to one unit on a line."""

    def __init__(self, line: SerialLine, *, unit_id: int) -> None:
        self.unit_id = unit_id
        self._line = line
        self._framer = FramerRTU(DecodePDU(is_server=False))
        connection = line.connection
        self._byte_ns = round(connection.bits_per_byte * NS_PER_S / connection.baudrate)
        self._silent_ns = seconds_to_ns(rtu_timing(connection.baudrate).silent_s)
        self._address_on_line = (
            f"unit {unit_id} on {connection.port} ({connection.baudrate} baud, parity {connection.parity}, "
            f"{connection.stopbits} stop bit{'s' * (connection.stopbits > 1)})"
        )

    def read(self, address: int, count: int) -> Registers:
        """Read `count` registers from `address` on (function 03h).

        Raises:
            RtuRefusal: the device answered with an exception.
            LinkTimeout, ProtocolError: no sound reply, twice.
        """
        frame = self._frame(ReadHoldingRegistersRequest(address=address, count=count, dev_id=self.unit_id))
        what = f"a read of {count} registers at {address:04X}h"
        for _ in range(READ_REPEATS):
            try:
                return self._read_once(frame, count, what)
            except (LinkTimeout, ProtocolError):
                continue
        return self._read_once(frame, count, what)

    def write(self, address: int, value: int) -> None:
        """Write one register (function 06h), once.

        Raises:
            RtuRefusal, LinkTimeout, ProtocolError: as they come; after the latter two it may have been written.
        """
        frame = self._write_frame(address, value)
        reply = _Reply(frame[:-2], _ECHO_BYTES)
        self._exchange(frame, reply, f"a write of {value:04X}h to register {address:04X}h", moved="maybe")

    def write_block(self, address: int, values: Sequence[int]) -> None:
        """Write consecutive registers (function 10h), once.

        Raises:
            RtuRefusal, LinkTimeout, ProtocolError: as they come; after the latter two they may have been written.
        """
        frame = self._frame(WriteMultipleRegistersRequest(address=address, registers=list(values), dev_id=self.unit_id))
        reply = _Reply(frame[:6], _ECHO_BYTES)
        self._exchange(frame, reply, f"a write of {len(values)} registers at {address:04X}h", moved="maybe")

    def post(self, address: int, value: int) -> None:
        """Write one register as soon as the line is free, from any thread, without awaiting the reply."""
        self._line.post(self._write_frame(address, value))

    # ------------------------------------------------------------------ inside

    def _frame(self, request: ModbusPDU) -> bytes:
        return self._framer.buildFrame(request)

    def _write_frame(self, address: int, value: int) -> bytes:
        return self._frame(WriteSingleRegisterRequest(address=address, registers=[value], dev_id=self.unit_id))

    def _read_once(self, frame: bytes, count: int, what: str) -> Registers:
        reply = _Reply(bytes((self.unit_id, frame[1], 2 * count)), 5 + 2 * count)
        pdu, exchange = self._exchange(frame, reply, what, moved="no")
        return Registers(tuple(pdu.registers), *self._sampled_at(exchange))

    def _exchange(self, frame: bytes, reply: _Reply, what: str, *, moved: Moved) -> tuple[ModbusPDU, Exchange]:
        try:
            exchange = self._line.exchange(frame, reply.complete)
        except LinkTimeout as error:
            raise LinkTimeout(
                f"{self._address_on_line} gave no whole answer to {what}: {error.what}",
                remedy="compare unit id, baud rate and parity with the drive's switches and parameters (factory: 8E1); "
                "check that SW1-2 is on (Modbus), the wires A and B, and the drive's power",
                moved=moved,
            ) from error
        if reply.frame is None:
            raise ProtocolError(
                f"{self._address_on_line}: {reply.complaint()} in reply to {what}", sent=frame,
                received=exchange.reply, moved=moved,
                remedy="check parity, wiring and termination, and that every unit on the line has its own id",
            )  # fmt: skip
        pdu = self._framer.decoder.decode(reply.frame[1:-2])
        if pdu is None:
            raise ProtocolError(f"{self._address_on_line}: undecodable reply", sent=frame, received=reply.frame)
        if pdu.isError():
            meaning = _EXCEPTIONS.get(pdu.exception_code, "unknown exception")
            raise RtuRefusal(
                f"{self._address_on_line} refused {what} with exception {pdu.exception_code:02X}: {meaning}",
                exception_code=pdu.exception_code,
            )
        return pdu, exchange

    def _sampled_at(self, exchange: Exchange) -> tuple[int, int]:
        """Middle and half-width of the interval in which the device sampled what it reports.

        It cannot act on a request before the silence that ends it, and must have sampled before the reply's first
        bit. Where in between is not documented, so the whole interval is given. A line without byte times (a
        pseudo-terminal) leaves only the interval from the request's start to the first byte.
        """
        earliest_ns = exchange.request_end_ns + self._silent_ns
        latest_ns = min(exchange.first_byte_ns - self._byte_ns, exchange.end_ns - len(exchange.reply) * self._byte_ns)
        if latest_ns < earliest_ns:
            earliest_ns, latest_ns = exchange.request_start_ns, exchange.first_byte_ns
        half_ns = -(-(latest_ns - earliest_ns) // 2)
        return earliest_ns + half_ns, half_ns


class _Reply:
    """Knows the reply that a request must have, and finds it also behind stray bytes.

    Args:
        head: how the reply begins.
        length: its number of bytes, CRC included.
    """

    def __init__(self, head: bytes, length: int) -> None:
        self.frame: bytes | None = None
        self._head = head
        self._length = length
        self._exception_head = bytes((head[0], head[1] | _EXCEPTION_BIT))
        self._answered_by: int | None = None

    def complete(self, received: bytes) -> bool:
        """Whether `received` holds the reply, or cannot become it any more."""
        self.frame = self._find(received, self._head, self._length) or self._find(
            received, self._exception_head, _EXCEPTION_BYTES
        )
        if self.frame is not None:
            return True
        if len(received) >= _EXCEPTION_BYTES and not received.startswith(self._head) and _is_sound(received):
            self._answered_by = received[0]
            return True
        return len(received) >= self._length and not self._under_way(received)

    def complaint(self) -> str:
        """What is wrong with a reply that is complete and not the right one."""
        if self._answered_by is None:
            return "bad CRC or garbled bytes"
        if self._answered_by == self._head[0]:
            return "an answer to another request"
        return f"an answer of unit {self._answered_by}"

    @staticmethod
    def _find(received: bytes, head: bytes, length: int) -> bytes | None:
        start = received.find(head)
        while start >= 0 and start + length <= len(received):
            frame = received[start : start + length]
            if _is_sound(frame):
                return frame
            start = received.find(head, start + 1)
        return None

    def _under_way(self, received: bytes) -> bool:
        """Whether the reply may have begun behind stray bytes and not ended yet."""
        first_unfinished = max(1, len(received) - self._length + 1)
        return any(
            received[start : start + len(self._head)] == self._head[: len(received) - start]
            for start in range(first_unfinished, len(received))
        )


def _is_sound(frame: bytes) -> bool:
    return FramerRTU.check_CRC(frame[:-2], int.from_bytes(frame[-2:], "big"))
