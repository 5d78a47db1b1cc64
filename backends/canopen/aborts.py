"""SDO abort codes and what they mean (CiA 301)."""

from __future__ import annotations

from microdrivers.backends.canopen.objects import object_name
from microdrivers.core.errors import RefusedError

TOGGLE_BIT = 0x05030000
TIMED_OUT = 0x05040000
BAD_COMMAND = 0x05040001
OUT_OF_MEMORY = 0x05040005
WRONG_LENGTH = 0x06070010

NO_OBJECT = 0x06020000
NO_SUB_INDEX = 0x06090011

_MEANINGS = {
    TOGGLE_BIT: "toggle bit not alternated",
    TIMED_OUT: "transfer timed out",
    BAD_COMMAND: "command specifier unknown or not valid",
    0x05040002: "block size not valid",
    0x05040003: "sequence number not valid",
    0x05040004: "CRC error",
    OUT_OF_MEMORY: "out of memory",
    0x06010000: "access not supported",
    0x06010001: "write-only object cannot be read",
    0x06010002: "read-only object cannot be written",
    NO_OBJECT: "no such object",
    0x06040041: "object cannot be mapped to a PDO",
    0x06040042: "mapped objects exceed the PDO's length",
    0x06040043: "parameters are incompatible",
    0x06040047: "internal incompatibility in the device",
    0x06060000: "hardware error",
    WRONG_LENGTH: "length does not match the object",
    0x06070012: "length too high",
    0x06070013: "length too low",
    NO_SUB_INDEX: "no such sub-index",
    0x06090030: "value out of range",
    0x06090031: "value too high",
    0x06090032: "value too low",
    0x06090036: "maximum is less than minimum",
    0x060A0023: "resource not available",
    0x08000000: "general error",
    0x08000020: "data cannot be stored",
    0x08000021: "data cannot be stored because of local control",
    0x08000022: "not possible in the present state of the device",
    0x08000023: "no object dictionary",
    0x08000024: "no data available",
}


class SdoAbort(RefusedError):
    """A node refuses to have an object read or written; nothing was done.

    Attributes:
        code: the abort code.
        index, sub: of the object.
    """

    def __init__(self, what: str, *, code: int, index: int, sub: int, remedy: str = "") -> None:
        super().__init__(
            f"{what} {object_name(index, sub)}: {abort_meaning(code)} ({code:08X}h)",
            remedy=remedy or "check that it is the device of the rig file, its firmware and its state",
        )
        self.code = code
        self.index = index
        self.sub = sub

    @property
    def is_missing(self) -> bool:
        """Whether there is no such object."""
        return self.code in (NO_OBJECT, NO_SUB_INDEX)


def abort_meaning(code: int) -> str:
    """What an abort code means."""
    return _MEANINGS.get(code, "reason of the device's own")
