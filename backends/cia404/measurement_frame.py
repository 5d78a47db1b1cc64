"""The PDO in which an amplifier sends its process value and status: layout, meaning, time on the bus.

Sources: CiA 404-1, objects 6130h/7130h/9130h, 6132h, 6150h; CAN 2.0 A for the bits of a frame.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from microdrivers.backends.lines.can_load import longest_frame_bits
from microdrivers.core.units import NS_PER_S
from microdrivers.devices.force_sensor import DISCONNECTED, SATURATED

STATUS = 0x6150
_STATUS_BITS = 8
_INVALID, _OVERLOADS = 0x01, 0x06

_FIXED_BITS = 44
_SYNC_BYTES = 0


class ProcessValue(NamedTuple):
    """One format in which an amplifier may offer its process value; `has_digits`: 6132h applies to it."""

    object_index: int
    code: str
    bits: int
    has_digits: bool


PROCESS_VALUES = (
    ProcessValue(0x9130, "i", 32, has_digits=True),
    ProcessValue(0x6130, "f", 32, has_digits=False),
    ProcessValue(0x7130, "h", 16, has_digits=True),
)
"""In order of preference: whole numbers lose nothing."""

LARGEST_FRAME_BYTES = 5


def _meaning(status: int) -> frozenset[str]:
    if status & _OVERLOADS:
        return frozenset({SATURATED})
    return frozenset({DISCONNECTED}) if status else frozenset()


STATUS_FLAGS = tuple(_meaning(status) for status in range(256))
"""What each value of 6150h says: bits 1 and 2 are overload; any other, bit 0 among them, is "not valid"."""


class MeasurementFrame:
    """A process value, and the status behind it if the amplifier has one.

    Args:
        value: its format.
        channel: the sub-index of all objects.
        has_status: whether the status is mapped behind the value.
        uN_per_count: what the value is multiplied by.

    Attributes:
        mapping: the words for 1A00h.
        length: bytes.
    """

    def __init__(self, value: ProcessValue, *, channel: int, has_status: bool, uN_per_count: float) -> None:
        self.value = value
        words = [value.object_index << 16 | channel << 8 | value.bits]
        if has_status:
            words.append(STATUS << 16 | channel << 8 | _STATUS_BITS)
        self.mapping = tuple(words)
        self.has_status = has_status
        self.uN_per_count = uN_per_count
        layout = struct.Struct(f"<{value.code}{'B' * has_status}")
        self.length = layout.size
        self._unpack = layout.unpack

    def decode(self, data: bytes) -> tuple[float, frozenset[str]]:
        """Raw force, µN, and flags; `data` is as long as the frame."""
        if self.has_status:
            count, status = self._unpack(data)
            return count * self.uN_per_count, STATUS_FLAGS[status]
        return self._unpack(data)[0] * self.uN_per_count, STATUS_FLAGS[0]


class FrameTime(NamedTuple):
    """How long a data frame with an 11-bit identifier takes on the bus: `ns` ± `half_width_ns`, by its stuff bits."""

    ns: int
    half_width_ns: int


def frame_time(length: int, *, bitrate: int) -> FrameTime:
    """The time of a frame of `length` bytes, and of the silence behind it."""
    least, most = _FIXED_BITS + 8 * length, longest_frame_bits(length)
    return FrameTime(round((least + most) / 2 * NS_PER_S / bitrate), -(-(most - least) * NS_PER_S // (2 * bitrate)))


def bus_load(rate_hz: float, length: int, *, bitrate: int, with_sync: bool) -> float:
    """The share of the bus that frames of `length` bytes take at most, and the SYNCs if they are sent for them."""
    bits = longest_frame_bits(length) + (longest_frame_bits(_SYNC_BYTES) if with_sync else 0)
    return rate_hz * bits / bitrate
