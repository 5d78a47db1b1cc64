"""The emulated RTU slave and gateway serve any device: here an analogue-input module that is no AZ drive."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import pytest

from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.fakes.modbus import (
    Function,
    ModbusException,
    RtuSlave,
    SlaveTiming,
    TcpGateway,
    crc16,
    frame,
    read_registers,
)
from microdrivers.fakes.wire import Reply, WireEmulator

BYTE_NS = round(10 * NS_PER_S / 9600)
TIMING = SlaveTiming(
    silence_ns=4 * NS_PER_MS,
    pause_after_reply_ns=4 * NS_PER_MS,
    pause_after_broadcast_ns=10 * NS_PER_MS,
    waiting_ns=0,
    processing_ms=(1.0, 1.0),
    scatter_ms=0.0,
)
ALL_CHANNELS = bytes.fromhex("01 04 00 00 00 08 F1 CC")


class AnalogueInputs:
    """Eight input registers in mV; no function but 04."""

    def __init__(self) -> None:
        self.functions: Mapping[int, Function] = {0x04: partial(read_registers, self.read)}
        self.heard: list[str] = []
        self.switched_on = True

    def read(self, address: int, count: int, t_ns: int) -> list[int]:
        if address + count > 8:
            raise ModbusException(2)
        return [2500 + n for n in range(address, address + count)]

    def hears(self, t_ns: int) -> bool:
        return self.switched_on

    def frame_received(self, t_ns: int) -> None:
        self.heard.append("received")

    def frame_lost(self, t_ns: int) -> None:
        self.heard.append("lost")

    def request_refused(self, t_ns: int, exception: ModbusException) -> None:
        self.heard.append(f"refused {exception.code}")

    def advance(self, t_ns: int) -> None: ...

    def next_event_ns(self) -> int | None:
        return None


@pytest.fixture
def device() -> AnalogueInputs:
    return AnalogueInputs()


@pytest.fixture
def slave(device: AnalogueInputs) -> RtuSlave:
    return RtuSlave(device, unit_id=1, timing=TIMING, baudrate=9600, bits_per_byte=10, seed=1)


def exchange(port: WireEmulator, data: bytes, start_ns: int = NS_PER_S) -> list[Reply]:
    replies = list(port.receive(data, start_ns, start_ns + len(data) * BYTE_NS))
    while (due_ns := port.next_event_ns()) is not None:
        replies += port.advance(due_ns)
    return replies


def test_golden_channels(slave: RtuSlave, device: AnalogueInputs) -> None:
    (reply,) = exchange(slave, ALL_CHANNELS)
    assert reply.t_ns == NS_PER_S + 8 * BYTE_NS + TIMING.silence_ns + NS_PER_MS
    assert crc16(reply.data) == 0
    assert reply.data[:-2].hex() == "010410" + "".join(f"{2500 + n:04x}" for n in range(8))
    assert device.heard == ["received"]


def test_what_it_cannot_do_is_refused(slave: RtuSlave, device: AnalogueInputs) -> None:
    for n, (pdu, code) in enumerate([("03 00 00 00 01", 1), ("04 00 07 00 02", 2), ("04 00 00 00 00", 3)]):
        body = bytes.fromhex(pdu)
        (reply,) = exchange(slave, frame(1, body), (n + 1) * NS_PER_S)
        assert reply.data == frame(1, bytes((body[0] | 0x80, code)))
    assert device.heard == ["received", "refused 1", "received", "refused 2", "received", "refused 3"]


def test_bad_frames_are_lost_and_foreign_ones_are_not_its_business(slave: RtuSlave, device: AnalogueInputs) -> None:
    assert exchange(slave, ALL_CHANNELS[:-1] + b"\x00") == []
    assert exchange(slave, frame(2, ALL_CHANNELS[1:-2]), 2 * NS_PER_S) == []
    assert device.heard == ["lost"]


def test_switched_off_it_notices_nothing(slave: RtuSlave, device: AnalogueInputs) -> None:
    device.switched_on = False
    assert exchange(slave, ALL_CHANNELS) == exchange(slave, b"\x01\x02\x03", 2 * NS_PER_S) == []
    device.switched_on = True
    assert len(exchange(slave, ALL_CHANNELS, 3 * NS_PER_S)) == 1
    assert device.heard == ["received"]


def test_it_works_behind_a_gateway(slave: RtuSlave) -> None:
    request = bytes.fromhex("00 07 00 00 00 06 FF 04 00 02 00 02")
    (reply,) = exchange(TcpGateway(slave), request)
    assert reply.data == bytes.fromhex("00 07 00 00 00 07 FF 04 04 09 C6 09 C7")
