"""The emulated controller behind a rig file's port: exchanges on the clock, stop without a reply, attachment."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import serial

from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.errors import UnsupportedError
from microdrivers.core.units import NS_PER_S
from microdrivers.devices.drivers import Emulation, EmulationRequest, World
from microdrivers.fakes.pi_gcs import EMULATOR
from microdrivers.fakes.pi_gcs.controller import REPLY_DELAY_S, GcsController
from microdrivers.fakes.wire import wire_named
from tests.fakes.gcs_bench import NOT_READY, BenchWorld, stage_settings


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock(start_ns=NS_PER_S)


def attach(clock: SimulatedClock, world: World) -> Emulation:
    return EMULATOR.attach(
        EmulationRequest(name="stage", settings=stage_settings(), world=world, seed=3, clock=clock, bus=Bus())
    )


@pytest.fixture
def port(clock: SimulatedClock) -> Iterator[serial.SerialBase]:
    emulation = attach(clock, BenchWorld())
    with serial.serial_for_url(emulation.overrides["connection"]["port"], timeout=0.5) as port:
        yield port
    emulation.close()


def exchange(clock: SimulatedClock, port: serial.SerialBase, request: bytes, lines: int) -> list[bytes]:
    with clock.transaction():
        port.write(request)
        return [port.read_until(b"\n") for _ in range(lines)]


def test_exchanges_through_the_port(clock: SimulatedClock, port: serial.SerialBase) -> None:
    assert exchange(clock, port, b"SVO 1 1\nFRF 1\nERR?\n", 1) == [b"0\n"]
    while exchange(clock, port, b"\x07", 1) == [NOT_READY]:
        clock.sleep(0.1)
    assert exchange(clock, port, b"MOV 1 7.1\nERR?\nPOS? 1\n", 2)[0] == b"0\n"
    clock.sleep(2.0)
    begin_ns = clock.now_ns()
    assert exchange(clock, port, b"POS? 1\n\x05", 2) == [b"1=7.1000000\n", b"0\n"]
    took_s = (clock.now_ns() - begin_ns) / NS_PER_S
    assert REPLY_DELAY_S[0] + 20 * 86.8e-6 < took_s < 2 * REPLY_DELAY_S[1] + 20 * 86.8e-6 + 0.005


def test_a_stop_needs_no_reply(clock: SimulatedClock, port: serial.SerialBase) -> None:
    exchange(clock, port, b"SVO 1 1\nFRF 1\nERR?\n", 1)
    clock.sleep(0.5)
    port.write(b"\x18")
    clock.sleep(0.1)
    wire = wire_named("stage")
    assert wire is not None
    assert isinstance(wire.emulator, GcsController)
    assert wire.emulator.events[-1][1] == "stop #24"
    assert exchange(clock, port, b"\x05ERR?\n", 2) == [b"0\n", b"10\n"]


def test_attach_gives_the_url_and_the_log_and_takes_them_back(clock: SimulatedClock) -> None:
    emulation = attach(clock, BenchWorld())
    assert emulation.overrides == {"connection": {"port": "fake://stage"}}
    wire = wire_named("stage")
    assert wire is not None
    assert wire.log is emulation.wire_log
    assert wire.byte_ns == round(10 * NS_PER_S / 115200)
    wire.write(b"CSV?\n")
    assert [(side, data) for _, side, data in emulation.wire_log] == [("host", b"CSV?\n"), ("device", b"2.0\n")]
    emulation.close()
    assert wire_named("stage") is None


def test_a_world_without_a_stage_is_refused(clock: SimulatedClock) -> None:
    class Nowhere:
        def close(self) -> None:
            pass

    with pytest.raises(UnsupportedError, match="Nowhere"):
        attach(clock, Nowhere())
