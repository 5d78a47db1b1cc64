"""Modbus functions on 16-bit registers: what stands behind a function code in, what stands behind it out.

A device binds those that it has to its own reading and writing, with `functools.partial`. Source: Modbus Application
Protocol V1.1b3.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, SLAVE_FAILURE = 1, 2, 3, 4

_MAX_READ, _MAX_WRITE, _MAX_WRITE_WITH_READ = 125, 123, 121

Function = Callable[[bytes, int], bytes]
"""Data of a request and the time in ns at which it is carried out; returns the reply's, raises ModbusException."""

Read = Callable[[int, int, int], Sequence[int]]
"""Address, count, time in ns; returns unsigned words, raises ModbusException."""

Write = Callable[[int, Sequence[int], int], None]
"""Address, unsigned words, time in ns: all of them or, with a ModbusException, none."""


class ModbusException(Exception):
    """A request that is answered with an exception; `code` is the one on the wire."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code:02X}h")
        self.code = code


def read_registers(read: Read, data: bytes, t_ns: int) -> bytes:
    """Functions 03 and 04."""
    _require(len(data) == 4)
    address, count = struct.unpack(">HH", data)
    _require(1 <= count <= _MAX_READ)
    return _words(read, address, count, t_ns)


def write_register(write: Write, data: bytes, t_ns: int) -> bytes:
    """Function 06."""
    _require(len(data) == 4)
    address, value = struct.unpack(">HH", data)
    write(address, [value], t_ns)
    return data


def diagnose(data: bytes, t_ns: int) -> bytes:
    """Function 08, whose sub-function 0, echo, is the only one."""
    del t_ns
    _require(len(data) >= 2)
    if data[:2] != b"\x00\x00":
        raise ModbusException(ILLEGAL_FUNCTION)
    _require(len(data) == 4)
    return data


def write_registers(write: Write, data: bytes, t_ns: int) -> bytes:
    """Function 10h."""
    _require(len(data) >= 5)
    address, values = _parse_values(data, _MAX_WRITE)
    write(address, values, t_ns)
    return struct.pack(">HH", address, len(values))


def read_write_registers(read: Read, write: Write, data: bytes, t_ns: int) -> bytes:
    """Function 17h: writes first."""
    _require(len(data) >= 9)
    address, count = struct.unpack(">HH", data[:4])
    _require(1 <= count <= _MAX_READ)
    write_address, values = _parse_values(data[4:], _MAX_WRITE_WITH_READ)
    _check_span(address, count)
    write(write_address, values, t_ns)
    return _words(read, address, count, t_ns)


def _words(read: Read, address: int, count: int, t_ns: int) -> bytes:
    _check_span(address, count)
    return struct.pack(f">B{count}H", 2 * count, *read(address, count, t_ns))


def _parse_values(data: bytes, most: int) -> tuple[int, list[int]]:
    address, count, size = struct.unpack(">HHB", data[:5])
    _require(1 <= count <= most and size == 2 * count and len(data) == 5 + size)
    _check_span(address, count)
    return address, list(struct.unpack(f">{count}H", data[5:]))


def _require(well_formed: bool) -> None:
    if not well_formed:
        raise ModbusException(ILLEGAL_VALUE)


def _check_span(address: int, count: int) -> None:
    if address + count > 0x10000:
        raise ModbusException(ILLEGAL_ADDRESS)
