"""Writes MCAP in chunks, for a writer that may be killed at any moment and a disk that may be full.

The library's writer copies a frame five times and a sample costs it 20 µs; this one hands frames to the operating
system where they lie. What reaches the file is whole chunks: one that cannot be written is taken back.
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import zstandard
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Channel, Header, Metadata, MetadataIndex, Schema, Statistics

from microdrivers.recording.mcap_records import CHUNK, MAGIC, RECORD, Written, end_of_file, message_record, written

_CHUNK_BYTES = 64 * 1024
_ZSTD = "zstd"
_ZSTD_LEVEL = 1
_Part = bytes | bytearray | memoryview
_U64 = struct.Struct("<Q")


class Output(Protocol):
    """An unbuffered file that can be taken back to an earlier size, and read."""

    def write(self, data: bytes | memoryview, /) -> int | None:
        """Write some of it; tells how much."""

    def read(self, size: int, /) -> bytes | None:
        """So much of it, or less at its end."""

    def truncate(self, size: int, /) -> int:
        """Cut off what is behind `size`."""

    def seek(self, offset: int, whence: int = ..., /) -> int:
        """Write there next, and tell where that is; `whence` 2: counted from the end."""


class ChannelKey(NamedTuple):
    """A channel and its schema."""

    topic: str
    schema_name: str
    schema: bytes


_Message = tuple[int, int, bytes, memoryview | None]
"""Channel, log time, its record, and what of that is kept elsewhere: pixels."""


class _Chunk:
    """Messages that wait to be written together, and how many bytes they are."""

    __slots__ = ("messages", "size")

    def __init__(self) -> None:
        self.messages: list[_Message] = []
        self.size = 0


class _Held(NamedTuple):
    """What the file holds, whole records alone, and what is to come.

    One assignment replaces all of it, so that no interruption, wherever it comes, leaves half of a change.

    Attributes:
        size: of the file, bytes.
        written: how many of the records that the writer knows are in the file.
        counts: messages by channel; a channel that is not in it has not been defined in the file.
        first_ns, last_ns: earliest and latest log time.
        chunk: waits to be written.
    """

    size: int
    written: int
    counts: Mapping[int, int]
    first_ns: int | None
    last_ns: int
    chunk: _Chunk


class McapWriter:
    """Writes one file. `compress_images` compresses each chunk that holds an image, without loss (zstd).

    An interruption (`KeyboardInterrupt`) may come at any moment: what has not reached the file by then is written with
    the next chunk.

    Attributes:
        disturbed: whether, before a write, the file was not as it was left: another program has written to it.

    Raises:
        OSError: the file's first record cannot be written.
    """

    def __init__(self, output: Output, *, profile: str, library: str, compress_images: bool = False) -> None:
        self.disturbed = False
        self._output = output
        self._torn = False
        self._compress_images = compress_images
        self._channels: dict[ChannelKey, Channel] = {}
        self._schemas: dict[tuple[str, bytes], Schema] = {}
        self._definitions: dict[int, bytes] = {}
        self._written: list[Written] = []
        self._held = _Held(0, 0, {}, None, 0, _Chunk())
        self._write([MAGIC, written(Header(profile, library))])

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._held.size

    @property
    def written(self) -> Sequence[Written]:
        """What is in the file, in its order, header and summary aside."""
        return self._written[: self._held.written]

    def count(self, channel: int) -> int:
        """How many messages of the channel are in the file."""
        return self._held.counts.get(channel, 0)

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
            self._definitions[known.id] = written(schema) + written(known)
            self._channels[key] = known
        return known.id

    def add_message(self, channel: int, data: bytes, *, sequence: int, log_ns: int, publish_ns: int) -> None:
        """Add a message to the present chunk.

        Raises:
            OSError: the chunk is full now and could not be written, as with `flush`.
        """
        record = message_record(channel, data, 0, sequence, log_ns, publish_ns)
        chunk = self._held.chunk
        chunk.messages.append((channel, log_ns, record, None))
        chunk.size += len(record)
        if chunk.size > _CHUNK_BYTES:
            self.flush()

    def add_image(
        self,
        channel: int,
        head: bytes,
        pixels: memoryview,
        *,
        sequence: int,
        log_ns: int,
        publish_ns: int,
        info: tuple[int, bytes] | None = None,
    ) -> None:
        """Add an image, of whose message `pixels` is the last part, and write it at once.

        `info` is channel and data of a message that goes right before it, with the same stamps. After a `flush`, both
        have a chunk of their own: a reader can leave images out.

        Raises:
            OSError: the chunk could not be written, as with `flush`.
        """
        messages: list[_Message] = []
        if info is not None:
            messages.append((info[0], log_ns, message_record(*info, 0, sequence, log_ns, publish_ns), None))
        record = message_record(channel, head, pixels.nbytes, sequence, log_ns, publish_ns)
        messages.append((channel, log_ns, record, pixels))
        self._held.chunk.messages += messages
        self.flush(compression=_ZSTD if self._compress_images else "")

    def flush(self, *, compression: str = "") -> None:
        """Write the present chunk, if there is anything in it.

        Raises:
            OSError: it could not be written, and its messages are lost; the file is as it was before.
        """
        if not self._held.chunk.messages:
            return
        try:
            self._write_chunk(self._held.chunk.messages, compression)
        except Exception:
            self._held = self._held._replace(chunk=_Chunk())
            raise

    def _write_chunk(self, messages: list[_Message], compression: str) -> None:
        held = self._held
        parts, size, index = self._laid_out(messages)
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
        length = CHUNK.size - RECORD.size + len(name) + 8 + stored
        head = CHUNK.pack(Opcode.CHUNK, length, first_ns, last_ns, size, crc, len(name)) + name + _U64.pack(stored)
        offset, offsets, indexes = held.size + RECORD.size + length, bytearray(), bytearray()
        for channel, entries in index.items():
            offsets += struct.pack("<HQ", channel, offset + len(indexes))
            entries_size = 8 * len(entries)
            indexes += struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + entries_size, channel, entries_size)
            indexes += struct.pack(f"<{len(entries)}Q", *entries)
        body = b"".join((
            struct.pack("<QQQQI", first_ns, last_ns, held.size, RECORD.size + length, len(offsets)), offsets,
            struct.pack("<QI", len(indexes), len(name)), name, struct.pack("<QQ", stored, size),
        ))  # fmt: skip
        self._write(
            [head, *parts, indexes], Written(RECORD.pack(Opcode.CHUNK_INDEX, len(body)) + body, held.size, head),
            counts={**held.counts, **{number: self.count(number) + len(index[number]) // 2 for number in index}},
            first_ns=first_ns if held.first_ns is None else min(held.first_ns, first_ns),
            last_ns=max(held.last_ns, last_ns), chunk=_Chunk(),
        )  # fmt: skip

    def _laid_out(self, messages: list[_Message]) -> tuple[list[_Part], int, dict[int, list[int]]]:
        """A chunk's content, its size, and by channel the log time and place of each message."""
        parts: list[_Part] = []
        content = bytearray()
        place = 0
        index: dict[int, list[int]] = {}
        for channel, log_ns, record, pixels in messages:
            entries = index.get(channel)
            if entries is None:
                entries = index[channel] = []
                if channel not in self._held.counts:
                    content += self._definitions[channel]
                    place += len(self._definitions[channel])
            entries += (log_ns, place)
            content += record
            place += len(record)
            if pixels is not None:
                parts += (content, pixels)
                content = bytearray()
                place += pixels.nbytes
        return [*parts, content], place, index

    # ------------------------------------------------------------------ other records

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Write a metadata record at once.

        Raises:
            OSError: it could not be written.
        """
        record = written(Metadata(name=name, metadata=dict(data)))
        index = MetadataIndex(offset=self.size, length=len(record), name=name)
        self._write([record], Written(written(index), index.offset, record))

    def add_attachment(self, name: str, media_type: str, data: bytes, *, log_ns: int) -> None:
        """Write an attachment at once.

        Raises:
            OSError: it could not be written.
        """
        attachment = Attachment(create_time=0, log_time=log_ns, name=name, media_type=media_type, data=data)
        record = written(attachment)
        index = AttachmentIndex(
            offset=self.size, length=len(record), log_time=log_ns, create_time=0, data_size=len(data), name=name,
            media_type=media_type,
        )  # fmt: skip
        self._write([record], Written(written(index), index.offset, record))

    def finish(self) -> None:
        """Write the summary and the end, all chunks having been flushed.

        Raises:
            OSError: it could not be written; the file is then readable as a torn one.
        """
        held = self._held
        indexes: dict[int, list[bytes]] = {
            Opcode.CHUNK_INDEX: [], Opcode.ATTACHMENT_INDEX: [], Opcode.METADATA_INDEX: [],
        }  # fmt: skip
        for record in self.written:
            indexes[record.listing[0]].append(record.listing)
        defined = [channel for channel in self._channels.values() if channel.id in held.counts]
        schemas = {channel.schema_id for channel in defined}
        statistics = Statistics(
            attachment_count=len(indexes[Opcode.ATTACHMENT_INDEX]), channel_count=len(defined),
            channel_message_counts=dict(sorted(held.counts.items())), chunk_count=len(indexes[Opcode.CHUNK_INDEX]),
            message_count=sum(held.counts.values()), metadata_count=len(indexes[Opcode.METADATA_INDEX]),
            message_start_time=held.first_ns or 0, message_end_time=held.last_ns, schema_count=len(schemas),
        )  # fmt: skip
        groups = {
            Opcode.SCHEMA: [written(schema) for schema in self._schemas.values() if schema.id in schemas],
            Opcode.CHANNEL: [written(channel) for channel in defined],
            Opcode.STATISTICS: [written(statistics)],
            **indexes,
        }
        self._write([end_of_file(groups, offset=held.size)])

    def _write(self, parts: list[_Part], *records: Written, **changes: Any) -> None:
        """Write all of it or nothing; with its last byte, `changes` of what is held count."""
        self._see_that_nobody_else_writes()
        if self._torn:
            self._take_back()
        del self._written[self._held.written :]
        self._written += records
        self._torn = True
        size = self._held.size
        try:
            for part in parts:
                rest = memoryview(part)
                while rest.nbytes:
                    count = self._output.write(rest) or 0
                    rest = rest[count:]
                    size += count
            self._held = self._held._replace(size=size, written=len(self._written), **changes)
            self._torn = False
        except BaseException:  # also an interruption
            with contextlib.suppress(OSError):  # it is tried again before the next write
                self._take_back()
            raise

    def _see_that_nobody_else_writes(self) -> None:
        """Look at the file's size, and at what was written last; a program that cuts it off may do so at any moment."""
        if not self.disturbed:
            size = self._output.seek(0, os.SEEK_END)
            self.disturbed = size < self.size or (size > self.size and not self._torn)
            for record in self._written[: self._held.written][-1:]:
                self._output.seek(record.offset)
                self.disturbed |= self._output.read(len(record.head)) != record.head
        self._output.seek(self.size)

    def _take_back(self) -> None:
        self._output.truncate(self.size)
        self._output.seek(self.size)
        self._torn = False
