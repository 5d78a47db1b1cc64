"""The other end of the wire for the AZ driver's tests: scripted answers, and a small drive written from the manual.

Nothing here uses the driver's code; the check sum is computed bit by bit.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable, Sequence
from typing import NamedTuple

from microdrivers.core.clock import Clock
from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.fakes.wire import Reply, Temper, Wire, WireEmulator, register_wire

SILENCE_NS = round(2.5 * NS_PER_MS)
ANSWER_NS = SILENCE_NS + 3 * NS_PER_MS

_names = itertools.count()


def with_crc(body: bytes) -> bytes:
    crc = 0xFFFF
    for byte in body:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return body + struct.pack("<H", crc)


def plug_in(
    emulator: WireEmulator, clock: Clock, *, seed: int = 0, baudrate: int = 115200, fragments: int = 3
) -> tuple[str, Wire]:
    wire = Wire(
        emulator, clock=clock, seed=seed, baudrate=baudrate, bits_per_byte=11, temper=Temper(max_fragments=fragments)
    )
    return register_wire(f"az-test-{next(_names)}", wire), wire


class Script:
    """Answers the n-th request with the n-th list of (seconds after the request's last bit, bytes)."""

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


class Leg(NamedTuple):
    """One motion at constant speed."""

    start_ns: int
    end_ns: int
    first: int
    last: int
    interrupted: bool = False


class SheetDrive:
    """A drive with a motor that runs at constant speed; the feedback lags 25 ms behind the command.

    Args:
        home_end_holds: R-OUT4 is ABSPEN (on while the coordinates hold) instead of HOME-END (off from the start of
            an operation on).
    """

    LAG_NS = 25 * NS_PER_MS

    def __init__(self, *, home_end_holds: bool = True, position: int = 0) -> None:
        self.home_end_holds = home_end_holds
        self.established = True
        self.at_home = True
        self.alarm = 0
        self.resettable = True
        self.communication_error = 0
        self.deaf = False
        self.stuck = False
        self.requests: list[bytes] = []
        self.spoil: list[Callable[[bytes], bytes]] = []
        self.input = 0
        self._legs = [Leg(-(10**12), -(10**12), position, position)]
        self._homing = False

    # ------------------------------------------------------------------ the truth

    def command(self, t_ns: int) -> int:
        leg = next(leg for leg in reversed(self._legs) if leg.start_ns <= t_ns)
        if t_ns >= leg.end_ns:
            return leg.last
        share = (t_ns - leg.start_ns) / (leg.end_ns - leg.start_ns)
        return round(leg.first + share * (leg.last - leg.first))

    def feedback(self, t_ns: int) -> int:
        return self.command(t_ns - self.LAG_NS)

    def moves(self, t_ns: int) -> bool:
        return any(leg.start_ns <= t_ns < leg.end_ns + self.LAG_NS and leg.first != leg.last for leg in self._legs)

    def settled_at(self, t_ns: int) -> int | None:
        """Where the motor has arrived, if it has."""
        leg = next(leg for leg in reversed(self._legs) if leg.start_ns <= t_ns)
        return None if self.moves(t_ns) or leg.interrupted else leg.last

    @property
    def commanded_positions(self) -> list[int]:
        blocks = [data for data in self.requests if data[1:4] == bytes.fromhex("100058")]
        return [struct.unpack(">i", data[15:19])[0] for data in blocks]

    def power_cycle(self) -> None:
        self.established = self.at_home = False
        self.input = 0

    # ------------------------------------------------------------------ the wire

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        self.requests.append(data)
        if self.deaf or data[0] != 1 or with_crc(data[:-2]) != data:
            return ()
        reply = with_crc(b"\x01" + self._answer(data[1:-2], end_ns + SILENCE_NS))
        if self.spoil:
            reply = self.spoil.pop(0)(reply)
        return [Reply(end_ns + ANSWER_NS, reply)] if reply else ()

    def advance(self, t_ns: int) -> Sequence[Reply]:
        return ()

    def next_event_ns(self) -> int | None:
        return None

    def _answer(self, pdu: bytes, t_ns: int) -> bytes:
        function, address, count = struct.unpack(">BHH", pdu[:5])
        if function == 0x03:
            words = [self._register(address + i, t_ns) for i in range(count)]
            return struct.pack(f">BB{count}H", function, 2 * count, *words)
        if function == 0x06:
            self._write_input(count, t_ns)
            return pdu
        values = struct.unpack(f">{count // 2}i", pdu[6:])
        if self.alarm or values[4] < 1 or values[3] > 4_000_000:
            self.communication_error = 0x8D if self.alarm else 0x8C
            return bytes((function | 0x80, 4))
        if values[7] == 1 and not self.input & 0x20:
            self._run(values[2], values[3], t_ns)
        return pdu[:5]

    def _register(self, address: int, t_ns: int) -> int:
        pairs = {
            0x7E: self._outputs(t_ns),
            0x80: self.alarm,
            0xAC: self.communication_error,
            0xC6: self.command(t_ns),
            0xC8: 60 if self._runs(t_ns) else 0,
            0xCA: 1000 if self._runs(t_ns) else 0,
            0xCC: self.feedback(t_ns),
        }
        value = pairs[address & ~1] & 0xFFFFFFFF
        return value & 0xFFFF if address & 1 else value >> 16

    def _outputs(self, t_ns: int) -> int:
        self._finish_homing(t_ns)
        known = self.established if self.home_end_holds else self.at_home
        ready = not self.alarm and not self._runs(t_ns) and not self.input & 0x20
        in_position = self.settled_at(t_ns) is not None
        bits = {4: known, 5: ready, 7: bool(self.alarm), 13: self._runs(t_ns), 14: in_position}
        return sum(1 << bit for bit, on in bits.items() if on)

    def _runs(self, t_ns: int) -> bool:
        return any(leg.start_ns <= t_ns < leg.end_ns for leg in self._legs)

    # ------------------------------------------------------------------ the motor

    def _write_input(self, word: int, t_ns: int) -> None:
        rising, self.input = word & ~self.input, word
        if rising & 0x20:
            self.halt(t_ns)
        if rising & 0x80 and self.resettable:
            self.alarm = 0
        if rising & 0x10 and not self.alarm and not word & 0x20:
            if self.established:
                self._run(0, 20_000, t_ns)
                self._homing = not self.stuck
            else:
                self.alarm = 0x4A

    def _run(self, target: int, speed: int, t_ns: int) -> None:
        if self.stuck:
            return
        start_ns = t_ns + 2 * NS_PER_MS
        first = self.command(start_ns)
        self._cut(start_ns)
        self._legs.append(Leg(start_ns, start_ns + abs(target - first) * NS_PER_S // speed, first, target))
        self._homing = self.at_home = False

    def halt(self, t_ns: int) -> None:
        if self._runs(t_ns):
            self._cut(t_ns)
            self._legs[-1] = self._legs[-1]._replace(interrupted=True)
            self._homing = False

    def _cut(self, t_ns: int) -> None:
        leg = self._legs[-1]
        if leg.end_ns > t_ns:
            self._legs[-1] = leg._replace(last=self.command(t_ns), end_ns=t_ns)

    def _finish_homing(self, t_ns: int) -> None:
        if self._homing and not self.moves(t_ns) and t_ns > self._legs[-1].end_ns:
            self._homing, self.at_home = False, True
