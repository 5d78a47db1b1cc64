"""An amplifier on an emulated bus as CiA 301 and CiA 404 describe it; none of the driver's code.

SDO server, NMT slave, heartbeat producer and one TPDO; it insists on the order in which a PDO is to be re-mapped.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence

from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.fakes.can import Due, Frame

PRE_OPERATIONAL, OPERATIONAL, STOPPED = 0x7F, 0x05, 0x04
REPLY_NS = 150_000
NO_OBJECT, NO_SUB, READ_ONLY, NOT_NOW = 0x06020000, 0x06090011, 0x06010002, 0x08000022

Key = tuple[int, int]


class SheetAmplifier:
    """One channel of force.

    Attributes:
        force_uN: truth, by time in s.
        status: object 6150h.
        aborts: abort codes by object, for reads and writes.
        silent: answers nothing and sends nothing.
        answers_left: how many SDO answers it still gives; None is no limit.
        writes: what was written, in order.
        sampled_ns: when the value of each TPDO was converted; `sent_ns`, when the TPDO was handed to the bus.
        drop: how many of the next TPDOs get lost.
    """

    def __init__(
        self, node_id: int = 21, *, unit: int = 0xF7210000, digits: int = 0, value: int = 0x9130, status: bool = True
    ) -> None:
        self.node_id = node_id
        self.force_uN: Callable[[float], float] = lambda _t_s: 0.0
        self.status = 0
        self.aborts: dict[Key, int] = {}
        self.silent = False
        self.answers_left: int | None = None
        self.writes: list[tuple[int, int, int]] = []
        self.sampled_ns: list[int] = []
        self.sent_ns: list[int] = []
        self.drop = 0
        self.nmt = PRE_OPERATIONAL
        self.value = value
        self.conversion_ns = NS_PER_MS
        self.delay_ns = 50_000
        self.per_count_uN = {0: 1e6, 0xFD: 1e3, 0xFA: 1.0, 0xF7: 1e-3}.get(unit >> 24, 1.0)
        if value != 0x6130:
            self.per_count_uN /= 10**digits
        u32, u8 = struct.Struct("<I").pack, struct.Struct("<B").pack
        self.objects: dict[Key, bytes] = {
            (0x1000, 0): u32(0x00020194), (0x1008, 0): b"Strain amplifier SA-1", (0x1017, 0): b"\0\0",
            (0x1018, 0): u8(4), (0x1018, 1): u32(0x2E5), (0x1018, 2): u32(0x1234), (0x1018, 3): u32(0x00010002),
            (0x1018, 4): u32(4711), (0x6131, 1): u32(unit), (0x6132, 1): u8(digits), (value, 1): b"",
            (0x1800, 0): u8(5), (0x1800, 1): u32(0x180 + node_id), (0x1800, 2): u8(255), (0x1800, 3): b"\0\0",
            (0x1800, 5): b"\0\0", (0x1A00, 0): u8(1), (0x1A00, 1): u32(0x71300110), (0x1A00, 2): u32(0),
        }  # fmt: skip
        if status:
            self.objects[0x6150, 1] = b""
        self._defaults = dict(self.objects)
        self._segments: list[bytes] = []
        self._booted = False
        self._tpdo_ns: int | None = None
        self._heartbeat_ns: int | None = None

    # ------------------------------------------------------------------ the bus

    def receive(self, frame: Frame, t_ns: int) -> Sequence[Due]:
        if self.silent:
            return ()
        if frame.id == 0 and frame.data[1] in (0, self.node_id):
            return self._command(frame.data[0], t_ns)
        if frame.id == 0x600 + self.node_id and self.nmt != STOPPED:
            return self._answer(frame.data, t_ns)
        if frame.id == 0x80 and self.nmt == OPERATIONAL and self._number(0x1800, 2) == 1:
            return self._tpdo(t_ns)
        return ()

    def advance(self, t_ns: int) -> Sequence[Due]:
        if not self._booted:
            self._booted = True
            return [Due(t_ns, Frame(0x700 + self.node_id, b"\0"))]
        due: list[Due] = []
        if self._tpdo_ns is not None and self._tpdo_ns <= t_ns:
            due += self._tpdo(self._tpdo_ns)
            self._tpdo_ns += self._number(0x1800, 5) * NS_PER_MS
        if self._heartbeat_ns is not None and self._heartbeat_ns <= t_ns:
            if not self.silent:
                due.append(Due(t_ns, Frame(0x700 + self.node_id, bytes((self.nmt,)))))
            self._heartbeat_ns += self._number(0x1017, 0) * NS_PER_MS
        return due

    def next_event_ns(self) -> int | None:
        return min((t_ns for t_ns in (self._tpdo_ns, self._heartbeat_ns) if t_ns is not None), default=None)

    def forget(self) -> None:
        """As after power-on."""
        self.objects = dict(self._defaults)
        self.nmt = PRE_OPERATIONAL
        self._booted = False
        self._tpdo_ns = self._heartbeat_ns = None

    def _command(self, command: int, t_ns: int) -> Sequence[Due]:
        self.nmt = {1: OPERATIONAL, 2: STOPPED, 0x80: PRE_OPERATIONAL}.get(command, self.nmt)
        by_timer = self._number(0x1800, 2) >= 254 and self._number(0x1800, 5) > 0
        self._tpdo_ns = t_ns + self._number(0x1800, 5) * NS_PER_MS if self.nmt == OPERATIONAL and by_timer else None
        return ()

    # ------------------------------------------------------------------ the TPDO

    def _number(self, index: int, sub: int) -> int:
        return int.from_bytes(self.objects[index, sub], "little")

    def _tpdo(self, t_ns: int) -> list[Due]:
        if self._number(0x1800, 1) & 1 << 31 or self.silent:
            return []
        if self.drop:
            self.drop -= 1
            return []
        words = [self._number(0x1A00, sub + 1) for sub in range(self._number(0x1A00, 0))]
        data = b"".join(self._process(word >> 16, t_ns) for word in words)
        self.sampled_ns.append(t_ns - t_ns % self.conversion_ns)
        self.sent_ns.append(t_ns + self.delay_ns)
        return [Due(t_ns + self.delay_ns, Frame(self._number(0x1800, 1) & 0x7FF, data))]

    def _process(self, index: int, t_ns: int) -> bytes:
        if index == 0x6150:
            return bytes((self.status,))
        count = self.force_uN((t_ns - t_ns % self.conversion_ns) / NS_PER_S) / self.per_count_uN
        if index == 0x6130:
            return struct.pack("<f", count)
        return struct.pack("<h" if index == 0x7130 else "<i", round(count))

    # ------------------------------------------------------------------ the SDO server

    def _answer(self, data: bytes, t_ns: int) -> Sequence[Due]:
        if self.answers_left is not None:
            if not self.answers_left:
                return ()
            self.answers_left -= 1
        command, index, sub = struct.unpack("<BHB", data[:4])
        if command in (0x60, 0x70):
            return self._reply(self._segment(command), t_ns)
        try:
            if (index, sub) in self.aborts:
                raise _Abort(self.aborts[index, sub])
            if command == 0x40:
                answer = self._upload(index, sub, t_ns)
            else:
                size = 4 - (command >> 2 & 3) if command & 1 else 4
                self._download(index, sub, data[4 : 4 + size], t_ns)
                answer = b"\x60" + data[1:4] + bytes(4)
        except _Abort as abort:
            answer = b"\x80" + data[1:4] + struct.pack("<I", abort.code)
        return self._reply(answer, t_ns)

    def _reply(self, answer: bytes, t_ns: int) -> Sequence[Due]:
        return [Due(t_ns + REPLY_NS, Frame(0x580 + self.node_id, answer))]

    def _upload(self, index: int, sub: int, t_ns: int) -> bytes:
        if (index, sub) not in self.objects:
            known = any(index == other for other, _ in self.objects)
            raise _Abort(NO_SUB if known else NO_OBJECT)
        value = self.objects[index, sub] or self._process(index, t_ns)
        multiplexer = struct.pack("<HB", index, sub)
        if len(value) > 4:
            self._segments = [value[i : i + 7] for i in range(0, len(value), 7)]
            return b"\x41" + multiplexer + struct.pack("<I", len(value))
        command = 0x43 | 4 - len(value) << 2
        return bytes((command,)) + multiplexer + value.ljust(4, b"\0")

    def _segment(self, command: int) -> bytes:
        part = self._segments.pop(0)
        last = 0 if self._segments else 1
        return bytes((command & 0x10 | 7 - len(part) << 1 | last,)) + part.ljust(7, b"\0")

    def _download(self, index: int, sub: int, value: bytes, t_ns: int) -> None:
        if (index, sub) not in self.objects:
            raise _Abort(NO_OBJECT)
        if len(value) != len(self.objects[index, sub]):
            raise _Abort(0x06070010)
        if index in (0x1000, 0x1018, 0x1008, 0x6131):
            raise _Abort(READ_ONLY)
        if index == 0x1A00:
            off = self._number(0x1800, 1) >> 31 and self.nmt == PRE_OPERATIONAL
            if not off or (sub and self._number(0x1A00, 0)):
                raise _Abort(NOT_NOW)
        self.writes.append((index, sub, int.from_bytes(value, "little")))
        self.objects[index, sub] = value
        if (index, sub) == (0x1017, 0):
            self._heartbeat_ns = t_ns + self._number(0x1017, 0) * NS_PER_MS if any(value) else None


class _Abort(Exception):
    def __init__(self, code: int) -> None:
        super().__init__(f"{code:08X}h")
        self.code = code
