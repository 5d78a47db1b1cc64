"""Modbus RTU as a slave sees it: silence ends a frame, and everything doubtful is met with silence.

Sources: Modbus over serial line V1.02; for timing and for what the drive answers, Oriental Motor HP-5142E,
"Modbus RTU control".
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.fakes.wire import Reply

RS485_ERROR = 0x84
UNDEFINED_COMMAND = 0x88
NV_MEMORY_BUSY = 0x8A
OUT_OF_RANGE = 0x8C
NOT_EXECUTABLE = 0x8D

_MAX_FRAME = 256
_BROADCAST = 0
_MAX_READ, _MAX_WRITE, _MAX_WRITE_WITH_READ = 125, 123, 121
_TRANSMISSION_WAITING_NS = 3 * NS_PER_MS
_AFTER_BROADCAST_NS = 5 * NS_PER_MS
_PROCESSING_MS = (0.3, 0.8)
_EXTRA_DELAY_MS = 0.3


class LineTiming(NamedTuple):
    """What the drive asks of a line: C3.5, silence that ends a frame, and Tb4, a pause after its reply."""

    silence_ns: int
    pause_after_reply_ns: int


_SLOW = LineTiming(silence_ns=4 * NS_PER_MS, pause_after_reply_ns=5 * NS_PER_MS)
_FAST = LineTiming(silence_ns=5 * NS_PER_MS // 2, pause_after_reply_ns=3 * NS_PER_MS)


def line_timing(baudrate: int) -> LineTiming:
    """C3.5 and Tb4 of the drive (HP-5142E): 4.0 and 5.0 ms at 9600 baud, 2.5 and 3.0 ms from 19200 on."""
    return _SLOW if baudrate < 19200 else _FAST


def crc16(data: bytes) -> int:
    """CRC-16/MODBUS: polynomial 0xA001 (reflected), initial value 0xFFFF."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ 0xA001 if crc & 1 else crc >> 1
    return crc


def frame(unit_id: int, pdu: bytes) -> bytes:
    """A PDU with its address in front and its CRC, low byte first, behind."""
    body = bytes((unit_id,)) + pdu
    return body + struct.pack("<H", crc16(body))


class ModbusException(Exception):
    """A request that is answered with an exception.

    Args:
        code: exception code on the wire, 1 to 4.
        error: the drive's own communication error code (register 00ACh).
    """

    def __init__(self, code: int, error: int) -> None:
        super().__init__(f"exception {code:02X}h, communication error {error:02X}h")
        self.code = code
        self.error = error


class Registers(Protocol):
    """What lies behind the frames. Addresses are below 10000h; values are unsigned 16-bit words."""

    @property
    def hides_slave_errors(self) -> bool:
        """Whether a normal reply stands in for exception 04."""

    def read(self, address: int, count: int, t_ns: int) -> list[int]:
        """Values at `t_ns`; raises ModbusException."""

    def write(self, address: int, values: Sequence[int], t_ns: int) -> None:
        """All values or, with a ModbusException, none of them."""

    def frame_received(self, t_ns: int) -> None:
        """A sound frame for this drive ended."""

    def communication_error(self, t_ns: int, error: int, *, frame_lost: bool) -> None:
        """Something was wrong with a frame as a whole (`frame_lost`) or with what it asked for."""

    def advance(self, t_ns: int) -> None:
        """Do what has fallen due by `t_ns`."""

    def next_event_ns(self) -> int | None:
        """When something falls due by itself, if ever."""


class RtuSlave:
    """The drive's RS-485 port; a `WireEmulator`.

    Args:
        registers: the drive behind the port.
        unit_id: its address, 1 to 31.
        bits_per_byte: 11 for 8E1, the drive's factory setting.
        seed: of the delays of its replies.
    """

    def __init__(self, registers: Registers, *, unit_id: int, baudrate: int, bits_per_byte: int, seed: int) -> None:
        self.registers = registers
        self.unit_id = unit_id
        self.timing = line_timing(baudrate)
        self._byte_ns = round(bits_per_byte * NS_PER_S / baudrate)
        self._random = np.random.default_rng(seed)
        self._received = bytearray()
        self._first_byte_ns = 0
        self._last_byte_ns = 0
        self._deaf_until_ns = -(10**18)
        self._functions: dict[int, Callable[[bytes, int], bytes]] = {
            0x03: self._read,
            0x06: self._write_single,
            0x08: self._diagnose,
            0x10: self._write_multiple,
            0x17: self._read_write,
        }

    # ------------------------------------------------------------------ wire

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        """Bytes without a gap, the first of which begins at `start_ns`."""
        replies = self.advance(start_ns)
        if data:
            if not self._received:
                self._first_byte_ns = start_ns
            room = _MAX_FRAME + 1 - len(self._received)
            self._received += data[:room]
            self._last_byte_ns = end_ns
        return replies

    def advance(self, t_ns: int) -> list[Reply]:
        """Take the frame that has ended in silence by `t_ns`; let the drive do what falls due by itself."""
        replies = []
        if self._received and self._last_byte_ns + self.timing.silence_ns <= t_ns:
            received = bytes(self._received)
            self._received.clear()
            reply = self._take(received)
            if reply is not None:
                replies.append(reply)
        self.registers.advance(t_ns)
        return replies

    def next_event_ns(self) -> int | None:
        """End of the present frame by silence, or the drive's next event."""
        event_ns = self.registers.next_event_ns()
        if not self._received:
            return event_ns
        end_ns = self._last_byte_ns + self.timing.silence_ns
        return end_ns if event_ns is None else min(end_ns, event_ns)

    # ------------------------------------------------------------------ frames

    def _take(self, received: bytes) -> Reply | None:
        silent_ns = self._last_byte_ns + self.timing.silence_ns
        sound = 4 <= len(received) <= _MAX_FRAME and crc16(received) == 0
        if not sound or self._first_byte_ns < self._deaf_until_ns:
            self.registers.communication_error(silent_ns, RS485_ERROR, frame_lost=True)
            return None
        unit_id, pdu = received[0], received[1:-2]
        if unit_id not in (self.unit_id, _BROADCAST):
            return None
        processing_ns, extra_ns = self._delays_ns()
        done_ns = silent_ns + processing_ns
        self.registers.frame_received(done_ns)
        answer = self._execute(pdu, done_ns)
        if unit_id == _BROADCAST:
            self._deaf_until_ns = silent_ns + _AFTER_BROADCAST_NS
            return None
        reply = Reply(silent_ns + max(processing_ns, _TRANSMISSION_WAITING_NS) + extra_ns, frame(self.unit_id, answer))
        self._deaf_until_ns = reply.t_ns + len(reply.data) * self._byte_ns + self.timing.pause_after_reply_ns
        return reply

    def _delays_ns(self) -> tuple[int, int]:
        processing_ms = self._random.uniform(*_PROCESSING_MS)
        extra_ms = self._random.uniform(0.0, _EXTRA_DELAY_MS)
        return round(processing_ms * NS_PER_MS), round(extra_ms * NS_PER_MS)

    def _execute(self, pdu: bytes, t_ns: int) -> bytes:
        function = pdu[0]
        try:
            if function not in self._functions:
                raise ModbusException(1, UNDEFINED_COMMAND)
            return bytes((function,)) + self._functions[function](pdu[1:], t_ns)
        except ModbusException as exception:
            self.registers.communication_error(t_ns, exception.error, frame_lost=False)
            return bytes((function | 0x80, exception.code))

    # ------------------------------------------------------------------ functions: data in, data out

    def _read(self, data: bytes, t_ns: int) -> bytes:
        _require(len(data) == 4)
        address, count = struct.unpack(">HH", data)
        _require(1 <= count <= _MAX_READ)
        return self._words(address, count, t_ns)

    def _write_single(self, data: bytes, t_ns: int) -> bytes:
        _require(len(data) == 4)
        address, value = struct.unpack(">HH", data)
        self._store(address, [value], t_ns)
        return data

    def _diagnose(self, data: bytes, t_ns: int) -> bytes:
        del t_ns
        _require(len(data) >= 2)
        if data[:2] != b"\x00\x00":
            raise ModbusException(1, UNDEFINED_COMMAND)
        _require(len(data) == 4)
        return data

    def _write_multiple(self, data: bytes, t_ns: int) -> bytes:
        _require(len(data) >= 5)
        address, count, values = _parse_values(data, _MAX_WRITE)
        self._store(address, values, t_ns)
        return struct.pack(">HH", address, count)

    def _read_write(self, data: bytes, t_ns: int) -> bytes:
        _require(len(data) >= 9)
        address, count = struct.unpack(">HH", data[:4])
        _require(1 <= count <= _MAX_READ)
        write_address, _, values = _parse_values(data[4:], _MAX_WRITE_WITH_READ)
        _check_span(address, count)
        self._store(write_address, values, t_ns)
        return self._words(address, count, t_ns)

    def _words(self, address: int, count: int, t_ns: int) -> bytes:
        _check_span(address, count)
        words = self.registers.read(address, count, t_ns)
        return struct.pack(f">B{count}H", 2 * count, *words)

    def _store(self, address: int, values: Sequence[int], t_ns: int) -> None:
        _check_span(address, len(values))
        try:
            self.registers.write(address, values, t_ns)
        except ModbusException as exception:
            if exception.code != 4 or not self.registers.hides_slave_errors:
                raise
            self.registers.communication_error(t_ns, exception.error, frame_lost=False)


def _require(well_formed: bool) -> None:
    if not well_formed:
        raise ModbusException(3, OUT_OF_RANGE)


def _check_span(address: int, count: int) -> None:
    if address + count > 0x10000:
        raise ModbusException(2, UNDEFINED_COMMAND)


def _parse_values(data: bytes, most: int) -> tuple[int, int, list[int]]:
    address, count, size = struct.unpack(">HHB", data[:5])
    _require(1 <= count <= most and size == 2 * count and len(data) == 5 + size)
    return address, count, list(struct.unpack(f">{count}H", data[5:]))
