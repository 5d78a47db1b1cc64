"""The emulated AZ drive in real time: what it does by itself, and where it is served."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import pytest
import serial

from microdrivers.core.bus import Bus
from microdrivers.core.clock import SystemClock
from microdrivers.devices.drivers import Emulation, EmulationRequest, ServeRequest
from microdrivers.fakes.modbus import frame
from microdrivers.fakes.oriental_az import EMULATOR, AzDrive
from microdrivers.fakes.oriental_az.register_map import RESPONSE_TIMEOUT_MS
from microdrivers.fakes.wire import Cable
from tests.fakes.az_bench import UNIT, ZoomOnlyWorld, adu, drive_behind, write_request

# One after the other: they run in real time.
pytestmark = pytest.mark.xdist_group("real_time")

READ_STATUS = bytes.fromhex("03 00 7E 00 02")
SLOW_MOVE = write_request(0x58, (0, 1, 100_000, 1000, 1_000_000, 1_000_000, 1000, 1))[1:-2]
LONG_S = 20.0


@pytest.fixture
def clock() -> Iterator[SystemClock]:
    clock = SystemClock()
    yield clock
    clock.close()


def attach(clock: SystemClock, framing: Literal["rtu", "tcp"]) -> tuple[Emulation, AzDrive]:
    rig_file: dict[str, Any] = {"connection": {"framing": framing, "port": "unused"}, "unit_id": UNIT}
    emulation = EMULATOR.attach(
        EmulationRequest(name="zoom", settings=rig_file, world=ZoomOnlyWorld(), seed=1, clock=clock, bus=Bus())
    )
    drive = drive_behind("zoom")
    drive.set_up(RESPONSE_TIMEOUT_MS, 200)
    return emulation, drive


def wait_for_alarm(clock: SystemClock, drive: AzDrive) -> None:
    give_up_ns = clock.now_ns() + round(LONG_S * 1e9)
    while not drive.alarm and clock.now_ns() < give_up_ns:
        clock.sleep(0.01)
    assert [text for _, text in drive.log] == ["move 100000", "alarm 85"]


@pytest.mark.parametrize("framing", ["rtu", "tcp"])
def test_the_time_out_needs_no_further_byte(clock: SystemClock, framing: Literal["rtu", "tcp"]) -> None:
    emulation, drive = attach(clock, framing)
    with serial.serial_for_url(emulation.overrides["connection"]["port"], timeout=LONG_S) as port:
        port.write(adu(1, UNIT, SLOW_MOVE) if framing == "tcp" else frame(UNIT, SLOW_MOVE))
        wait_for_alarm(clock, drive)
    emulation.close()


@pytest.mark.parametrize("framing", ["rtu", "tcp"])
def test_a_drive_whose_cable_is_pulled_stops_its_motor(
    clock: SystemClock, tmp_path: Path, framing: Literal["rtu", "tcp"]
) -> None:
    emulation, drive = attach(clock, framing)
    assert emulation.serve is not None
    endpoint = emulation.serve(ServeRequest(transport="pty", bind="127.0.0.1", folder=tmp_path))
    assert isinstance(endpoint.control, Cable)
    with serial.serial_for_url(endpoint.overrides["connection"]["port"], timeout=LONG_S) as port:
        port.write(adu(1, UNIT, SLOW_MOVE) if framing == "tcp" else frame(UNIT, SLOW_MOVE))
        assert len(port.read(12 if framing == "tcp" else 8)) > 7
        endpoint.control.unplug()
        wait_for_alarm(clock, drive)
    endpoint.close()
    emulation.close()


@pytest.mark.parametrize("transport", ["pty", "tcp"])
def test_modbus_tcp_is_always_served_on_tcp(
    clock: SystemClock, tmp_path: Path, transport: Literal["pty", "tcp"]
) -> None:
    emulation, _ = attach(clock, "tcp")
    assert emulation.serve is not None
    endpoint = emulation.serve(ServeRequest(transport=transport, bind="127.0.0.1", folder=tmp_path))
    assert endpoint.overrides == {"connection": {"port": endpoint.where}}
    host, _, port = endpoint.where.removeprefix("socket://").rpartition(":")
    with socket.create_connection((host, int(port)), timeout=LONG_S) as connection:
        connection.sendall(adu(7, UNIT, READ_STATUS) + adu(8, UNIT, READ_STATUS))
        received = b""
        while len(received) < 26:
            received += connection.recv(99)
    status = bytes.fromhex("03 04 00 00 40 30")
    assert received == adu(7, UNIT, status) + adu(8, UNIT, status)
    endpoint.close()
    emulation.close()
