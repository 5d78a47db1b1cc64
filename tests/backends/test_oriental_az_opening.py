"""Who is at the other end, and how it speaks."""

from __future__ import annotations

import logging
import struct
from typing import Any

import pytest

from microdrivers.core.errors import ConfigError, LinkTimeout, ProtocolError, UnsupportedError
from tests.backends.modbus_bench import soon
from tests.backends.oriental_az_bench import Bench, at_steps, check_honesty, sheet
from tests.backends.oriental_az_peer import Script, SheetDrive, with_crc

# The parameter's value, and what the rig file says.
ORDERS: list[tuple[int, dict[str, Any]]] = [
    (0, {"word_order": "high-first", "byte_order": "big"}),
    (1, {"word_order": "low-first", "byte_order": "big"}),
    (2, {"word_order": "high-first", "byte_order": "little"}),
    (3, {"word_order": "low-first", "byte_order": "little"}),
]


@pytest.mark.parametrize(("order", "settings"), ORDERS)
@pytest.mark.parametrize("framing", ["rtu", "tcp"])
def test_a_drive_in_each_order_over_each_framing(order: int, settings: dict[str, Any], framing: str) -> None:
    bench = Bench(SheetDrive(position=1000, order=order), connection={"framing": framing}, **settings).opened()
    with bench.motor.stream(40.0):
        final = bench.motor.move_to(zoom=at_steps(9000))
        assert (final.position_steps, final.on_target) == (9000, True)
        move = bench.motor.start_move_to(zoom=at_steps(-200))
        bench.clock.run_for(0.1)
        bench.motor.stop()
        bench.clock.run_for(0.5)
    assert move.state == "cancelled"
    assert sheet(bench).input == 0x20
    assert 5000 < bench.motor.read().position_steps < 9000
    bench.motor.reference()
    assert bench.motor.read().position_steps == 0
    check_honesty(bench)


@pytest.mark.parametrize("order", [0, 1, 2, 3])
@pytest.mark.parametrize(("value", "settings"), ORDERS)
def test_another_order_than_the_rig_files_is_refused(order: int, value: int, settings: dict[str, Any]) -> None:
    if order == value:
        return
    drive = SheetDrive(position=1000, order=order)
    bench = Bench(drive, **settings)
    theirs = ORDERS[order][1]
    with pytest.raises(ConfigError) as caught:
        bench.motor.open()
    for words in (theirs["word_order"], settings["word_order"], f"1384h is {order}", f"parameter to {value} "):
        assert words in str(caught.value)
    assert (caught.value.key, caught.value.device, bench.motor.link) == ("zoom.word_order", "zoom", "closed")
    assert {data[1] for data in drive.requests} == {0x03}


def test_an_order_that_waits_for_a_power_cycle_is_mentioned(caplog: pytest.LogCaptureFixture) -> None:
    drive = SheetDrive(position=1000, order=0)
    drive.stored_order = 1
    with caplog.at_level(logging.WARNING):
        Bench(drive).opened()
    assert "switched off and on, it will have word_order: low-first" in caplog.text


@pytest.mark.parametrize(
    ("answer", "evidence"),
    [
        (bytes.fromhex("018302"), "at 1384h with exception 02"),
        (bytes.fromhex("018301"), "at 1384h with exception 01"),
        (b"\x01\x03\x04" + struct.pack(">HH", 0x0C35, 0x0C36), "0C35h 0C36h"),
        (b"\x01\x03\x04" + struct.pack(">HH", 0, 4), "0000h 0004h"),
        (b"\x01\x03\x04" + struct.pack(">HH", 1, 1), "0001h 0001h"),
    ],
)
def test_another_modbus_device(answer: bytes, evidence: str) -> None:
    bench = Bench(Script(soon(with_crc(answer))))
    with pytest.raises(UnsupportedError, match=f"zoom: this is no AZ drive.*{evidence}") as caught:
        bench.motor.open()
    assert "unit_id" in caught.value.remedy
    assert (bench.motor.link, bench.wire.in_use) == ("closed", False)


def test_a_device_that_speaks_something_else() -> None:
    bench = Bench(Script(soon(b"(c)2015 Physik Instrumente (PI) GmbH\n"), soon(b"0 0 0\n" * 3)))
    with pytest.raises(ProtocolError, match=r"zoom: unit 1 on .* registers at 1384h") as caught:
        bench.motor.open()
    assert caught.value.received == b"0 0 0\n" * 3


def test_another_baud_rate_sounds_like_garbage_or_silence() -> None:
    garbage = bytes.fromhex("E0 00 FE 80 FE FE E0")
    bench = Bench(Script(soon(garbage), marks=[soon(garbage)]))
    with pytest.raises(LinkTimeout, match=r"zoom: unit 1 on .*115200 baud, parity E") as caught:
        bench.motor.open()
    assert "baud rate and parity" in caught.value.remedy


def test_another_unit_is_silence_that_names_the_unit() -> None:
    with pytest.raises(LinkTimeout, match="zoom: unit 7 on ") as caught:
        Bench(unit_id=7).motor.open()
    assert "unit id" in caught.value.remedy


def test_a_silent_unit_behind_a_gateway() -> None:
    bench = Bench(unit_id=7, connection={"framing": "tcp"})
    with pytest.raises(LinkTimeout, match=r"zoom: unit 7 on .*\(Modbus TCP\) gave no whole answer") as caught:
        bench.motor.open()
    assert "gateway's serial side" in caught.value.remedy
