"""A CANopen node as the sheet describes it, for tests of the backends: SDO, NMT, heartbeat, PDOs. It can be spiteful.

A drive on top of it stands in `cia402_peer`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from microdrivers.core.units import NS_PER_MS
from microdrivers.fakes.can import Due, Frame

PRE_OPERATIONAL, OPERATIONAL, STOPPED = 0x7F, 0x05, 0x04
READ_ONLY, NO_OBJECT = 0x06010002, 0x06020000


class PeerNode:
    """One node. `objects` holds bytes by (index, sub); writing calls `on_write`, reading `on_read` if they are set.

    Spite: `silent` (no SDO reply for these objects), `sdo_delays_ns` of the next replies, `aborts` by object,
    `segments` after which an upload stops, `toggle_slip` (wrong toggle bit in the second segment).
    """

    def __init__(self, node_id: int, objects: dict[tuple[int, int], bytes]) -> None:
        self.id = node_id
        self.objects = objects
        self.read_only: set[tuple[int, int]] = set()
        self.state = -1
        self.silent: set[tuple[int, int]] = set()
        self.all_silent = False
        self.mute_pdo = False
        self.sdo_delays_ns: list[int] = []
        self.aborts: dict[tuple[int, int], int] = {}
        self.segments: int | None = None
        self.toggle_slip = False
        self.sdo_delay_ns = 100_000
        self.pdo_delay_ns = 50_000
        self.requests: list[bytes] = []
        self.written: list[tuple[int, int, bytes]] = []
        self.on_write: Callable[[int, int, bytes, int], None] = lambda index, sub, data, t_ns: None
        self.on_read: Callable[[int, int, int], None] = lambda index, sub, t_ns: None
        self._upload: tuple[int, int, bytes, int] | None = None
        self._download: tuple[int, int, bytearray] | None = None
        self._segments_sent = 0
        self._beat_ns = 0
        self._consumer_ns = 0
        self._outbox: list[Due] = []

    # ------------------------------------------------------------------ CanNode

    def receive(self, frame: Frame, t_ns: int) -> Sequence[Due]:
        self.step(t_ns)
        if frame.id == 0x000 and frame.data[1] in (0, self.id):
            self._nmt(frame.data[0], t_ns)
        elif frame.id == 0x600 + self.id and self.state in (PRE_OPERATIONAL, OPERATIONAL):
            self._sdo(frame.data, t_ns)
        elif frame.id == 0x080 and self.state == OPERATIONAL and not self.mute_pdo:
            self._synced(t_ns)
        elif frame.id == 0x77F and self.state == OPERATIONAL:
            period = self.number(0x1016, 1) & 0xFFFF
            self._consumer_ns = t_ns + period * NS_PER_MS if period else 0
        elif self.state == OPERATIONAL:
            self._receive_pdo(frame, t_ns)
        return self._flush()

    def advance(self, t_ns: int) -> Sequence[Due]:
        if self.state < 0:
            self.boot(t_ns)
        self.step(t_ns)
        period_ns = self.number(0x1017, 0) * NS_PER_MS
        while period_ns and self._beat_ns <= t_ns:
            self.send(self._beat_ns, 0x700 + self.id, bytes([self.state]))
            self._beat_ns += period_ns
        if self._consumer_ns and self._consumer_ns <= t_ns:
            self._consumer_ns = 0
            self.host_lost(t_ns)
        return self._flush()

    def next_event_ns(self) -> int | None:
        times = [self._beat_ns] if self.number(0x1017, 0) else []
        if self._consumer_ns:
            times.append(self._consumer_ns)
        return min(times, default=None)

    # ------------------------------------------------------------------ for drives on top

    def step(self, t_ns: int) -> None:
        """Bring what moves up to date."""

    def host_lost(self, t_ns: int) -> None:
        """The host's heartbeat is missing."""

    def boot(self, t_ns: int) -> None:
        """Power on."""
        self.state = PRE_OPERATIONAL
        self.send(t_ns, 0x700 + self.id, b"\0")

    def send(self, t_ns: int, cob_id: int, data: bytes) -> None:
        self._outbox.append(Due(t_ns, Frame(cob_id, data)))

    def emergency(self, t_ns: int, code: int, register: int = 1) -> None:
        self.send(t_ns, 0x080 + self.id, code.to_bytes(2, "little") + bytes([register]) + bytes(5))

    def number(self, index: int, sub: int, *, signed: bool = False) -> int:
        return int.from_bytes(self.objects.get((index, sub), b"\0"), "little", signed=signed)

    def put(self, index: int, sub: int, value: int) -> None:
        size = len(self.objects[index, sub])
        self.objects[index, sub] = value.to_bytes(size, "little", signed=value < 0)

    # ------------------------------------------------------------------ inside

    def _flush(self) -> Sequence[Due]:
        outbox, self._outbox = self._outbox, []
        return outbox

    def _nmt(self, command: int, t_ns: int) -> None:
        if command in (0x81, 0x82):
            self.boot(t_ns)
        else:
            self.state = {0x01: OPERATIONAL, 0x02: STOPPED, 0x80: PRE_OPERATIONAL}[command]
        self._consumer_ns = 0

    def _reply(self, t_ns: int, data: bytes) -> None:
        delay_ns = self.sdo_delays_ns.pop(0) if self.sdo_delays_ns else self.sdo_delay_ns
        self.send(t_ns + delay_ns, 0x580 + self.id, data.ljust(8, b"\0"))

    def _abort(self, t_ns: int, mux: bytes, code: int) -> None:
        self._reply(t_ns, b"\x80" + mux + code.to_bytes(4, "little"))

    def _sdo(self, data: bytes, t_ns: int) -> None:
        self.requests.append(data)
        command, mux = data[0] & 0xE0, data[1:4]
        key = (int.from_bytes(data[1:3], "little"), data[3])
        if data[0] == 0x80:
            self._upload = self._download = None
        elif self.all_silent or (key in self.silent and command in (0x20, 0x40)):
            return
        elif command == 0x60 and self._upload is not None:
            self._next_upload(data, t_ns)
        elif command == 0x00 and self._download is not None:
            self._next_download(data, t_ns)
        elif key in self.aborts:
            self._abort(t_ns, mux, self.aborts[key])
        elif command == 0x40:
            self._begin_upload(key, mux, t_ns)
        elif command == 0x20:
            self._begin_download(data, key, mux, t_ns)

    def _begin_upload(self, key: tuple[int, int], mux: bytes, t_ns: int) -> None:
        self.on_read(*key, t_ns)
        value = self.objects.get(key)
        if value is None:
            self._abort(t_ns, mux, NO_OBJECT)
        elif len(value) <= 4:
            self._reply(t_ns, bytes([0x43 | (4 - len(value)) << 2]) + mux + value)
        else:
            self._upload = (*key, value, 0)
            self._segments_sent = 0
            self._reply(t_ns, b"\x41" + mux + len(value).to_bytes(4, "little"))

    def _next_upload(self, data: bytes, t_ns: int) -> None:
        assert self._upload is not None
        index, sub, value, toggle = self._upload
        assert data[0] & 0x10 == toggle
        if self.segments is not None and self._segments_sent >= self.segments:
            return
        part, rest = value[:7], value[7:]
        slip = 0x10 if self.toggle_slip and self._segments_sent == 1 else 0
        self._reply(t_ns, bytes([toggle ^ slip | (7 - len(part)) << 1 | (not rest)]) + part)
        self._segments_sent += 1
        self._upload = (index, sub, rest, toggle ^ 0x10) if rest else None

    def _begin_download(self, data: bytes, key: tuple[int, int], mux: bytes, t_ns: int) -> None:
        if key in self.read_only:
            self._abort(t_ns, mux, READ_ONLY)
        elif key not in self.objects:
            self._abort(t_ns, mux, NO_OBJECT)
        elif data[0] & 0x02:
            size = 4 - (data[0] >> 2 & 3) if data[0] & 1 else 4
            self._store(key, data[4 : 4 + size], t_ns)
            self._reply(t_ns, b"\x60" + mux)
        else:
            self._download = (*key, bytearray())
            self._reply(t_ns, b"\x60" + mux)

    def _next_download(self, data: bytes, t_ns: int) -> None:
        assert self._download is not None
        index, sub, value = self._download
        value += data[1 : 8 - (data[0] >> 1 & 7)]
        self._reply(t_ns, bytes([0x20 | data[0] & 0x10]))
        if data[0] & 1:
            self._download = None
            self._store((index, sub), bytes(value), t_ns)

    def _store(self, key: tuple[int, int], value: bytes, t_ns: int) -> None:
        self.objects[key] = value
        self.written.append((*key, value))
        if key == (0x1017, 0):
            self._beat_ns = t_ns + self.number(0x1017, 0) * NS_PER_MS
        if key == (0x1016, 1):
            self._consumer_ns = 0
        self.on_write(*key, value, t_ns)

    def _mapped(self, mapping: int) -> list[tuple[int, int, int]]:
        words = [self.number(mapping, place + 1) for place in range(self.number(mapping, 0))]
        return [(word >> 16, word >> 8 & 0xFF, (word & 0xFF) // 8) for word in words]

    def _synced(self, t_ns: int) -> None:
        for offset in range(4):
            cob_id = self.number(0x1800 + offset, 1)
            if cob_id >> 31 or (0x1800 + offset, 1) not in self.objects or self.number(0x1800 + offset, 2) != 1:
                continue
            data = b""
            for index, sub, size in self._mapped(0x1A00 + offset):
                self.on_read(index, sub, t_ns)
                data += self.objects[index, sub][:size]
            self.send(t_ns + self.pdo_delay_ns, cob_id & 0x7FF, data)

    def _receive_pdo(self, frame: Frame, t_ns: int) -> None:
        for offset in range(4):
            cob_id = self.number(0x1400 + offset, 1)
            if (0x1400 + offset, 1) in self.objects and cob_id == frame.id:
                place = 0
                for index, sub, size in self._mapped(0x1600 + offset):
                    self._store((index, sub), frame.data[place : place + size], t_ns)
                    place += size
