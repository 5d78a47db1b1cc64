"""Entries of an object dictionary: where a value stands and how it is coded (CiA 301, little endian)."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

Value = TypeVar("Value")


@dataclass(frozen=True, slots=True)
class Entry(Generic[Value]):
    """One entry.

    Attributes:
        index, sub: its place.
        bits: its length; 0 if that varies.
        decode, encode: between its bytes and its value. `encode` raises `OverflowError` if the value does not fit.
        name: what it is, for messages.
    """

    index: int
    sub: int
    bits: int
    decode: Callable[[bytes], Value]
    encode: Callable[[Value], bytes]
    name: str = ""

    def __str__(self) -> str:
        return object_name(self.index, self.sub, self.name)

    @property
    def mapping(self) -> int:
        """The word that maps it into a PDO: index, sub-index, bits."""
        return self.index << 16 | self.sub << 8 | self.bits


def object_name(index: int, sub: int, name: str = "") -> str:
    """An entry as messages write it: 6041h.0 (status word)."""
    return f"{index:04X}h.{sub:X}" + (f" ({name})" if name else "")


def unsigned(index: int, sub: int, bits: int, name: str = "") -> Entry[int]:
    """An unsigned integer of 8, 16, 24, 32 … bits."""
    return _integer(index, sub, bits, name, signed=False)


def signed(index: int, sub: int, bits: int, name: str = "") -> Entry[int]:
    """A signed integer of 8, 16, 24, 32 … bits."""
    return _integer(index, sub, bits, name, signed=True)


def real32(index: int, sub: int, name: str = "") -> Entry[float]:
    """A single-precision floating-point number."""

    def decode(data: bytes) -> float:
        number: float = struct.unpack("<f", data)[0]
        return number

    def encode(value: float) -> bytes:
        return struct.pack("<f", value)

    return Entry(index, sub, 32, decode, encode, name)


def text(index: int, sub: int, name: str = "") -> Entry[str]:
    """A visible string of any length."""

    def decode(data: bytes) -> str:
        return data.rstrip(b"\0").decode("latin-1").strip()

    def encode(value: str) -> bytes:
        return value.encode("latin-1")

    return Entry(index, sub, 0, decode, encode, name)


def _integer(index: int, sub: int, bits: int, name: str, *, signed: bool) -> Entry[int]:
    def decode(data: bytes) -> int:
        return int.from_bytes(data, "little", signed=signed)

    def encode(value: int) -> bytes:
        return value.to_bytes(bits // 8, "little", signed=signed)

    return Entry(index, sub, bits, decode, encode, name)


DEVICE_TYPE = unsigned(0x1000, 0, 32, "device type")
DEVICE_NAME = text(0x1008, 0, "device name")
SOFTWARE_VERSION = text(0x100A, 0, "software version")
CONSUMER_HEARTBEAT = unsigned(0x1016, 1, 32, "consumer heartbeat time")
PRODUCER_HEARTBEAT = unsigned(0x1017, 0, 16, "producer heartbeat time")
VENDOR_ID = unsigned(0x1018, 1, 32, "vendor id")
PRODUCT_CODE = unsigned(0x1018, 2, 32, "product code")
REVISION = unsigned(0x1018, 3, 32, "revision number")
SERIAL_NUMBER = unsigned(0x1018, 4, 32, "serial number")
