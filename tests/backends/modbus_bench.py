"""A Modbus master wired to scripted answers, over either framing."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from microdrivers.backends.lines.serial_line import SerialLine
from microdrivers.backends.modbus.master import ModbusMaster, framing_of
from microdrivers.backends.modbus.settings import ModbusConnection
from microdrivers.backends.oriental_az.link import az_timing
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.units import NS_PER_S
from microdrivers.fakes.wire import Reply, WireEmulator
from tests.backends.oriental_az_peer import plug_in, with_crc

STATUS_QUERY = bytes.fromhex("0103007E0002A413")
IDLE = bytes.fromhex("01030400004020CA2B")
MOVING = bytes.fromhex("01030400002000E3F3")
NO_REPLY: tuple[tuple[float, bytes], ...] = ()
SILENCE_REMEDY = "check power"


class ModbusBench:
    """A master on a simulated clock, its line, and the wire."""

    def __init__(
        self, unit: WireEmulator, *, framing: str = "rtu", baudrate: int = 115200, seed: int = 0, fragments: int = 3
    ) -> None:
        self.clock = SimulatedClock()
        url, self.wire = plug_in(unit, self.clock, seed=seed, baudrate=baudrate, fragments=fragments)
        values = {"port": url, "baudrate": baudrate, "parity": "E", "timeout_s": 0.2, "framing": framing}
        connection = ModbusConnection.model_validate(values)
        framed = framing_of(connection, az_timing(baudrate))
        self.line = SerialLine(connection, clock=self.clock, gap_s=framed.gap_s)
        self.line.open()
        self.master = ModbusMaster(self.line, framed, unit_id=1, silence_remedy=SILENCE_REMEDY)


def soon(data: bytes) -> tuple[tuple[float, bytes], ...]:
    return ((0.0055, data),)


def spoiled(frame: bytes, index: int = -1) -> bytes:
    data = bytearray(frame)
    data[index] ^= 0x40
    return bytes(data)


def tcp(number: int, body: str, *, protocol: int = 0) -> bytes:
    """A Modbus TCP frame around unit id and PDU."""
    data = bytes.fromhex(body)
    return struct.pack(">HHH", number, protocol, len(data)) + data


class TcpScript:
    """Answers the n-th request with the n-th list of (seconds after it, bytes)."""

    def __init__(self, *answers: Sequence[tuple[float, bytes]]) -> None:
        self.requests: list[bytes] = []
        self._answers = list(answers)

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        self.requests.append(data)
        answer = self._answers.pop(0) if self._answers else ()
        return [Reply(end_ns + round(delay_s * NS_PER_S), piece) for delay_s, piece in answer]

    def advance(self, t_ns: int) -> Sequence[Reply]:
        return ()

    def next_event_ns(self) -> int | None:
        return None


class TardyUnit:
    """Answers in order, each request after a delay of its own.

    A read of two registers gives the address that was asked for and the number of the request; `sampled_ns` tells when.
    """

    def __init__(self, delays_s: Sequence[float], *, framing: str) -> None:
        self.sampled_ns: list[int] = []
        self._delays_s = delays_s
        self._rtu = framing == "rtu"
        self._free_ns = 0

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        number = len(self.sampled_ns)
        pdu = data[1:-2] if self._rtu else data[7:]
        delay_ns = round(self._delays_s[number % len(self._delays_s)] * NS_PER_S)
        reply_ns = self._free_ns = max(end_ns + delay_ns, self._free_ns)
        self.sampled_ns.append(reply_ns if number % 2 else end_ns + round(0.0025 * NS_PER_S))
        if pdu[0] == 0x03:
            pdu = b"\x03\x04" + pdu[1:3] + struct.pack(">H", number)
        answer = (
            with_crc(data[:1] + pdu) if self._rtu else tcp(int.from_bytes(data[:2], "big"), (data[6:7] + pdu).hex())
        )
        return [Reply(reply_ns, answer)]

    def advance(self, t_ns: int) -> Sequence[Reply]:
        return ()

    def next_event_ns(self) -> int | None:
        return None
