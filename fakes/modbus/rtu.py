"""Modbus RTU as a slave sees it: silence ends a frame, and everything doubtful is met with silence.

Source: Modbus over serial line V1.02.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.fakes.modbus.functions import ILLEGAL_FUNCTION, Function, ModbusException
from microdrivers.fakes.wire import Reply

_MAX_FRAME = 256
_BROADCAST = 0


class SlaveTiming(NamedTuple):
    """What a slave asks of its line, and how long it takes.

    Attributes:
        silence_ns: silence that ends a frame.
        pause_after_reply_ns: a frame that begins sooner after the end of its reply is lost on it.
        pause_after_broadcast_ns: the same after the silence that ends a broadcast.
        waiting_ns: least time between the end of that silence and its reply.
        processing_ms: least and greatest time that a request takes.
        scatter_ms: its reply comes up to so much later.
    """

    silence_ns: int
    pause_after_reply_ns: int
    pause_after_broadcast_ns: int
    waiting_ns: int
    processing_ms: tuple[float, float]
    scatter_ms: float


class ModbusDevice(Protocol):
    """What lies behind the frames."""

    @property
    def functions(self) -> Mapping[int, Function]:
        """What it can do, by function code."""

    def hears(self, t_ns: int) -> bool:
        """Whether it is switched on and ready for requests."""

    def frame_received(self, t_ns: int) -> None:
        """A sound frame for this device ended."""

    def frame_lost(self, t_ns: int) -> None:
        """Something was wrong with a frame as a whole."""

    def request_refused(self, t_ns: int, exception: ModbusException) -> None:
        """A request is answered with an exception."""

    def advance(self, t_ns: int) -> None:
        """Do what has fallen due by `t_ns`."""

    def next_event_ns(self) -> int | None:
        """When something falls due by itself, if ever."""


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


class RtuSlave:
    """A device's RS-485 port; a `WireEmulator`.

    Args:
        device: what is behind the port.
        unit_id: its address, 1 to 247.
        bits_per_byte: 11 for 8E1, Modbus' default.
        seed: of the delays of its replies.
    """

    def __init__(
        self,
        device: ModbusDevice,
        *,
        unit_id: int,
        timing: SlaveTiming,
        baudrate: int,
        bits_per_byte: int,
        seed: int,
    ) -> None:
        self.device = device
        self.unit_id = unit_id
        self.timing = timing
        self.byte_ns = round(bits_per_byte * NS_PER_S / baudrate)
        self._random = np.random.default_rng(seed)
        self._received = bytearray()
        self._first_byte_ns = 0
        self._last_byte_ns = 0
        self._deaf_until_ns = -(10**18)

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
        """Take the frame that has ended in silence by `t_ns`; let the device do what falls due by itself."""
        replies = []
        if self._received and self._last_byte_ns + self.timing.silence_ns <= t_ns:
            received = bytes(self._received)
            self._received.clear()
            reply = self._take(received)
            if reply is not None:
                replies.append(reply)
        self.device.advance(t_ns)
        return replies

    def next_event_ns(self) -> int | None:
        """End of the present frame by silence, or the device's next event."""
        event_ns = self.device.next_event_ns()
        if not self._received:
            return event_ns
        end_ns = self._last_byte_ns + self.timing.silence_ns
        return end_ns if event_ns is None else min(end_ns, event_ns)

    # ------------------------------------------------------------------ frames

    def _take(self, received: bytes) -> Reply | None:
        silent_ns = self._last_byte_ns + self.timing.silence_ns
        if not self.device.hears(silent_ns):
            return None
        sound = 4 <= len(received) <= _MAX_FRAME and crc16(received) == 0
        if not sound or self._first_byte_ns < self._deaf_until_ns:
            self.device.frame_lost(silent_ns)
            return None
        unit_id, pdu = received[0], received[1:-2]
        if unit_id not in (self.unit_id, _BROADCAST):
            return None
        processing_ns, extra_ns = self._delays_ns()
        done_ns = silent_ns + processing_ns
        self.device.frame_received(done_ns)
        answer = self._execute(pdu, done_ns)
        if unit_id == _BROADCAST:
            self._deaf_until_ns = silent_ns + self.timing.pause_after_broadcast_ns
            return None
        reply_ns = silent_ns + max(processing_ns, self.timing.waiting_ns) + extra_ns
        reply = Reply(reply_ns, frame(self.unit_id, answer))
        self._deaf_until_ns = reply_ns + len(reply.data) * self.byte_ns + self.timing.pause_after_reply_ns
        return reply

    def _delays_ns(self) -> tuple[int, int]:
        processing_ms = self._random.uniform(*self.timing.processing_ms)
        extra_ms = self._random.uniform(0.0, self.timing.scatter_ms)
        return round(processing_ms * NS_PER_MS), round(extra_ms * NS_PER_MS)

    def _execute(self, pdu: bytes, t_ns: int) -> bytes:
        code = pdu[0]
        try:
            if code not in self.device.functions:
                raise ModbusException(ILLEGAL_FUNCTION)
            return bytes((code,)) + self.device.functions[code](pdu[1:], t_ns)
        except ModbusException as exception:
            self.device.request_refused(t_ns, exception)
            return bytes((code | 0x80, exception.code))
