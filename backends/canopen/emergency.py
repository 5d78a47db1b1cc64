"""Emergency messages: what a node says of itself when an error comes or goes (CiA 301)."""

from __future__ import annotations

from typing import NamedTuple

EMERGENCY_ID = 0x80

_CODES = {
    0x2310: "over-current at the output",
    0x3210: "over-voltage in the DC link",
    0x3220: "under-voltage in the DC link",
    0x4210: "over-temperature of the device",
    0x4310: "over-temperature of the drive",
    0x7121: "motor blocked",
    0x7300: "sensor or encoder error",
    0x8110: "CAN overrun, messages were lost",
    0x8120: "CAN error passive",
    0x8130: "heartbeat or life guarding lost",
    0x8140: "recovered from bus-off",
    0x8210: "PDO not processed, wrong length",
    0x8220: "PDO longer than mapped",
    0x8611: "following error",
    0x8612: "reference limit",
    0xFF10: "excessive position deviation",
    0xFF62: "homing error",
    0xFF66: "hardware limit reached",
    0xFF67: "software limit reached",
    0xFF70: "parameter error",
}
"""FFxxh are the device's own: those of the BLV-R (HP-5143E)."""

_CLASSES = {
    0x00: "no error", 0x10: "generic error", 0x20: "current", 0x21: "current at the input", 0x22: "current inside",
    0x23: "current at the output", 0x30: "voltage", 0x31: "mains voltage", 0x32: "voltage inside",
    0x33: "output voltage", 0x40: "temperature", 0x41: "ambient temperature", 0x42: "device temperature",
    0x50: "device hardware", 0x60: "device software", 0x61: "internal software", 0x62: "user software",
    0x63: "data set", 0x70: "additional modules", 0x80: "monitoring", 0x81: "communication", 0x82: "protocol error",
    0x84: "velocity control", 0x86: "positioning", 0x90: "external error", 0xF0: "additional functions",
    0xFF: "the device's own",
}  # fmt: skip


class Emergency(NamedTuple):
    """One message: error code, error register (1001h) and 5 bytes of the maker's own."""

    code: int
    register: int
    extra: bytes

    @property
    def is_over(self) -> bool:
        """Whether it says that an error is over (00xxh)."""
        return self.code >> 8 == 0

    def __str__(self) -> str:
        return f"{error_meaning(self.code)} (error code {self.code:04X}h)"


def decode_emergency(data: bytes) -> Emergency:
    """An emergency message; missing bytes count as 0."""
    data = data.ljust(8, b"\0")
    return Emergency(int.from_bytes(data[:2], "little"), data[2], data[3:8])


def error_meaning(code: int) -> str:
    """What an error code means: exactly, or its class."""
    return _CODES.get(code) or _CLASSES.get(code >> 8) or _CLASSES.get(code >> 8 & 0xF0, "unknown error")
