"""A classic CAN frame, its rank in arbitration and the bits that it takes.

Source: Bosch CAN specification 2.0 (1991), part B; ISO 11898-1. CAN FD is not emulated.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import msgspec

from microdrivers.core.errors import OutOfRange

INTERFRAME_BITS = 3
"""Intermission: recessive bits before the next frame may start."""

ERROR_FRAME_BITS = 20
"""Error flag (6), its longest echo by the others (6) and the delimiter (8)."""

MOST_BITS = 64 + 8 * 8 + (53 + 8 * 8) // 4
"""Of an extended frame with 8 bytes and as many stuff bits as there can be."""

_MAX_DATA = 8
_CRC_POLYNOMIAL = 0x4599
_CRC_MASK = 0x7FFF
_CRC_BITS = 15
_TAIL_BITS = 10  # CRC delimiter, acknowledge slot and delimiter, end of frame (7): never stuffed


class Frame(msgspec.Struct, frozen=True, gc=False):
    """One data or remote frame.

    Attributes:
        id: identifier, 11 bits, or 29 if `extended`.
        data: 0 to 8 bytes. Of a remote frame, as many bytes as it asks for (its DLC); they are not on the bus.
    """

    id: int
    data: bytes = b""
    extended: bool = False
    remote: bool = False


class Due(msgspec.Struct, frozen=True, gc=False):
    """A frame that a node sends, and the earliest time at which it competes for the bus."""

    t_ns: int
    frame: Frame


def arbitration_rank(frame: Frame) -> int:
    """The arbitration field as it appears on the bus, as one number: the lowest wins.

    A standard data frame wins against a remote one of the same identifier, and both against an extended frame whose
    first 11 bits are the same.

    Raises:
        OutOfRange: it is no classic frame.
    """
    return _header(frame.id, frame.extended, frame.remote, len(frame.data)).rank


@functools.lru_cache(maxsize=16384)
def frame_shape(frame: Frame) -> tuple[int, int]:
    """`arbitration_rank` and `frame_bits`.

    Raises:
        OutOfRange: it is no classic frame.
    """
    return arbitration_rank(frame), frame_bits(frame)


def frame_bits(frame: Frame) -> int:
    """Bits from the start of frame to the end of frame, stuff bits included, without the interframe space.

    44 + 8n bits and at most (33 + 8n) // 4 stuff bits for n bytes; 64 + 8n and (53 + 8n) // 4 if extended.

    Raises:
        OutOfRange: it is no classic frame.
    """
    data = frame.data
    _, total, crc, run = _header(frame.id, frame.extended, frame.remote, len(data))
    if not frame.remote:
        for octet in data:
            crc = (crc << 8 & _CRC_MASK) ^ _CRC_TABLE[crc >> 7 ^ octet]
            run = _STUFF_8[run & _RUN | octet]
            total += run & _INSERTED
    run = _STUFF_8[run & _RUN | crc >> 7]
    return total + (run & _INSERTED) + (_STUFF_7[run & _RUN | crc & 0x7F] & _INSERTED)


def crc15(data: bytes) -> int:
    """CRC-15/CAN: polynomial 4599h, start 0, not reflected."""
    crc = 0
    for octet in data:
        crc = (crc << 8 & _CRC_MASK) ^ _CRC_TABLE[crc >> 7 ^ octet]
    return crc


class _Header(NamedTuple):
    rank: int
    bits: int  # of the whole frame, but for the stuff bits after the header
    crc: int
    run: int


@functools.lru_cache(maxsize=4096)
def _header(identifier: int, extended: bool, remote: bool, length: int) -> _Header:
    """What follows from all but the data."""
    if not (0 <= identifier <= (0x1FFFFFFF if extended else 0x7FF) and length <= _MAX_DATA):
        raise OutOfRange(
            f"no classic CAN frame: identifier {identifier:X}h, {'29' if extended else '11'} bits, {length} bytes",
            remedy="a CAN frame has 11 or 29 bits of identifier and 0 to 8 bytes",
        )
    base, rest = (identifier >> 18, identifier & 0x3FFFF) if extended else (identifier, 0)
    if extended:  # start, base identifier, SRR, IDE, 18 bits of identifier, RTR, r1, r0, DLC
        bits = 39
        header = base << 27 | 0b11 << 25 | rest << 7 | remote << 6 | length
        rank = base << 21 | 0b11 << 19 | rest << 1 | remote
    else:  # start, identifier, RTR, IDE, r0, DLC
        bits = 19
        header = base << 7 | remote << 6 | length
        rank = base << 21 | remote << 20
    # As if recessive bits that nobody counts went before: the first bit, dominant, starts a run of its own.
    run = _extend_run(1 << 10, header, bits)
    bits += (run & _INSERTED) + (0 if remote else 8 * length) + _CRC_BITS + _TAIL_BITS
    # Leading zeros change nothing in a CRC that starts with zero.
    return _Header(rank, bits, crc15(header.to_bytes(5)), run)


def _extend_run(run: int, value: int, bits: int) -> int:
    """A run of equal bits, after the `bits` lowest bits of `value`, highest first.

    A run is bit << 10 | (length - 1) << 8 | stuff bits that were just inserted. A fifth equal bit is followed at once
    by a stuff bit, which starts a run of the other kind, so that the length is 1 to 4.
    """
    level, length, inserted = run >> 10, (run >> 8 & 3) + 1, 0
    for position in reversed(range(bits)):
        bit = value >> position & 1
        level, length = bit, length + 1 if bit == level else 1
        if length == 5:
            level, length, inserted = 1 - bit, 1, inserted + 1
    return level << 10 | (length - 1) << 8 | inserted


def _crc_entry(octet: int) -> int:
    crc = octet << 7
    for _ in range(8):
        crc = crc << 1 ^ (_CRC_POLYNOMIAL if crc & 0x4000 else 0)
    return crc & _CRC_MASK


def _stuff_table(bits: int) -> list[int]:
    """By run | value: the run after that value."""
    return [_extend_run(index & _RUN, index & 0xFF, bits) for index in range(8 << 8)]


_RUN, _INSERTED = 0x700, 0xFF
_CRC_TABLE = [_crc_entry(octet) for octet in range(256)]
_STUFF_8 = _stuff_table(8)
_STUFF_7 = _stuff_table(7)
