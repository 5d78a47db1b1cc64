"""An emulated AZ drive on the bench, alone or behind a gateway: requests go in as bytes at given times."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.fakes.modbus import RtuSlave, TcpGateway, frame
from microdrivers.fakes.oriental_az.drive import AzDrive
from microdrivers.fakes.oriental_az.port import az_port
from microdrivers.fakes.oriental_az.register_map import INT32
from microdrivers.fakes.wire import Reply, WireEmulator, wire_named
from microdrivers.fakes.world.axis import Axis

UNIT = 1
ZHOME, STOP, FREE, ALARM_RESET = 0x10, 0x20, 0x40, 0x80
HOME_END, READY, ALARM, BUSY, MOVE, IN_POSITION = 0x10, 0x20, 0x80, 0x100, 0x2000, 0x4000


class ZoomOnlyWorld:
    """The world of a rig that is nothing but a zoom."""

    def __init__(self) -> None:
        self.zoom_axis = Axis(0.0, lag_s=0.003)

    def close(self) -> None: ...


def drive_behind(name: str) -> AzDrive:
    """The drive at the end of `fake://NAME`, with a gateway in front of it or not."""
    wire = wire_named(name)
    assert wire is not None
    slave = wire.emulator.slave if isinstance(wire.emulator, TcpGateway) else wire.emulator
    assert isinstance(slave, RtuSlave)
    assert isinstance(slave.device, AzDrive)
    return slave.device


class AzBench:
    """`t_ns` is when the next request begins; a polite 10 ms after the last reply, unless a test sets it."""

    def __init__(
        self,
        *,
        baudrate: int = 115200,
        lag_s: float = 0.003,
        seed: int = 1,
        software_limits_steps: tuple[int, int] = INT32,
    ) -> None:
        self.byte_ns = round(11 * NS_PER_S / baudrate)
        self.axis = Axis(0.0, lag_s=lag_s)
        self.drive = AzDrive(self.axis, seed=seed, software_limits_steps=software_limits_steps)
        self.slave = az_port(self.drive, unit_id=UNIT, baudrate=baudrate, bits_per_byte=11, seed=seed)
        self.port: WireEmulator = self.slave
        self.t_ns = NS_PER_S
        self.sent_ns = 0

    def wait_ms(self, milliseconds: float) -> None:
        self.t_ns += round(milliseconds * NS_PER_MS)

    def put(self, data: bytes) -> list[Reply]:
        """Send bytes from `t_ns` on, and move `t_ns` to their end."""
        self.sent_ns = self.t_ns + len(data) * self.byte_ns
        replies = list(self.port.receive(data, self.t_ns, self.sent_ns))
        self.t_ns = self.sent_ns
        return replies

    def listen(self, milliseconds: float = 40.0) -> list[Reply]:
        """Wait in silence, event by event, as the wire does."""
        end_ns = self.t_ns + round(milliseconds * NS_PER_MS)
        replies = []
        while (due_ns := self.port.next_event_ns()) is not None and due_ns <= end_ns:
            replies += self.port.advance(due_ns)
        self.t_ns = end_ns
        return replies

    def ask(self, request: bytes) -> bytes:
        """One frame in, the reply's bytes out (none if the drive is silent)."""
        replies = self.put(request) + self.listen()
        assert len(replies) <= 1
        return replies[0].data if replies else b""

    def ask_hex(self, request: str) -> str:
        return self.ask(bytes.fromhex(request)).hex(" ").upper()

    # ------------------------------------------------------------------ shorthand for the meaning of frames

    def read(self, address: int) -> int:
        reply = self.ask(frame(UNIT, struct.pack(">BHH", 3, address, 2)))
        assert reply[1] == 3, reply.hex(" ")
        return int(struct.unpack(">i", reply[3:7])[0])

    def write(self, address: int, *values: int) -> int:
        """Write 32-bit values; returns the exception code or 0."""
        return self.exception_of(write_request(address, values))

    def inputs(self, bits: int) -> int:
        return self.exception_of(frame(UNIT, struct.pack(">BHH", 6, 0x7D, bits)))

    def exception_of(self, request: bytes) -> int:
        reply = self.ask(request)
        return reply[2] if reply[1] & 0x80 else 0

    def outputs(self) -> int:
        return self.read(0x7E)

    def move(
        self,
        steps: int,
        *,
        kind: int = 1,
        speed: int = 20_000,
        start_rate: int = 1_000_000,
        stop_rate: int = 1_000_000,
        trigger: int = 1,
    ) -> int:
        return self.write(0x58, 0, kind, steps, speed, start_rate, stop_rate, 1000, trigger)

    def texts(self) -> list[str]:
        return [text for _, text in self.drive.log]


class GatewayBench(AzBench):
    """The same drive behind a gateway. What is asked, and the reply, are still written as RTU frames."""

    def __init__(self, *, baudrate: int = 115200, seed: int = 1) -> None:
        super().__init__(baudrate=baudrate, seed=seed)
        self.gateway = TcpGateway(self.slave)
        self.port = self.gateway
        self.byte_ns = 8
        self.transaction = 0

    def ask(self, request: bytes) -> bytes:
        self.transaction += 1
        reply = super().ask(adu(self.transaction, request[0], request[1:-2]))
        assert reply[:4] == struct.pack(">HH", self.transaction, 0)
        assert int.from_bytes(reply[4:6], "big") == len(reply) - 6
        return frame(reply[6], reply[7:])


def adu(transaction: int, unit_id: int, pdu: bytes) -> bytes:
    """A Modbus TCP request or reply."""
    return struct.pack(">HHHB", transaction, 0, len(pdu) + 1, unit_id) + pdu


def write_request(address: int, values: Sequence[int]) -> bytes:
    """FC 10h with 32-bit values."""
    data = struct.pack(f">{len(values)}i", *values)
    return frame(UNIT, struct.pack(">BHHB", 0x10, address, 2 * len(values), len(data)) + data)
