"""Abort codes of SDO transfers (CiA 301, table 22)."""

from __future__ import annotations

from enum import IntEnum


class AbortCode(IntEnum):
    """Why a transfer was aborted."""

    TOGGLE_NOT_ALTERNATED = 0x05030000
    TIMED_OUT = 0x05040000
    UNKNOWN_SPECIFIER = 0x05040001
    READ_OF_WRITE_ONLY = 0x06010001
    WRITE_OF_READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_TOO_LONG = 0x06040042
    HARDWARE = 0x06060000
    LENGTH = 0x06070010
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    VALUE_RANGE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    GENERAL = 0x08000000
    CANNOT_STORE = 0x08000020
    PRESENT_STATE = 0x08000022
    NO_DATA = 0x08000024


class SdoAbort(Exception):
    """An access to the object dictionary is refused."""

    def __init__(self, code: AbortCode) -> None:
        super().__init__(f"{code.name} ({code:08X}h)")
        self.code = code
