"""The emulated AZ drive's byte and word order (1384h): the same values in four arrangements of their bytes."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.fakes.modbus import frame
from microdrivers.fakes.oriental_az.register_map import BYTE_WORD_ORDER, from_words, to_words
from tests.fakes.az_bench import HOME_END, IN_POSITION, READY, UNIT, AzBench, GatewayBench

ARRANGED = {0: "12 34 56 78", 1: "56 78 12 34", 2: "34 12 78 56", 3: "78 56 34 12"}
ORDERS = sorted(ARRANGED)


def arrange(value: int, order: int) -> bytes:
    """The four bytes of a value, as the table in the manual puts them."""
    a, b, c, d = struct.pack(">i", value)
    return bytes({0: (a, b, c, d), 1: (c, d, a, b), 2: (b, a, d, c), 3: (d, c, b, a)}[order])


def set_up(order: int, made: type[AzBench] = AzBench) -> AzBench:
    bench = made()
    bench.drive.set_up(BYTE_WORD_ORDER, order)
    return bench


def read(bench: AzBench, address: int, count: int = 2) -> bytes:
    reply = bench.ask(frame(UNIT, struct.pack(">BHH", 3, address, count)))
    assert reply[1:3] == bytes((3, 2 * count))
    return reply[3:-2]


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("made", [AzBench, GatewayBench])
def test_a_pair_is_arranged_as_the_manual_says(order: int, made: type[AzBench]) -> None:
    bench = set_up(order, made)
    data = bytes.fromhex(ARRANGED[order])
    assert bench.ask(frame(UNIT, bytes.fromhex("10 00 5C 00 02 04") + data))[1] == 0x10
    assert read(bench, 0x5C) == data
    assert bench.drive.read(0x5C, 2, bench.t_ns) == list(struct.unpack(">2H", data))
    bench.drive.set_up(BYTE_WORD_ORDER, 0)
    assert read(bench, 0x5C).hex() == "12345678"


@pytest.mark.parametrize("order", ORDERS)
@given(value=st.integers(-(2**31), 2**31 - 1))
@settings(max_examples=30, deadline=None)
def test_arranging_can_be_undone(order: int, value: int) -> None:
    words = to_words(value, order)
    assert struct.pack(">2H", *words) == arrange(value, order)
    assert from_words(*words, order) == value


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("steps", [-8500, 70_000])
def test_direct_data_and_monitors_follow_it(order: int, steps: int) -> None:
    bench = set_up(order)
    block = b"".join(arrange(value, order) for value in (0, 1, steps, 50_000, 1_000_000, 1_000_000, 1000, 1))
    assert bench.ask(frame(UNIT, bytes.fromhex("10 00 58 00 10 20") + block))[1] == 0x10
    assert bench.texts() == [f"move {steps}"]
    bench.wait_ms(5000)
    assert read(bench, 0xC6) == arrange(steps, order)
    assert read(bench, 0x7E) == arrange(IN_POSITION | READY | HOME_END, order)


@pytest.mark.parametrize(
    ("order", "address", "value"), [(0, 0x7D, 0x20), (1, 0x7C, 0x20), (2, 0x7D, 0x2000), (3, 0x7C, 0x2000)]
)
def test_a_single_register_follows_it(order: int, address: int, value: int) -> None:
    bench = set_up(order)
    request = frame(UNIT, struct.pack(">BHH", 6, address, value))
    assert bench.ask(request) == request
    assert bench.texts() == ["stop"]
    assert read(bench, address, 1) == struct.pack(">H", value)
    assert read(bench, address ^ 1, 1) == b"\x00\x00"


def test_in_the_wrong_order_values_are_out_of_range() -> None:
    bench = set_up(1)
    assert bench.move(8500) == 4
    assert bench.texts() == []


def test_a_host_can_change_it_with_configuration() -> None:
    bench = AzBench()
    assert bench.write(BYTE_WORD_ORDER, 4) == 4
    assert bench.write(BYTE_WORD_ORDER, 3) == 0
    assert bench.read(BYTE_WORD_ORDER) == 3
    assert bench.write(0x18C, 1) == 0
    assert read(bench, BYTE_WORD_ORDER) == arrange(3, 3)
    bench.drive.power_cycle(bench.t_ns)
    bench.wait_ms(1000)
    assert bench.read(BYTE_WORD_ORDER) == 0
