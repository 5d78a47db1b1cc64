"""The emulated AZ drive as a rig attaches it: settings, world, wire and pyserial."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import serial

from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.errors import ConfigError, UnsupportedError
from microdrivers.core.units import NS_PER_S
from microdrivers.devices.drivers import Emulation, EmulationRequest
from microdrivers.fakes.oriental_az import EMULATOR
from microdrivers.fakes.oriental_az.register_map import BYTE_WORD_ORDER
from microdrivers.fakes.wire import Wire, wire_named
from tests.fakes.az_bench import UNIT, ZoomOnlyWorld, adu, drive_behind, write_request


class Rig:
    """The emulator as a rig gets it, and a pyserial port on its wire."""

    def __init__(self, *, connection: dict[str, Any] | None = None, **settings: Any) -> None:
        self.clock = SimulatedClock(5 * NS_PER_S)
        world = ZoomOnlyWorld()
        self.axis = world.zoom_axis
        self.emulation = attach(self.clock, world, connection=connection or {}, **settings)
        self.port = serial.serial_for_url(self.emulation.overrides["connection"]["port"], timeout=0.1)
        wire = wire_named("zoom")
        assert wire is not None
        self.wire: Wire = wire
        self.drive = drive_behind("zoom")

    def ask(self, request: bytes, size: int) -> bytes:
        with self.clock.transaction():
            self.port.write(request)
            reply = bytes(self.port.read(size))
        self.clock.sleep(0.004)
        return reply

    def close(self) -> None:
        self.port.close()
        self.emulation.close()


def attach(clock: SimulatedClock, world: Any, **sections: Any) -> Emulation:
    rig_file: dict[str, Any] = {
        "connection": {"port": "/dev/ttyUSB0", "baudrate": 115200, "timeout_s": 0.5},
        "unit_id": 1,
        "curve": [[0, 0.75], [10_000, 11.25]],
    }
    for key, value in sections.items():
        rig_file[key] = rig_file[key] | value if isinstance(value, dict) else value
    return EMULATOR.attach(
        EmulationRequest(name="zoom", settings=rig_file, world=world, seed=1, clock=clock, bus=Bus())
    )


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig()
    yield rig
    rig.close()


@pytest.mark.parametrize(("parity", "bits"), [("E", 11), ("O", 11), ("N", 10)])
def test_parity_decides_how_long_a_byte_takes(parity: str, bits: int) -> None:
    rig = Rig(connection={"parity": parity})
    assert rig.wire.byte_ns == round(bits * NS_PER_S / 115200)
    rig.close()


def test_a_move_through_pyserial_moves_the_world(rig: Rig) -> None:
    status = bytes.fromhex("01 03 00 7E 00 02 A4 13")
    assert rig.ask(status, 9).hex() == "0103040000 4030 cbe7".replace(" ", "")
    request = write_request(0x58, (0, 1, 8500, 20_000, 1_000_000, 1_000_000, 1000, 1))
    assert rig.ask(request, 8) == bytes.fromhex("01 10 00 58 00 10 40 16")
    seen = 0
    while rig.ask(status, 9)[5] & 0x20:
        seen += 1
    assert seen > 20
    rig.clock.sleep(0.1)
    assert rig.axis.position_at(rig.clock.now_ns()) == pytest.approx(8500, abs=0.01)
    assert rig.ask(b"\x07" + status[1:], 9) == b""
    assert [text for _, text in rig.drive.log] == ["move 8500"]
    assert {direction for _, direction, _ in rig.emulation.wire_log} == {"host", "device"}


def test_a_stop_needs_no_reply_and_the_wire_wakes_the_drive_by_itself(rig: Rig) -> None:
    rig.ask(write_request(0x58, (0, 1, 8500, 20_000, 1_000_000, 1_000_000, 1000, 1)), 8)
    rig.clock.sleep(0.1)
    rig.port.write(bytes.fromhex("01 06 00 7D 00 20 18 0A"))
    rig.clock.sleep(0.5)
    assert [text for _, text in rig.drive.log] == ["move 8500", "stop"]
    assert rig.axis.speed_at(rig.clock.now_ns()) == pytest.approx(0.0, abs=1e-6)
    assert 1000 < rig.axis.position_at(rig.clock.now_ns()) < 4000


READ_STATUS = bytes.fromhex("03 00 7E 00 02")


@pytest.mark.parametrize(("parity", "bits"), [("E", 11), ("N", 10)])
@pytest.mark.parametrize("baudrate", [9600, 115200])
def test_behind_a_gateway_the_drive_has_a_line_of_its_own(baudrate: int, parity: str, bits: int) -> None:
    rig = Rig(connection={"framing": "tcp", "baudrate": baudrate, "parity": parity})
    start_ns = rig.clock.now_ns()
    with rig.clock.transaction():
        rig.port.write(adu(1, UNIT, READ_STATUS))
        assert rig.port.read(13) == adu(1, UNIT, bytes.fromhex("03 04 00 00 40 30"))
        taken_s = (rig.clock.now_ns() - start_ns) / NS_PER_S
    silence_s = 0.004 if baudrate == 9600 else 0.0025
    expected_s = (8 + 9) * bits / baudrate + 2 * silence_s + 0.003
    assert expected_s <= taken_s <= expected_s + 0.003  # the reply may come in pieces
    rig.close()


def test_a_move_through_a_gateway_moves_the_world() -> None:
    rig = Rig(connection={"framing": "tcp"})
    move = write_request(0x58, (0, 1, 8500, 20_000, 1_000_000, 1_000_000, 1000, 1))[1:-2]
    rig.port.write(adu(1, UNIT, move) + adu(2, UNIT, READ_STATUS))
    rig.clock.sleep(1.0)
    assert rig.port.read(12 + 13) == adu(1, UNIT, b"\x10\x00\x58\x00\x10") + adu(2, UNIT, b"\x03\x04\0\0\x20\x10")
    assert rig.axis.position_at(rig.clock.now_ns()) == pytest.approx(8500, abs=0.01)
    rig.close()


def test_a_new_connection_begins_with_nothing() -> None:
    rig = Rig(connection={"framing": "tcp"})
    rig.port.write(adu(1, UNIT, READ_STATUS) + adu(2, UNIT, READ_STATUS)[:5])
    rig.port.close()
    rig.port.open()
    assert rig.ask(adu(3, UNIT, READ_STATUS), 13) == adu(3, UNIT, bytes.fromhex("03 04 00 00 40 30"))
    rig.close()


@pytest.mark.parametrize("connection", [{}, {"framing": "tcp"}])
@pytest.mark.parametrize(
    ("settings", "order"),
    [
        ({}, 0),
        ({"word_order": "low-first"}, 1),
        ({"byte_order": "little"}, 2),
        ({"word_order": "low-first", "byte_order": "little"}, 3),
    ],
)
def test_the_drive_is_set_up_as_the_rig_file_says_and_may_be_set_up_otherwise(
    settings: dict[str, str], order: int, connection: dict[str, str]
) -> None:
    rig = Rig(connection=connection, **settings)
    now_ns = rig.clock.now_ns()
    idle = [[0, 0x4030], [0x4030, 0], [0, 0x3040], [0x3040, 0]]
    assert rig.drive.read(0x7E, 2, now_ns) == idle[order]
    rig.drive.set_up(BYTE_WORD_ORDER, 3 - order)
    assert rig.drive.read(0x7E, 2, now_ns) == idle[3 - order]
    rig.close()


def test_the_communication_time_out_needs_no_traffic(rig: Rig) -> None:
    rig.ask(write_request(0x138A, (50,)), 8)
    rig.ask(write_request(0x58, (0, 1, 8500, 2000, 1_000_000, 1_000_000, 1000, 1)), 8)
    rig.clock.sleep(2.0)
    assert [text for _, text in rig.drive.log] == ["move 8500", "alarm 85"]
    assert rig.axis.position_at(rig.clock.now_ns()) < 200


def test_closing_forgets_the_wire_but_not_a_successor() -> None:
    clock = SimulatedClock()
    first = attach(clock, ZoomOnlyWorld())
    second = attach(clock, ZoomOnlyWorld())
    first.close()
    assert wire_named("zoom") is not None
    second.close()
    assert wire_named("zoom") is None


def test_a_world_without_zoom_is_refused() -> None:
    with pytest.raises(UnsupportedError, match="no zoom axis"):
        attach(SimulatedClock(), object())


@pytest.mark.parametrize(
    ("sections", "key"),
    [
        ({"unit_id": 32}, "unit_id"),
        ({"connection": {"baudrate": 460800}}, "connection.baudrate"),
        ({"connection": {"framing": "ascii"}}, "connection.framing"),
        ({"word_order": "middle"}, "word_order"),
        ({"byte_order": "middle"}, "byte_order"),
    ],
)
def test_what_a_drive_cannot_be_set_to_is_refused(sections: dict[str, Any], key: str) -> None:
    with pytest.raises(ConfigError) as caught:
        attach(SimulatedClock(), ZoomOnlyWorld(), **sections)
    assert caught.value.key == key
