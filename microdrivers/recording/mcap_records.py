"""The records of an MCAP file as bytes, and what they begin with."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Mapping

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import DataEnd, Footer, McapRecord, SummaryOffset

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")
"""Opcode and length; then the record."""
MESSAGE = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time, publish time; then the message's data."""
MESSAGE_BEGIN = struct.Struct("<BQHI")
"""Opcode, length, channel, sequence: as much as a reader needs, and no record in a chunk is shorter."""
CHUNK = struct.Struct("<BQQQQII")
"""Opcode, length, first and last log time, uncompressed size and CRC, length of the compression's name."""


_MESSAGE_HEAD = MESSAGE.size - RECORD.size
_FOOTER = struct.Struct("<BQQQ")
"""All of it but its CRC, which covers this, too."""


def written(record: McapRecord) -> bytes:
    """The record."""
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data


def message_record(channel: int, data: bytes, further: int, sequence: int, log_ns: int, publish_ns: int) -> bytes:
    """A message's record, of whose data `further` bytes are to follow."""
    size = _MESSAGE_HEAD + len(data) + further
    return MESSAGE.pack(Opcode.MESSAGE, size, channel, sequence & 0xFFFFFFFF, log_ns, publish_ns) + data


def end_of_file(groups: Mapping[int, Iterable[bytes]], *, offset: int) -> bytes:
    """What ends a file, to stand at byte `offset`: a summary of these records, by kind, and its footer."""
    end = written(DataEnd(0))
    begin = offset + len(end)
    summary, places = bytearray(), bytearray()
    for opcode, records in groups.items():
        start = len(summary)
        summary += b"".join(records)
        if len(summary) > start:
            places += written(
                SummaryOffset(group_opcode=opcode, group_start=begin + start, group_length=len(summary) - start)
            )
    places_begin = begin + len(summary)
    summary += places
    crc = zlib.crc32(_FOOTER.pack(Opcode.FOOTER, 20, begin, places_begin), zlib.crc32(summary))
    footer = written(Footer(summary_start=begin, summary_offset_start=places_begin, summary_crc=crc))
    return b"".join((end, summary, footer, MAGIC))
