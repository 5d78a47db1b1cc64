"""CANopen's data types: little-endian bytes on the wire, plain Python values inside (CiA 301, 7.1)."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Value = Any
"""int, float or str, as the data type says."""


@dataclass(frozen=True, eq=False)
class DataType:
    """One data type.

    Attributes:
        code: index of its definition in the object dictionary.
        size: bytes; 0 if that depends on the value.
        pack, unpack: between a value and its bytes.
        struct_code: the type in the struct module's language, "" if that does not know it.
    """

    code: int
    size: int
    pack: Callable[[Value], bytes]
    unpack: Callable[[bytes], Value]
    struct_code: str = ""


def _plain(code: int, struct_code: str) -> DataType:
    packer = struct.Struct("<" + struct_code)
    return DataType(code, packer.size, packer.pack, lambda data: packer.unpack(data)[0], struct_code)


def _wide(code: int, size: int, *, signed: bool) -> DataType:
    return DataType(
        code,
        size,
        lambda value: value.to_bytes(size, "little", signed=signed),
        lambda data: int.from_bytes(data, "little", signed=signed),
    )


BOOLEAN = _plain(0x01, "?")
I8, I16, I32 = _plain(0x02, "b"), _plain(0x03, "h"), _plain(0x04, "i")
U8, U16, U32 = _plain(0x05, "B"), _plain(0x06, "H"), _plain(0x07, "I")
REAL32 = _plain(0x08, "f")
I24, U24 = _wide(0x10, 3, signed=True), _wide(0x16, 3, signed=False)
STRING = DataType(0x09, 0, lambda value: value.encode("latin-1"), lambda data: data.decode("latin-1"))
DUMMIES = {kind.code: kind for kind in (BOOLEAN, I8, I16, I32, U8, U16, U32, I24, U24)}
"""What an RPDO may map to let bytes pass unused."""
