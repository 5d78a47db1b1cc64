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


class Gateway:
    """A Modbus TCP gateway with RTU units behind it."""

    def __init__(self, unit: WireEmulator) -> None:
        self._unit = unit

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        replies = self._unit.receive(with_crc(data[6:]), end_ns, end_ns + NS_PER_MS)
        return [
            Reply(t_ns, data[:4] + struct.pack(">H", len(reply) - 2) + reply[:-2]) for t_ns, reply in replies if reply
        ]

    def advance(self, t_ns: int) -> Sequence[Reply]:
        return self._unit.advance(t_ns)

    def next_event_ns(self) -> int | None:
        return self._unit.next_event_ns()


class Script:
    """Answers the n-th request with the n-th list of (seconds after the request's last bit, bytes).

    A mark (function 08h) is echoed like by any unit, and counted apart, unless `marks` is a script of its own for them.
    """

    def __init__(
        self, *answers: Sequence[tuple[float, bytes]], marks: Sequence[Sequence[tuple[float, bytes]]] | None = None
    ) -> None:
        self.requests: list[bytes] = []
        self.marks: list[bytes] = []
        self._answers = list(answers)
        self._mark_answers = None if marks is None else list(marks)

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        if data[1] == 0x08:
            self.marks.append(data)
            if self._mark_answers is None:
                return [Reply(end_ns + ANSWER_NS, data)]
            answer = self._mark_answers.pop(0) if self._mark_answers else ()
            return [Reply(end_ns + round(delay_s * NS_PER_S), piece) for delay_s, piece in answer]
        self.requests.append(data)
        answer = self._answers.pop(0) if self._answers else ()
        return [Reply(end_ns + round(delay_s * NS_PER_S), piece) for delay_s, piece in answer]

    def advance(self, t_ns: int) -> Sequence[Reply]:
        return ()

    def next_event_ns(self) -> int | None:
        return None


class Leg(NamedTuple):
    """One motion at `steps_per_ns` from `first` on; from `end_ns` on it stands at `last`, as planned or not."""

    start_ns: int
    end_ns: int
    first: int
    last: int
    steps_per_ns: float = 0.0
    interrupted: bool = False


class SheetDrive:
    """A drive with a motor that runs at constant speed; the feedback lags 25 ms behind the command.

    Args:
        home_end_holds: R-OUT4 is ABSPEN (on while the coordinates hold) instead of HOME-END (off from the start of
            an operation on).
        order: the byte & word order in use; `stored_order` is the parameter, which may wait for a power cycle.
    """

    LAG_NS = 25 * NS_PER_MS
    ORDERS = ((0, 1, 2, 3), (2, 3, 0, 1), (1, 0, 3, 2), (3, 2, 1, 0))

    def __init__(self, *, home_end_holds: bool = True, position: int = 0, order: int = 0) -> None:
        self.home_end_holds = home_end_holds
        self.order = self.stored_order = order
        self.communication_timeout_ms = 0
        self.takes_parameters = True
        self.heard_ns = 0
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
        return round(leg.first + (t_ns - leg.start_ns) * leg.steps_per_ns)

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
        return [self._values(data[7:-2])[2] for data in blocks]

    def power_cycle(self) -> None:
        self.established = self.at_home = False
        self.input = 0
        self.communication_timeout_ms = 0

    # ------------------------------------------------------------------ the wire

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        self.requests.append(data)
        if self.deaf or with_crc(data[:-2]) != data:
            return ()
        self.heard_ns = end_ns
        if data[0] != 1:
            return ()
        reply = with_crc(b"\x01" + self._answer(data[1:-2], end_ns + SILENCE_NS))
        if self.spoil:
            reply = self.spoil.pop(0)(reply)
        return [Reply(end_ns + ANSWER_NS, reply)] if reply else ()

    def advance(self, t_ns: int) -> Sequence[Reply]:
        self.alarm = 0x85
        self.halt(t_ns)
        return ()

    def next_event_ns(self) -> int | None:
        if self.alarm or not self.communication_timeout_ms:
            return None
        return self.heard_ns + self.communication_timeout_ms * NS_PER_MS

    def _answer(self, pdu: bytes, t_ns: int) -> bytes:
        function, address, count = struct.unpack(">BHH", pdu[:5])
        if function == 0x03:
            assert address % 2 == count % 2 == 0
            data = b"".join(self._pair(self._value(address + i, t_ns)) for i in range(0, count, 2))
            return bytes((function, len(data))) + data
        if function == 0x06:
            assert (address, self.order) == (0x7D, 0)
            self._write_input(count, t_ns)
            return pdu
        if function == 0x08:
            return pdu
        values = self._values(pdu[6:])
        if address == 0x7C:
            self._write_input(values[0], t_ns)
            return pdu[:5]
        if address == 0x138A:
            self.communication_timeout_ms = values[0] if self.takes_parameters else 0
            return pdu[:5]
        assert address == 0x58
        if self.alarm or values[4] < 1 or values[3] > 4_000_000:
            self.communication_error = 0x8D if self.alarm else 0x8C
            return bytes((function | 0x80, 4))
        if values[7] == 1 and not self.input & 0x20:
            self._run(values[2], values[3], t_ns)
        return pdu[:5]

    def _value(self, address: int, t_ns: int) -> int:
        values = {
            0x7E: self._outputs(t_ns),
            0x80: self.alarm,
            0xAC: self.communication_error,
            0xC6: self.command(t_ns),
            0xC8: 60 if self._runs(t_ns) else 0,
            0xCA: 1000 if self._runs(t_ns) else 0,
            0xCC: self.feedback(t_ns),
            0x1384: self.stored_order,
            0x138A: self.communication_timeout_ms,
        }
        return values[address]

    def _pair(self, value: int) -> bytes:
        """Two registers as the manual's table of byte & word orders has them."""
        data = struct.pack(">I", value & 0xFFFFFFFF)
        return bytes(data[i] for i in self.ORDERS[self.order])

    def _values(self, data: bytes) -> list[int]:
        place = [self.ORDERS[self.order].index(i) for i in range(4)]
        pairs = (data[i : i + 4] for i in range(0, len(data), 4))
        return [struct.unpack(">i", bytes(pair[i] for i in place))[0] for pair in pairs]

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
        duration_ns = abs(target - first) * NS_PER_S // speed
        steps_per_ns = (target - first) / duration_ns if duration_ns else 0.0
        self._legs.append(Leg(start_ns, start_ns + duration_ns, first, target, steps_per_ns))
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
