"""Makes a torn or damaged recording a whole one, which any MCAP reader reads; the original stays as it is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

import msgspec
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from microdrivers.recording.header import (
    CLOCK_RECORD,
    HEADER_RECORD,
    PROFILE,
    REPAIR_RECORD,
    ClockMapping,
    from_metadata,
    to_metadata,
)
from microdrivers.recording.images import IMAGE_SCHEMA
from microdrivers.recording.mcap_records import MESSAGE, RECORD, read_definition, records_in
from microdrivers.recording.mcap_scan import Loss, McapScan
from microdrivers.recording.mcap_writer import ChannelKey, McapWriter
from microdrivers.recording.opening import LIST_MARK, LOST_BEFORE_REPAIR, open_scan, read_clock_record, read_header
from microdrivers.recording.output import not_writable, refuse_existing, whole_file
from microdrivers.recording.reader import Recording
from microdrivers.recording.schemas import FrameInfo, schema_name


class RepairReport(msgspec.Struct, frozen=True, kw_only=True):
    """What has become of a recording that was repaired.

    Attributes:
        file, out: the original and the repaired one.
        messages: how many messages of which topic were kept.
        losses: what could not be.
        mended: what was damaged and could be made anew.
        backwards: how many messages of which topic were logged before their predecessor, as their log times say.
        flaws: what the original lacked or had wrong otherwise, and the repaired file still does.
        size, lost_bytes: of the original, and how many of these cannot be read.
    """

    file: Path
    out: Path
    messages: Mapping[str, int]
    losses: list[Loss]
    mended: list[Loss]
    backwards: Mapping[str, int]
    flaws: list[str]
    size: int
    lost_bytes: int


def repair(file: Path, out: Path) -> RepairReport:
    """Write all of `file` that is intact to the new file `out`.

    Raises:
        ConfigError: there is no such file, or `out` exists or cannot be written.
        RecordingError: the file is empty, foreign or from a newer version, as for `Recording`.
    """
    scan = open_scan(file)
    try:
        header = read_header(scan)
        read_clock_record(scan)
        refuse_existing(out)
        try:
            with whole_file(out) as part, part.open("w+b", buffering=0) as output:
                writer = McapWriter(
                    output, profile=PROFILE, library="microdrivers repair",
                    compress_images=any(place.compressed for place in scan.chunks),
                )  # fmt: skip
                copy = _Copy(scan, writer)
                copy.run(to_metadata(header))
                refuse_existing(out)
        except OSError as error:
            raise not_writable(out, error) from error
    finally:
        scan.close()
    return RepairReport(
        file=file, out=out, messages=dict(copy.messages), losses=copy.losses, mended=copy.mended,
        backwards=dict(+copy.backwards), flaws=_flaws(out), size=scan.size, lost_bytes=_lost_bytes(copy.losses),
    )  # fmt: skip


def _flaws(repaired: Path) -> list[str]:
    with Recording(repaired) as recording:
        return [flaw for flaw in recording.flaws if not flaw.startswith(LOST_BEFORE_REPAIR)]


def _lost_bytes(losses: Iterable[Loss]) -> int:
    """How many they are; some overlap."""
    lost = end = 0
    for offset, size, _ in sorted(losses):
        lost += max(offset + size, end) - max(offset, end)
        end = max(offset + size, end)
    return lost


class _Copy:
    """The way of all intact records from one file to another."""

    def __init__(self, scan: McapScan, writer: McapWriter) -> None:
        self.messages: Counter[str] = Counter()
        self.mended: list[Loss] = []
        self.backwards: Counter[str] = Counter()
        self._scan = scan
        self._writer = writer
        self._schemas: dict[int, Schema] = dict(scan.schemas)
        self._channels: dict[int, Channel] = dict(scan.channels)
        self._damaged: list[Loss] = []
        self._undefined = 0
        self._last_ns: dict[int, int] = {}

    @property
    def losses(self) -> list[Loss]:
        """What of the original could not be kept."""
        undefined = Loss(0, 0, f"{self._undefined} messages of channels whose definition is lost")
        damaged = [*self._scan.losses, *self._damaged, *([undefined] if self._undefined else [])]
        return [*self._scan.unreadable, *sorted(damaged)]

    def run(self, header: Mapping[str, str]) -> None:
        """Copy everything, and end the file."""
        self._writer.add_metadata(HEADER_RECORD, header)
        for record in self._scan.metadata:
            is_damaged = record.name == CLOCK_RECORD and from_metadata(record.metadata, ClockMapping) is None
            if record.name != HEADER_RECORD and not is_damaged:
                self._writer.add_metadata(record.name, record.metadata)
        for attachment in self._scan.attachments:
            self._writer.add_attachment(
                attachment.name, attachment.media_type, attachment.data, log_ns=attachment.log_time
            )
        for place in self._scan.chunks:
            chunk = self._scan.read_chunk(place)
            if isinstance(chunk, Loss):
                self._damaged.append(chunk)
            else:
                self.mended += self._scan.contradictions(place, chunk)
                self._copy_chunk(chunk)
        self._writer.flush()
        self._writer.add_metadata(REPAIR_RECORD, {"losses": LIST_MARK.join(map(str, self.losses))})
        self._writer.finish()

    def _copy_chunk(self, chunk: bytes) -> None:
        for opcode, start, end in records_in(chunk):
            if opcode == Opcode.MESSAGE:
                self._copy_message(chunk, start, end)
                continue
            record = read_definition(opcode, chunk[start:end])
            if isinstance(record, Schema):
                self._schemas[record.id] = record
            elif isinstance(record, Channel):
                self._channels[record.id] = record

    def _copy_message(self, chunk: bytes, start: int, end: int) -> None:
        _, _, number, sequence, log_ns, publish_ns = MESSAGE.unpack_from(chunk, start - RECORD.size)
        channel = self._channels.get(number)
        schema = self._schemas.get(channel.schema_id) if channel is not None else None
        if channel is None or schema is None:
            self._undefined += 1
            return
        body = start + MESSAGE.size - RECORD.size
        new = self._writer.channel(ChannelKey(channel.topic, schema.name, schema.data))
        self.messages[channel.topic] += 1
        self.backwards[channel.topic] += log_ns < self._last_ns.get(new, 0)
        self._last_ns[new] = log_ns
        if schema.name == schema_name(FrameInfo):
            self._writer.flush()
        if schema.name == IMAGE_SCHEMA:
            self._writer.add_image(
                new, b"", memoryview(chunk)[body:end], sequence=sequence, log_ns=log_ns, publish_ns=publish_ns
            )
        else:
            self._writer.add_message(new, chunk[body:end], sequence=sequence, log_ns=log_ns, publish_ns=publish_ns)
