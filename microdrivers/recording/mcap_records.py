"""The records of an MCAP file as bytes, and what they begin with."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple, Protocol

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    SummaryOffset,
)

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
_Known = Header | Metadata | Attachment | Footer | Schema | Channel | AttachmentIndex | MetadataIndex


class _Kind(Protocol):
    @staticmethod
    def read(stream: ReadDataStream) -> _Known: ...


_KINDS: dict[int, _Kind] = {
    Opcode.HEADER: Header, Opcode.METADATA: Metadata, Opcode.ATTACHMENT: Attachment, Opcode.FOOTER: Footer,
    Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.METADATA_INDEX: MetadataIndex,
}  # fmt: skip


def parsed(opcode: int, body: bytes) -> _Known | None:
    """The record, if it is of a kind that is needed and can be read."""
    kind = _KINDS.get(opcode)
    if kind is None:
        return None
    try:
        return kind.read(ReadDataStream(io.BytesIO(body)))
    except (McapError, struct.error, UnicodeDecodeError):
        return None


def read_definition(opcode: int, body: bytes) -> Schema | Channel | None:
    """The schema or channel with that body; None if it is another record."""
    record = parsed(opcode, body)
    return record if isinstance(record, Schema | Channel) else None


def records_in(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, begin and end of the body of each record of a chunk or a summary that is intact."""
    position = 0
    while position + RECORD.size <= len(data):
        opcode, length = RECORD.unpack_from(data, position)
        position += RECORD.size
        yield opcode, position, position + length
        position += length


class Written(NamedTuple):
    """A chunk, metadata or an attachment that was written.

    Attributes:
        listing: its record in the summary.
        offset: where it is, bytes.
        head: what it begins with; of a chunk as far as its CRC, of others all.
    """

    listing: bytes
    offset: int
    head: bytes

    @property
    def is_chunk(self) -> bool:
        """Whether it holds messages."""
        return self.listing[0] == Opcode.CHUNK_INDEX


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
