"""One scripted CANopen node on an emulated bus, and a line to it."""

from __future__ import annotations

from microdrivers.backends.canopen.sdo import SdoClient
from microdrivers.backends.lines.can_line import shared_can_line
from microdrivers.backends.lines.settings import CanConnection
from microdrivers.core.clock import Clock, SimulatedClock
from microdrivers.fakes.can import forget_medium, shared_medium
from tests.backends.canopen_peer import PeerNode

NODE = 5
LONG = bytes(range(1, 24))
OBJECTS = {
    (0x1000, 0): b"\x94\x01\x02\x00", (0x1001, 0): b"\0", (0x1008, 0): b"MEASURING-AMPLIFIER", (0x1016, 1): bytes(4),
    (0x1017, 0): bytes(2), (0x1018, 0): b"\4", (0x2000, 0): b"\x2a", (0x2001, 0): b"\xfe\xff", (0x2002, 0): LONG,
    (0x2003, 0): b"\0\0\x80\xbf",
}  # fmt: skip


class LineBench:
    """A line, a node, and an SDO client of it."""

    def __init__(self, *, clock: Clock | None = None, channel: str = "line bench", timeout_s: float = 0.1) -> None:
        self.clock = SimulatedClock() if clock is None else clock
        self.channel = channel
        self.medium = shared_medium(channel, clock=self.clock, bitrate=500_000, seed=3)
        self.node = PeerNode(NODE, dict(OBJECTS))
        self.medium.attach(self.node)
        self.connection = CanConnection(interface="microdrivers", channel=channel, timeout_s=timeout_s)
        self.line = shared_can_line(self.connection, clock=self.clock)
        self.line.open()
        self.sdo = SdoClient(self.line, NODE, timeout_s=timeout_s, name=f"node {NODE}")
        self.clock.sleep(0.001)

    def __enter__(self) -> LineBench:
        return self

    def __exit__(self, *_: object) -> None:
        self.line.close()
        forget_medium(self.channel, self.medium)

    @property
    def host_frames(self) -> list[tuple[int, bytes]]:
        """What the host has sent, as (identifier, data)."""
        self.clock.sleep(0.001)
        return [(frame.id, frame.data) for _, who, frame in self.medium.log if who == "host"]
