"""Writes MCAP in chunks, for a writer that may be killed at any moment and a disk that may be full.

The library's writer copies a frame five times and a sample costs it 20 µs; this one hands frames to the operating
system where they lie. What reaches the file is whole chunks: one that cannot be written is taken back.
"""

from __future__ import annotations

import contextlib
import struct
import zlib
from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple, Protocol

import zstandard
from mcap.data_stream import RecordBuilder
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
    Statistics,
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

_CHUNK_BYTES = 64 * 1024
_ZSTD = "zstd"
_ZSTD_LEVEL = 1
_Part = bytes | bytearray | memoryview
_U64 = struct.Struct("<Q")
_MESSAGE_HEAD = MESSAGE.size - 9


class Output(Protocol):
    """An unbuffered file that can be taken back to an earlier size."""

    def write(self, data: bytes | memoryview, /) -> int | None:
        """Write some of it; tells how much."""

    def truncate(self, size: int, /) -> int:
        """Cut off what is behind `size`."""

    def seek(self, offset: int, /) -> int:
        """Write there next."""


class ChannelKey(NamedTuple):
    """A channel and its schema."""

    topic: str
    schema_name: str
    schema: bytes


class LostChunk(Exception):
    """A chunk could not be written.

    Attributes:
        messages: how many messages of which channel are lost.
        error: why.
    """

    def __init__(self, messages: Mapping[int, int], error: OSError) -> None:
        super().__init__(str(error))
        self.messages = messages
        self.error = error


class _Chunk:
    """A chunk that is being filled: its records, where the messages of each channel are, and whom it introduces."""

    __slots__ = ("defines", "index", "parts", "pending", "size")

    def __init__(self) -> None:
        self.parts: list[_Part] = []
        self.pending = bytearray()
        self.size = 0
        self.index: dict[int, list[int]] = {}
        self.defines: list[int] = []


class McapWriter:
    """Writes one file. `compress_images` compresses each chunk that holds an image, without loss (zstd).

    Raises:
        OSError: the file's first record cannot be written.
    """

    def __init__(self, output: Output, *, profile: str, library: str, compress_images: bool = False) -> None:
        self.size = 0
        self._output = output
        self._torn = False
        self._compress_images = compress_images
        self._channels: dict[ChannelKey, Channel] = {}
        self._schemas: dict[tuple[str, bytes], Schema] = {}
        self._definitions: dict[int, bytes] = {}
        self._defined: set[int] = set()
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._chunk_indexes: list[bytes] = []
        self._counts: Counter[int] = Counter()
        self._first_ns: int | None = None
        self._last_ns = 0
        self._chunk = _Chunk()
        self._write([MAGIC, _written(Header(profile, library))])

    # ------------------------------------------------------------------ messages

    def channel(self, key: ChannelKey) -> int:
        """The number of that channel, which is defined in the file with its first message."""
        known = self._channels.get(key)
        if known is None:
            schema = self._schemas.setdefault(
                (key.schema_name, key.schema),
                Schema(id=len(self._schemas) + 1, data=key.schema, encoding="protobuf", name=key.schema_name),
            )
            known = Channel(
                id=len(self._channels) + 1, topic=key.topic, message_encoding="protobuf", metadata={},
                schema_id=schema.id,
            )  # fmt: skip
            self._channels[key] = known
            self._definitions[known.id] = _written(schema) + _written(known)
        return known.id

    def add_message(self, channel: int, data: bytes, *, sequence: int, log_ns: int, publish_ns: int) -> None:
        """Add a message to the present chunk.

        Raises:
            LostChunk: the chunk is full now and could not be written.
        """
        self._append(self._chunk, channel, data, sequence, log_ns, publish_ns)
        if self._chunk.size > _CHUNK_BYTES:
            self.flush()

    def add_image(
        self, channel: int, head: bytes, pixels: memoryview, *, sequence: int, log_ns: int, publish_ns: int
    ) -> None:
        """Add an image, of whose message `pixels` is the last part, and write it at once.

        With `flush` and its info before it, both have a chunk of their own: a reader can leave images out.

        Raises:
            LostChunk: the chunk could not be written; the file is as it was before.
        """
        self._append(self._chunk, channel, head, sequence, log_ns, publish_ns, pixels)
        self.flush(compression=_ZSTD if self._compress_images else "")

    def flush(self, *, compression: str = "") -> None:
        """Write the present chunk, if there is anything in it.

        Raises:
            LostChunk: it could not be written; the file is as it was before.
        """
        if self._chunk.index:
            chunk, self._chunk = self._chunk, _Chunk()
            self._finish_chunk(chunk, compression)

    def _append(
        self,
        chunk: _Chunk,
        channel: int,
        data: bytes,
        sequence: int,
        log_ns: int,
        publish_ns: int,
        pixels: memoryview | None = None,
    ) -> None:
        pending = chunk.pending
        if channel not in self._defined:
            pending += self._definitions[channel]
            chunk.size += len(self._definitions[channel])
            chunk.defines.append(channel)
            self._defined.add(channel)
        chunk.index.setdefault(channel, []).extend((log_ns, chunk.size))
        size = _MESSAGE_HEAD + len(data) + (pixels.nbytes if pixels is not None else 0)
        pending += MESSAGE.pack(Opcode.MESSAGE, size, channel, sequence & 0xFFFFFFFF, log_ns, publish_ns)
        pending += data
        chunk.size += 9 + size
        if pixels is not None:
            chunk.parts += (pending, pixels)
            chunk.pending = bytearray()

    def _finish_chunk(self, chunk: _Chunk, compression: str) -> None:
        try:
            self._write_chunk([*chunk.parts, chunk.pending], chunk.size, chunk.index, compression)
        except OSError as error:
            self._defined.difference_update(chunk.defines)
            raise LostChunk({channel: len(entries) // 2 for channel, entries in chunk.index.items()}, error) from error

    def _write_chunk(self, parts: list[_Part], size: int, index: dict[int, list[int]], compression: str) -> None:
        crc = 0
        for part in parts:
            crc = zlib.crc32(part, crc)
        stored = size
        if compression:
            parts = [zstandard.compress(b"".join(parts), _ZSTD_LEVEL)]
            stored = len(parts[0])
        first_ns = min(min(entries[::2]) for entries in index.values())
        last_ns = max(max(entries[::2]) for entries in index.values())
        name = compression.encode()
        length = CHUNK.size - 9 + len(name) + 8 + stored
        head = CHUNK.pack(Opcode.CHUNK, length, first_ns, last_ns, size, crc, len(name)) + name + _U64.pack(stored)
        start, offset, offsets, indexes = self.size, self.size + 9 + length, bytearray(), bytearray()
        for channel, entries in index.items():
            offsets += struct.pack("<HQ", channel, offset + len(indexes))
            entries_size = 8 * len(entries)
            indexes += struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + entries_size, channel, entries_size)
            indexes += struct.pack(f"<{len(entries)}Q", *entries)
        self._write([head, *parts, indexes])
        body = b"".join((
            struct.pack("<QQQQI", first_ns, last_ns, start, 9 + length, len(offsets)), offsets,
            struct.pack("<QI", len(indexes), len(name)), name, struct.pack("<QQ", stored, size),
        ))  # fmt: skip
        self._chunk_indexes.append(struct.pack("<BQ", Opcode.CHUNK_INDEX, len(body)) + body)
        self._first_ns = first_ns if self._first_ns is None else min(self._first_ns, first_ns)
        self._last_ns = max(self._last_ns, last_ns)
        for channel, entries in index.items():
            self._counts[channel] += len(entries) // 2

    # ------------------------------------------------------------------ other records

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Write a metadata record at once.

        Raises:
            OSError: it could not be written.
        """
        record = _written(Metadata(name=name, metadata=dict(data)))
        index = MetadataIndex(offset=self.size, length=len(record), name=name)
        self._write([record])
        self._metadata.append(index)

    def add_attachment(self, name: str, media_type: str, data: bytes, *, log_ns: int) -> None:
        """Write an attachment at once.

        Raises:
            OSError: it could not be written.
        """
        attachment = Attachment(create_time=0, log_time=log_ns, name=name, media_type=media_type, data=data)
        record = _written(attachment)
        index = AttachmentIndex(
            offset=self.size, length=len(record), log_time=log_ns, create_time=0, data_size=len(data), name=name,
            media_type=media_type,
        )  # fmt: skip
        self._write([record])
        self._attachments.append(index)

    def finish(self) -> None:
        """Write the summary and the end, all chunks having been flushed.

        Raises:
            OSError: it could not be written; the file is then readable as a torn one.
        """
        defined = [channel for channel in self._channels.values() if channel.id in self._defined]
        schemas = {channel.schema_id for channel in defined}
        statistics = Statistics(
            attachment_count=len(self._attachments), channel_count=len(defined),
            channel_message_counts=dict(sorted(self._counts.items())), chunk_count=len(self._chunk_indexes),
            message_count=self._counts.total(), metadata_count=len(self._metadata),
            message_start_time=self._first_ns or 0, message_end_time=self._last_ns, schema_count=len(schemas),
        )  # fmt: skip
        groups = {
            Opcode.SCHEMA: [_written(schema) for schema in self._schemas.values() if schema.id in schemas],
            Opcode.CHANNEL: [_written(channel) for channel in defined],
            Opcode.STATISTICS: [_written(statistics)],
            Opcode.CHUNK_INDEX: self._chunk_indexes,
            Opcode.ATTACHMENT_INDEX: [_written(index) for index in self._attachments],
            Opcode.METADATA_INDEX: [_written(index) for index in self._metadata],
        }
        end = _written(DataEnd(0))
        summary_start = self.size + len(end)
        summary, offsets = bytearray(), bytearray()
        for opcode, records in groups.items():
            start = len(summary)
            summary += b"".join(records)
            if len(summary) > start:
                offsets += _written(
                    SummaryOffset(
                        group_opcode=opcode, group_start=summary_start + start, group_length=len(summary) - start
                    )
                )
        offsets_start = summary_start + len(summary)
        summary += offsets
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, summary_start, offsets_start)
        crc = zlib.crc32(footer, zlib.crc32(summary))
        footer = _written(Footer(summary_start=summary_start, summary_offset_start=offsets_start, summary_crc=crc))
        self._write([end, summary, footer, MAGIC])

    def _write(self, parts: list[_Part]) -> None:
        """Write all of it or nothing."""
        if self._torn:
            self._take_back()
        written = 0
        try:
            for part in parts:
                rest = memoryview(part)
                while rest.nbytes:
                    count = self._output.write(rest) or 0
                    rest = rest[count:]
                    written += count
        except OSError:
            self._torn = True
            with contextlib.suppress(OSError):  # it is tried again before the next write
                self._take_back()
            raise
        self.size += written

    def _take_back(self) -> None:
        self._output.truncate(self.size)
        self._output.seek(self.size)
        self._torn = False


def _written(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    written: bytes = builder.end()  # type: ignore[no-untyped-call]
    return written
