"""The end of an MCAP file: where it is, and what its summary lists."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, Footer, MetadataIndex, Schema

from microdrivers.recording.mcap_records import MAGIC, RECORD, parsed, records_in

_Read = Callable[[int, int], bytes]
"""Gives the bytes at an offset, so many; fewer at the end of the file."""
_FOOTER_HEAD = RECORD.pack(Opcode.FOOTER, 20)
_FOOTER_SIZE = RECORD.size + 20
_END_SIZE = _FOOTER_SIZE + len(MAGIC)
_CHUNK_INDEX = struct.Struct("<QQQQ")
"""First and last log time, place and length of the chunk."""
_OF_A_SUMMARY = frozenset({
    Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX, Opcode.SUMMARY_OFFSET,
})  # fmt: skip


class Summary(NamedTuple):
    """What an intact summary tells.

    Attributes:
        channels, schemas: by number.
        chunks: length by place.
        records: metadata and attachments, name by place.
    """

    channels: dict[int, Channel]
    schemas: dict[int, Schema]
    chunks: dict[int, int]
    records: dict[int, str]


def find_end(read: _Read, begin: int, size: int) -> int | None:
    """Where the recording ends whose data end right before `begin`, in a file of that size.

    The footer tells where the summary begins: it vouches for the end of the data. It is looked for at the end of the
    file, and where a summary that begins there ends: something may follow. If it is damaged, two of three signs of it
    suffice; if it is cut off, a summary that goes on to the end of the file.

    Returns:
        None if nothing tells that the data end there.
    """
    place = struct.pack("<Q", begin)
    last = size - _END_SIZE
    if last >= begin and read(last + RECORD.size, len(place)) == place:
        return size
    position = begin
    head = read(position, RECORD.size)
    while len(head) == RECORD.size and head[0] in _OF_A_SUMMARY:
        position += RECORD.size + RECORD.unpack(head)[1]
        head = read(position, RECORD.size) if position < size else b""
    end = read(position, _END_SIZE) if position < size else b""
    if len(end) < _END_SIZE:
        return size if position > begin or not end or end.startswith(_FOOTER_HEAD[: len(end)]) else None
    signs = end.startswith(_FOOTER_HEAD), end[RECORD.size :].startswith(place), end.endswith(MAGIC)
    return position + _END_SIZE if sum(signs) > 1 else None


def read_footer(read: _Read, end: int) -> Footer | None:
    """The footer of a file that ends there, if it has one, and a summary."""
    tail = read(max(0, end - _END_SIZE), _END_SIZE)
    if not tail.startswith(_FOOTER_HEAD[:1]) or tail[_FOOTER_SIZE:] != MAGIC:
        return None
    footer = parsed(Opcode.FOOTER, tail[RECORD.size : _FOOTER_SIZE])
    return footer if isinstance(footer, Footer) and 0 < footer.summary_start < end else None


def read_summary(read: _Read, footer: Footer, end: int) -> Summary | None:
    """The summary that the footer of a file that ends there names; None if its CRC does not match."""
    data = read(footer.summary_start, end - len(MAGIC) - footer.summary_start)
    if zlib.crc32(data[:-4]) != footer.summary_crc:
        return None
    found = Summary({}, {}, {}, {})
    for opcode, start, stop in records_in(data):
        if opcode == Opcode.CHUNK_INDEX:  # most of them
            *_, offset, length = _CHUNK_INDEX.unpack_from(data, start)
            found.chunks[offset] = length
            continue
        record = parsed(opcode, data[start:stop])
        if isinstance(record, Schema):
            found.schemas[record.id] = record
        elif isinstance(record, Channel):
            found.channels[record.id] = record
        elif isinstance(record, AttachmentIndex | MetadataIndex):
            found.records[record.offset] = record.name
    return found
