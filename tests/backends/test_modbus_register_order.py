from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from microdrivers.backends.modbus.register_order import RegisterOrder

# HP-5142E: where 1234 5678h lies.
TABLE = {
    RegisterOrder("high-first", "big"): "12345678",
    RegisterOrder("low-first", "big"): "56781234",
    RegisterOrder("high-first", "little"): "34127856",
    RegisterOrder("low-first", "little"): "78563412",
}


@pytest.mark.parametrize(("order", "data"), TABLE.items())
def test_where_the_bytes_lie(order: RegisterOrder, data: str) -> None:
    assert struct.pack(">HH", *order.to_registers(0x12345678)).hex() == data


@given(st.sampled_from(list(TABLE)), st.integers(-(1 << 31), (1 << 31) - 1))
def test_there_and_back(order: RegisterOrder, value: int) -> None:
    assert order.from_registers(*order.to_registers(value)) == value


def test_unsigned_values() -> None:
    assert RegisterOrder().to_registers(0xFFFFFFFE) == (0xFFFF, 0xFFFE)
