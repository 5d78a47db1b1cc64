"""Finds what is intact in an MCAP file, however it was torn or damaged.

All that a chunk holds is covered by its CRC. The records around it are not: their lengths are checked against each
other, and where they contradict, the next chunk that is intact is searched for.
"""

from __future__ import annotations

import contextlib
import os
import re
import struct
import weakref
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import zstandard
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Schema

from microdrivers.recording.mcap_records import CHUNK, MAGIC, MESSAGE, RECORD, parsed, records_in, written
from microdrivers.recording.mcap_summary import Summary, find_end, read_footer, read_summary

NOT_ENDED = "the recording was not ended"
_END_MISSING = f"{NOT_ENDED}: at most its last 0.1 s are missing if its program was killed, more if its disk was full"

_NO_SUMMARY = "the file's summary is damaged or cut off"
_DATA_END_SIZE = 4
_FOLLOWED = "the recording has its end here, but something follows it, which is not read"
_INDEX = struct.Struct("<BQHI")
_BLOCK_BYTES = 1 << 20
_WINDOW_BYTES = 2048
_LONGEST_CHUNK = 1 << 32
_COMPRESSIONS = (b"", b"lz4", b"zstd")
_CHUNK_PATTERN = re.compile(rb"\x06(?=.{36}(?:\x00{4}|\x03\x00{3}lz4|\x04\x00{3}zstd))", re.DOTALL)
_LOOKAHEAD = CHUNK.size + 12
_PAGE_BYTES = 4096
"""So much of a file an operating system reads or fails to read at once."""
_BETWEEN_CHUNKS = frozenset({Opcode.HEADER, Opcode.METADATA, Opcode.ATTACHMENT})
_OTHERS = frozenset({
    Opcode.HEADER, Opcode.FOOTER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT, Opcode.DATA_END,
})  # fmt: skip


class Loss(NamedTuple):
    """A part of a file that cannot be read.

    Attributes:
        offset, size: where it is, bytes.
        what: what is wrong with it.
    """

    offset: int
    size: int
    what: str

    def covers(self, offset: int) -> bool:
        """Whether that byte is part of it."""
        return self.offset <= offset < self.offset + self.size

    def __str__(self) -> str:
        return f"{self.what} ({self.size} bytes at byte {self.offset})" if self.size else self.what


class ChunkPlace(NamedTuple):
    """Where a chunk is; `holds`: how many messages of which channel, as its index says, which nothing vouches for."""

    offset: int
    length: int
    holds: dict[int, int]
    compressed: bool


class McapScan:
    """The intact records of a file; chunks are read and checked one by one as they are asked for.

    Attributes:
        profile: of the file's header record; None if that is damaged.
        complete: whether the file has its end, a summary aside.
        chunks: in the order of the file. channels, schemas: those of its summary, by number.
        losses: what is damaged outside of chunks.

    Raises:
        OSError: there is no such file, or its very beginning cannot be read.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self.profile: str | None = None
        self.complete = False
        self.chunks: list[ChunkPlace] = []
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        self.losses: list[Loss] = []
        self._unreadable: dict[int, str] = {}
        self._records: dict[int, Metadata | Attachment] = {}
        self._stream = file.open("rb", buffering=0)
        self._close = weakref.finalize(self, self._stream.close)
        self.size = self._end = os.fstat(self._stream.fileno()).st_size
        self.has_magic = os.pread(self._stream.fileno(), len(MAGIC), 0) == MAGIC
        if not self.has_magic and self.size:
            self.losses.append(Loss(0, len(MAGIC), "the file does not begin as an MCAP file does"))
        self._scan()
        self._read_summary()

    def close(self) -> None:
        """No chunk can be read after it."""
        self._close()

    @property
    def metadata(self) -> list[Metadata]:
        """In the order of the file."""
        return [record for record in self._records.values() if isinstance(record, Metadata)]

    @property
    def attachments(self) -> list[Attachment]:
        """In the order of the file."""
        return [record for record in self._records.values() if isinstance(record, Attachment)]

    @property
    def unreadable(self) -> list[Loss]:
        """What the disk does not give, as far as the file has been read; what that has damaged is told besides."""
        ranges: list[tuple[int, int, str]] = []
        for page, why in sorted(self._unreadable.items()):
            begin = ranges.pop()[0] if ranges and ranges[-1][1:] == (page, why) else page
            ranges.append((begin, page + _PAGE_BYTES, why))
        return [Loss(0, 0, f"{end - begin} bytes at byte {begin} cannot be read: {why}") for begin, end, why in ranges]

    def read_chunk(self, place: ChunkPlace) -> bytes | Loss:
        """A chunk's records, or what is wrong with it."""
        head = self._read(place.offset, _LOOKAHEAD)
        if len(head) < CHUNK.size:
            return Loss(place.offset, len(head), "the file ends in the middle of a chunk")
        *_, size, crc, name_size = CHUNK.unpack_from(head)
        skipped = CHUNK.size + name_size + 8
        data = self._read(place.offset + skipped, place.length - skipped)
        if name_size:
            try:
                data = _decompressed(data, head[CHUNK.size : CHUNK.size + name_size], size)
            except (zstandard.ZstdError, RuntimeError):
                return Loss(place.offset, place.length, "a compressed chunk is damaged")
        if len(data) != size or zlib.crc32(data) != crc:
            return Loss(place.offset, place.length, "a chunk is damaged: its CRC does not match")
        return data

    def begins_with(self, place: ChunkPlace, head: bytes) -> bool:
        """Whether the chunk does."""
        return self._read(place.offset, len(head)) == head

    def contradictions(self, place: ChunkPlace, chunk: bytes) -> list[Loss]:
        """What the chunk's header and its indexes, which no CRC covers, say otherwise than the intact chunk itself."""
        index: dict[int, list[int]] = {}
        position, last = 0, len(chunk) - MESSAGE.size
        while position <= last:
            opcode, length, channel, _, log_ns, _ = MESSAGE.unpack_from(chunk, position)
            if opcode == Opcode.MESSAGE:
                index.setdefault(channel, []).extend((log_ns, position))
            position += RECORD.size + length
        times = [log_ns for entries in index.values() for log_ns in entries[::2]]
        _, _, *stated, _, _, _ = CHUNK.unpack(self._read(place.offset, CHUNK.size))
        wrong = ["header"] if times and stated != [min(times), max(times)] else []
        after = place.offset + place.length
        held = self._read(after, sum(_INDEX.size + 16 * count for count in place.holds.values()))
        if held and dict(_indexes_in(held)) != index:
            wrong.append("index")
        return [
            Loss(0, 0, f"the {part} of the chunk at byte {place.offset} is damaged; its samples are intact")
            for part in wrong
        ]

    # ------------------------------------------------------------------ the way through the file

    def _read(self, offset: int, size: int) -> bytes:
        """Part of the file; what the disk does not give of it is zero, and told by `unreadable`."""
        with contextlib.suppress(OSError):
            data = os.pread(self._stream.fileno(), size, offset)
            if len(data) == size or offset + len(data) >= self.size:
                return data
        read = bytearray()
        end = min(offset + size, self.size)
        while (place := offset + len(read)) < end:
            page = place - place % _PAGE_BYTES
            try:
                found = os.pread(self._stream.fileno(), end - place, place)
            except OSError as error:
                self._unreadable[page] = error.strerror or str(error)
                found = bytes(min(page + _PAGE_BYTES, end) - place)
            if not found:
                break  # it was cut off meanwhile
            read += found
        return bytes(read)

    def _scan(self) -> None:
        offset = window_start = len(MAGIC)
        window = b""
        while offset < self.size:
            begin = offset - window_start
            if begin + _LOOKAHEAD > len(window):
                window, window_start, begin = self._read(offset, _WINDOW_BYTES), offset, 0
            length = self._take_index(window, begin)
            if length is not None:
                offset += length
                continue
            head = window[begin : begin + _LOOKAHEAD]
            length = self._take_up(head, offset)
            if length is None:
                following = self._next_chunk(offset + 1)
                ends = following == self.size
                what = "the file ends in the middle of a record" if ends else "something is damaged here"
                self.losses.append(Loss(offset, following - offset, what))
                offset = following
            elif head[0] == Opcode.DATA_END:
                self.complete = True
                if self._end < self.size:
                    self.losses.append(Loss(self._end, self.size - self._end, _FOLLOWED))
                return
            else:
                offset += length

    def _take_up(self, head: bytes, offset: int) -> int | None:
        """Take up the record that begins with `head`; its whole length, None if that is not known."""
        opcode, length = head[0], self._plausible(head, offset)
        if opcode in _BETWEEN_CHUNKS and len(head) >= RECORD.size:
            return self._other_record(opcode, offset, length)
        if length is None:
            return None
        if opcode == Opcode.CHUNK:
            self.chunks.append(ChunkPlace(offset, length, {}, compressed=head[CHUNK.size - 4] > 0))
            return length
        end = find_end(self._read, offset + length, self.size)
        self._end = end or self.size
        return None if end is None else length

    def _take_index(self, window: bytes, begin: int) -> int | None:
        """Take up the message index there, most of a file's records; its length, None if there is none."""
        if len(window) < begin + _INDEX.size or window[begin] != Opcode.MESSAGE_INDEX or not self.chunks:
            return None
        length: int
        _, length, channel, entries_size = _INDEX.unpack_from(window, begin)
        if length != 6 + entries_size or entries_size % 16:
            return None
        self.chunks[-1].holds[channel] = entries_size // 16
        return RECORD.size + length

    def _plausible(self, head: bytes, offset: int) -> int | None:
        """The whole length of the record that begins there, with `head`, if what it says of its size agrees."""
        if len(head) < RECORD.size:
            return None
        opcode, length = RECORD.unpack_from(head)
        agrees = opcode in _OTHERS and (opcode != Opcode.DATA_END or length == _DATA_END_SIZE)
        if opcode == Opcode.CHUNK and len(head) >= CHUNK.size + 8:
            *_, size, _crc, name_size = CHUNK.unpack_from(head)
            if head[CHUNK.size : CHUNK.size + name_size] in _COMPRESSIONS and len(head) >= CHUNK.size + name_size + 8:
                (stored,) = struct.unpack_from("<Q", head, CHUNK.size + name_size)
                agrees = length == CHUNK.size - RECORD.size + name_size + 8 + stored
                agrees = agrees and (stored == size if not name_size else size < _LONGEST_CHUNK)
        return RECORD.size + length if agrees and offset + RECORD.size + length <= self.size else None

    def _other_record(self, opcode: int, offset: int, stated: int | None) -> int | None:
        """Take up what lies between chunks; its length, which its content tells, too; None if it is not known."""
        body = self._read(offset, max(stated or 0, _BLOCK_BYTES))
        record = parsed(opcode, body[RECORD.size :])
        own = len(written(record)) if isinstance(record, Header | Metadata | Attachment) else 0
        agree = own == stated
        length = next((each for each in (own, stated) if each and (agree or self._goes_on(offset + each))), None)
        if isinstance(record, Header) and offset == len(MAGIC):
            self.profile = record.profile
        elif isinstance(record, Metadata) or (isinstance(record, Attachment) and _has_its_crc(body[:own])):
            self._records[offset] = record
        elif length is not None:
            self.losses.append(Loss(offset, length, f"a record of kind {opcode} is damaged"))
            return length
        if length is not None and length != stated:
            self.losses.append(Loss(offset, 0, f"the length of a record of kind {opcode} is damaged, not its content"))
        return length

    def _goes_on(self, offset: int) -> bool:
        """Whether the file ends there, or what may be a record begins."""
        return offset == self.size or self._plausible(self._read(offset, _LOOKAHEAD), offset) is not None

    def _next_chunk(self, offset: int) -> int:
        """Where the next intact chunk begins; the file's size if there is none."""
        while offset < self.size:
            block = self._read(offset, _BLOCK_BYTES + _LOOKAHEAD)
            for found in _CHUNK_PATTERN.finditer(block):
                start = offset + found.start()
                head = self._read(start, _LOOKAHEAD)
                length = self._plausible(head, start) if found.start() < _BLOCK_BYTES else None
                if length is not None and isinstance(
                    self.read_chunk(ChunkPlace(start, length, {}, compressed=False)), bytes
                ):
                    return start
            offset += _BLOCK_BYTES
        return self.size

    def _read_summary(self) -> None:
        """Channels and schemas as the end of the file repeats them, and what it lists that was not found."""
        footer = read_footer(self._read, self._end)
        if footer is None:
            if self.complete:
                self.losses.append(Loss(0, 0, _NO_SUMMARY))
            elif self.size:
                self.losses.append(Loss(self.size, 0, _END_MISSING))
            return
        self.complete = True
        summary = read_summary(self._read, footer, self._end)
        if summary is None:
            self.losses.append(Loss(footer.summary_start, self._end - footer.summary_start, _NO_SUMMARY))
            return
        self.channels, self.schemas = summary.channels, summary.schemas
        self._compare(summary)

    def _compare(self, summary: Summary) -> None:
        """Tell what the summary lists in vain, and leave out what it does not list: that is of another recording."""
        records = {offset: record.name for offset, record in self._records.items()}
        missing = [(offset, 0, f"the record {name!r}") for offset, name in summary.records.items()
                   if records.get(offset) != name]  # fmt: skip
        places = {place.offset for place in self.chunks}
        missing += [(offset, size, "a chunk") for offset, size in summary.chunks.items() if offset not in places]
        for offset, size, what in missing:
            if not any(loss.covers(offset) for loss in self.losses):
                self.losses.append(Loss(offset, size, f"{what} is damaged or missing"))
        others = [place for place in self.chunks if summary.chunks and place.offset not in summary.chunks]
        if others:
            size = sum(place.length for place in others)
            self.losses.append(Loss(others[0].offset, size, f"{len(others)} chunks are of another recording"))
            self.chunks = [place for place in self.chunks if place.offset in summary.chunks]
            self._records = {offset: each for offset, each in self._records.items() if offset in summary.records}


def _has_its_crc(attachment: bytes) -> bool:
    return attachment[-4:] == struct.pack("<I", zlib.crc32(attachment[RECORD.size : -4]))


def _decompressed(data: bytes, compression: bytes, size: int) -> bytes:
    """At most `size` bytes of it.

    Raises:
        ZstdError, RuntimeError: it is damaged.
    """
    if compression == b"zstd":
        return zstandard.decompress(data, size)
    import lz4.frame  # type: ignore[import-untyped]  # other programs compress with it

    found: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data, size)
    return found


def _indexes_in(data: bytes) -> Iterator[tuple[int, list[int]]]:
    """Channel and entries (log time, place in the chunk) of each message index."""
    for _, start, end in records_in(data):
        if end <= len(data):
            (channel,) = struct.unpack_from("<H", data, start)
            yield channel, list(struct.unpack_from(f"<{(end - start - 6) // 8}Q", data, start + 6))
