"""Modbus master: one request, one exact reply, and every failure by its name.

Requests and replies are built and decoded with pymodbus; waiting, time-outs and stamps are the line's, on the clock
(docs/decisions/0011). Functions and exceptions: "MODBUS Application Protocol Specification V1.1b3", sections 6 and 7.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Sequence
from typing import NamedTuple

from pymodbus.pdu import DecodePDU, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadInputRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from microdrivers.backends.lines.serial_line import Exchange, SerialLine
from microdrivers.backends.modbus.framing import Expected, Framing, ReplyFinder
from microdrivers.backends.modbus.mbap import MbapFraming
from microdrivers.backends.modbus.rtu import Marks, RtuFraming, RtuTiming
from microdrivers.backends.modbus.settings import ModbusConnection
from microdrivers.core.errors import LinkTimeout, MicrodriversError, Moved, ProtocolError, RefusedError

_WRITE_BLOCK = 0x10
_WRITE_BLOCK_ECHO = 5

_GATEWAY_SILENCE = 0x0B
_MODEL = "check that the unit is the model that the rig file names"
_OTHER_DEVICE = "; or another device is behind this port"
_STATE = "check the device's settings and its state"
_REFUSALS = {
    0x01: ("the function is not supported", _MODEL),
    0x02: ("the register addresses are not all there, or go beyond FFFFh", _MODEL),
    0x03: ("the number of registers or bytes is wrong, or a value is not allowed", _STATE),
    0x04: ("a setting is out of range, or the command is not executable now", _STATE),
    0x06: ("the device is busy", "try again"),
    0x0A: ("the gateway knows no way to the unit", "check the unit id, and the gateway's settings"),
}


class ModbusRefusal(RefusedError):
    """The device answered with a Modbus exception: it has not done what was asked."""

    def __init__(self, what: str, *, remedy: str, exception_code: int) -> None:
        super().__init__(what, remedy=remedy)
        self.exception_code = exception_code


class _NotSent(LinkTimeout):
    """The unit was silent before, and gives no sign yet."""


class Registers(NamedTuple):
    """Registers as read, and when the device sampled them: `t_ns` ± `dt_ns` on the line's clock."""

    values: tuple[int, ...]
    t_ns: int
    dt_ns: int


class _Question(NamedTuple):
    """A request and what must answer it; `frame` only where the same may be sent again and again."""

    request: ModbusPDU
    expected: Expected
    what: str
    frame: bytes = b""


def framing_of(connection: ModbusConnection, rtu_timing: RtuTiming, marks: Marks | None = None) -> Framing:
    """The framing that a connection asks for; silences and marks of RTU are the device's."""
    return MbapFraming() if connection.framing == "tcp" else RtuFraming(connection, rtu_timing, marks)


class ModbusMaster:
    """Speaks to one unit on a line, from any thread.

    After a failed exchange the line is not believed until the framing has settled it, so that no late reply is taken
    for the next one's.

    Args:
        line: opened and closed by somebody else.
        silence_remedy: what to check if the unit gives no answer.
    """

    def __init__(self, line: SerialLine, framing: Framing, *, unit_id: int, silence_remedy: str) -> None:
        self.unit_id = unit_id
        self._line = line
        self._framing = framing
        self._silence_remedy = f"{silence_remedy}{_OTHER_DEVICE}"
        self._decoder = DecodePDU(is_server=False)
        self._lock = threading.RLock()
        self._unsettled = False
        self._questions: dict[tuple[type[ModbusPDU], int, int], _Question] = {}
        self._unit = f"unit {unit_id} on {line.connection.port} ({framing.description})"

    def read(self, address: int, count: int) -> Registers:
        """Read `count` registers from `address` on (function 03h).

        Without a sound reply it is repeated once. Writes never are: the first one may have been carried out.

        Raises:
            ModbusRefusal: the device answered with an exception.
            LinkTimeout, ProtocolError: no sound reply, twice.
        """
        return self._read(ReadHoldingRegistersRequest, address, count, "registers")

    def read_input(self, address: int, count: int) -> Registers:
        """Read `count` input registers from `address` on (function 04h).

        Raises:
            ModbusRefusal, LinkTimeout, ProtocolError: as for `read`.
        """
        return self._read(ReadInputRegistersRequest, address, count, "input registers")

    def write(self, address: int, value: int) -> None:
        """Write one register (function 06h), once.

        Raises:
            ModbusRefusal, LinkTimeout, ProtocolError: as they come; after the latter two it may have been written.
        """
        request = self._write_request(address, (value,))
        echo = bytes((request.function_code,)) + request.encode()
        what = f"a write of {value:04X}h to register {address:04X}h"
        self._exchange(_Question(request, Expected(echo, len(echo)), what), moved="maybe")

    def write_block(self, address: int, values: Sequence[int]) -> None:
        """Write consecutive registers (function 10h), once.

        Raises:
            ModbusRefusal, LinkTimeout, ProtocolError: as they come; after the latter two they may have been written.
        """
        request = WriteMultipleRegistersRequest(address=address, registers=list(values), dev_id=self.unit_id)
        echo = bytes((_WRITE_BLOCK,)) + request.encode()[: _WRITE_BLOCK_ECHO - 1]
        what = f"a write of {len(values)} registers at {address:04X}h"
        self._exchange(_Question(request, Expected(echo, _WRITE_BLOCK_ECHO), what), moved="maybe")

    def post(self, address: int, values: Sequence[int]) -> None:
        """Write one register or more as soon as the line is free, from any thread, without awaiting the reply."""
        frame = self._framing.frame(self._write_request(address, values))
        self._unsettled = True  # the reply must not be taken for another's
        self._line.post(frame)

    # ------------------------------------------------------------------ inside

    def _read(self, kind: type[ModbusPDU], address: int, count: int, what: str) -> Registers:
        question = self._questions.get((kind, address, count))
        if question is None:
            question = self._reading(kind, address, count, what)
            self._questions[kind, address, count] = question
        try:
            return self._read_once(question)
        except (LinkTimeout, ProtocolError) as error:
            try:
                return self._read_once(question)
            except _NotSent:
                raise error from None

    def _reading(self, kind: type[ModbusPDU], address: int, count: int, what: str) -> _Question:
        request = kind(address=address, count=count, dev_id=self.unit_id)
        expected = Expected(bytes((request.function_code, 2 * count)), 2 + 2 * count)
        frame = self._framing.frame(request) if self._framing.repeats else b""
        return _Question(request, expected, f"a read of {count} {what} at {address:04X}h", frame)

    def _write_request(self, address: int, values: Sequence[int]) -> ModbusPDU:
        kind = WriteSingleRegisterRequest if len(values) == 1 else WriteMultipleRegistersRequest
        return kind(address=address, registers=list(values), dev_id=self.unit_id)

    def _read_once(self, question: _Question) -> Registers:
        reply, exchange = self._exchange(question, moved="no")
        values = struct.unpack_from(f">{len(reply.pdu) // 2 - 1}H", reply.pdu, 2)
        earliest_ns, latest_ns = self._framing.sampled_within(exchange, reply.start)
        half_ns = -(-(latest_ns - earliest_ns) // 2)
        return Registers(values, earliest_ns + half_ns, half_ns)

    def _exchange(self, question: _Question, *, moved: Moved) -> tuple[ReplyFinder, Exchange]:
        """Ask, and find the reply that is expected."""
        what = question.what
        with self._line.clock.transaction(), self._lock:  # its end may dispatch others that use this master
            try:
                if self._unsettled:
                    self._settle(what)
                frame = question.frame or self._framing.frame(question.request)
                reply = self._framing.finder(frame, question.expected)
                exchange = self._line_exchange(frame, reply, what, moved)
                if len(reply.pdu) != question.expected.length:
                    raise self._failure(frame, reply, what, moved)
                return reply, exchange
            except ModbusRefusal:
                raise
            except BaseException:
                self._unsettled = True  # also when interrupted: the reply may still be coming
                raise

    def _settle(self, what: str) -> None:
        self._unsettled = False  # first: a post that comes meanwhile must not be forgotten
        try:
            self._framing.settle(self._line, self.unit_id)
        except LinkTimeout as error:
            raise _NotSent(
                f"{self._unit} was silent before and still is, so {what} was not sent: {error.what}",
                remedy=self._silence_remedy,
                moved="no",
            ) from error

    def _line_exchange(self, frame: bytes, reply: ReplyFinder, what: str, moved: Moved) -> Exchange:
        try:
            return self._line.exchange(frame, reply.complete)
        except LinkTimeout as error:
            if reply.complaint:
                raise self._misfit(frame, reply, what, moved) from error
            raise LinkTimeout(
                f"{self._unit} gave no whole answer to {what}: {error.what}",
                remedy=self._silence_remedy,
                moved=moved,
            ) from error

    def _failure(self, frame: bytes, reply: ReplyFinder, what: str, moved: Moved) -> MicrodriversError:
        """What an exception means, or that there is no reply at all."""
        pdu = self._decoder.decode(reply.pdu) if reply.pdu else None
        if pdu is None or not pdu.isError():
            return self._misfit(frame, reply, what, moved)
        code = pdu.exception_code
        passed = f"sent {frame.hex(' ')}, received {reply.received.hex(' ')}"
        if code in _REFUSALS:
            meaning, remedy = _REFUSALS[code]
            return ModbusRefusal(
                f"{self._unit} refused {what} with exception {code:02X}: {meaning}; {passed}",
                remedy=remedy,
                exception_code=code,
            )
        if code == _GATEWAY_SILENCE:
            return LinkTimeout(
                f"the gateway got no answer to {what} from {self._unit}; {passed}",
                remedy=self._silence_remedy, moved=moved,
            )  # fmt: skip
        return ProtocolError(
            f"{self._unit}: unknown exception {code:02X} in reply to {what}",
            sent=frame, received=reply.received, remedy=_MODEL, moved=moved,
        )  # fmt: skip

    def _misfit(self, frame: bytes, reply: ReplyFinder, what: str, moved: Moved) -> ProtocolError:
        return ProtocolError(
            f"{self._unit}: {reply.complaint or 'undecodable reply'} in reply to {what}",
            sent=frame, received=reply.received, moved=moved,
            remedy="check that every unit on the line has its own id and that nobody else talks there; on a serial "
            "line also parity, wiring and termination" + _OTHER_DEVICE,
        )  # fmt: skip
