"""A CANopen node on the bench: frames go in at given times, and those that it sends come out in the order of theirs."""

from __future__ import annotations

import struct

from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.fakes.can.frame import Due, Frame
from microdrivers.fakes.canopen import PROMPT, CanOpenNode, Entry, Identity, Loss, PdoDefaults, Temper
from microdrivers.fakes.canopen.data_types import I8, I16, I24, I32, REAL32, U8, U16, U24, U32

FRAME_NS = 200_000


class NodeBench:
    """`t_ns` is when the next frame for the node ends; `sent` is all that the node has sent."""

    def __init__(self, node: CanOpenNode, *, boot: bool = True) -> None:
        self.node = node
        self.id = node.node_id
        self.t_ns = NS_PER_S
        self.sent: list[Due] = []
        if boot:
            self._collect(node.advance(self.t_ns))

    # ------------------------------------------------------------------ frames

    def put(self, identifier: int, data: bytes | str = b"") -> list[Frame]:
        """A frame for the node; what it sends at once."""
        raw = bytes.fromhex(data) if isinstance(data, str) else data
        self.t_ns += FRAME_NS
        return [due.frame for due in self._collect(self.node.receive(Frame(identifier, raw), self.t_ns))]

    def wait_ms(self, milliseconds: float) -> list[Frame]:
        """Let time pass, event by event, as the medium does; what the node sends meanwhile."""
        end_ns = self.t_ns + round(milliseconds * NS_PER_MS)
        frames = []
        while (due_ns := self.node.next_event_ns()) is not None and due_ns <= end_ns:
            frames += [due.frame for due in self._collect(self.node.advance(due_ns))]
        self.t_ns = end_ns
        return frames

    def _collect(self, dues: object) -> list[Due]:
        assert isinstance(dues, (list, tuple))
        new = sorted(dues, key=lambda due: due.t_ns)
        self.sent += new
        return new

    # ------------------------------------------------------------------ services

    def ask(self, request: str) -> str:
        """An SDO request and its reply, in hexadecimal; "" if there is none. Replies may take a moment."""
        frames = [frame for frame in self.put(0x600 + self.id, request) if frame.id == 0x580 + self.id]
        assert len(frames) <= 1
        return hex_of(frames[0].data) if frames else ""

    def read(self, index: int, sub: int = 0, *, signed: bool = False) -> int:
        """An expedited upload."""
        reply = bytes.fromhex(self.ask(f"40 {index & 0xFF:02X} {index >> 8:02X} {sub:02X} 00 00 00 00"))
        assert reply[0] & 0xF3 == 0x43, hex_of(reply)
        return int.from_bytes(reply[4 : 8 - (reply[0] >> 2 & 3)], "little", signed=signed)

    def read_real(self, index: int, sub: int = 0) -> float:
        """An expedited upload of a REAL32."""
        return float(struct.unpack("<f", self.read(index, sub).to_bytes(4, "little"))[0])

    def write(self, index: int, value: int, size: int, sub: int = 0) -> int:
        """An expedited download; returns the abort code or 0."""
        data = (value % (1 << 8 * size)).to_bytes(size, "little").ljust(4, b"\0")
        command = 0x23 | (4 - size) << 2
        reply = bytes.fromhex(self.ask((bytes((command, index & 0xFF, index >> 8, sub)) + data).hex()))
        if reply[0] == 0x80:
            return int.from_bytes(reply[4:], "little")
        assert reply == bytes((0x60, index & 0xFF, index >> 8, sub, 0, 0, 0, 0))
        return 0

    def nmt(self, command: int, node_id: int | None = None) -> list[Frame]:
        """A network-management command to this node, or to another or all (0)."""
        return self.put(0, bytes((command, self.id if node_id is None else node_id)))

    def operational(self) -> None:
        self.nmt(0x01)

    def sync(self) -> list[Frame]:
        return self.put(0x80)


def hex_of(data: bytes) -> str:
    return data.hex(" ").upper()


def shown(frame: Frame) -> str:
    """A frame as the transcripts show it."""
    return f"{frame.id:03X} [{len(frame.data)}] {hex_of(frame.data)}".rstrip()


class Recorder:
    """An application that only notes what it is told."""

    def __init__(self) -> None:
        self.told: list[str] = []

    def advance(self, t_ns: int) -> None: ...

    def next_event_ns(self) -> int | None:
        return None

    def restart(self, t_ns: int) -> None:
        self.told.append("restart")

    def communication_lost(self, loss: Loss, t_ns: int) -> None:
        self.told.append(f"lost {loss}")

    def communication_back(self, t_ns: int) -> None:
        self.told.append("back")


KINDS = {0x2101: U8, 0x2102: I8, 0x2103: U16, 0x2104: I16, 0x2105: U24, 0x2106: I24, 0x2107: U32, 0x2108: I32}
"""Objects of the plain node that any PDO may carry, and 210Ah, a REAL32."""

LIMITED, WRITE_ONLY, READ_ONLY, TEXT = 0x2110, 0x2111, 0x2112, 0x2000


class PlainBench(NodeBench):
    """A node with an object of each type and an application that does nothing."""

    def __init__(
        self, *, temper: Temper = PROMPT, transmit: int = 4, changes_are_events: bool = True, boot: bool = True
    ) -> None:
        self.application = Recorder()
        entries = [Entry(index, 0, kind, "rw", mapping="both") for index, kind in KINDS.items()]
        entries += [
            Entry(0x210A, 0, REAL32, "rw", 0.0, mapping="both"),
            Entry(LIMITED, 0, I16, "rw", low=-100, high=100),
            Entry(WRITE_ONLY, 0, U8, "wo", mapping="rpdo"),
            Entry(READ_ONLY, 0, U8, "ro", 7, mapping="tpdo"),
        ]
        silent = PdoDefaults([], valid=False)
        node = CanOpenNode(
            9,
            Identity(0x00030191, 1, 9, "plain"),
            entries,
            self.application,
            transmit=[silent] * transmit,
            receive=[silent] * 4,
            seed=3,
            temper=temper,
            changes_are_events=changes_are_events,
        )
        super().__init__(node, boot=boot)

    def map_pdo(self, communication: int, cob_id: int, words: list[int], *, kind: int = 255) -> list[int]:
        """Set a PDO up in the order that the standard demands; the abort codes."""
        mapping = communication + 0x200
        codes = [self.write(communication, 0x80000000 | cob_id, 4, 1), self.write(mapping, 0, 1)]
        codes += [self.write(mapping, word, 4, sub) for sub, word in enumerate(words, 1)]
        codes += [self.write(mapping, len(words), 1), self.write(communication, kind, 1, 2)]
        return [*codes, self.write(communication, cob_id, 4, 1)]
