"""Reads recordings, whole, torn or damaged: what is intact is delivered, what is not is told."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from microdrivers.core.errors import ConfigError
from microdrivers.core.samples import Frame, Sample
from microdrivers.recording.channels import ARRIVALS_TOPIC, matches
from microdrivers.recording.errors import EmptyRecording, ForeignRecording, FutureRecording
from microdrivers.recording.header import (
    CLOCK_RECORD,
    FAILURE_RECORD,
    HEADER_RECORD,
    PROFILE,
    REPAIR_RECORD,
    SCHEMA_VERSION,
    ClockMapping,
    RecordingHeader,
    from_metadata,
)
from microdrivers.recording.mcap_records import MESSAGE, MESSAGE_BEGIN, RECORD
from microdrivers.recording.mcap_scan import NOT_ENDED, ChunkPlace, Loss, McapScan, read_definition
from microdrivers.recording.recorded_channels import Action, ChannelReader, FrameJoin, Unreadable, channel_reader
from microdrivers.recording.survey import Survey, TopicSummary

__all__ = ["Recording", "TopicSummary"]

LIST_MARK = "; "
"""Between the losses in a repaired file's metadata."""

FoundT = TypeVar("FoundT")


class _Wanted(NamedTuple, Generic[FoundT]):
    """A channel whose messages are asked for, and what is made of them."""

    topic: str
    is_image: bool
    act: Action[FoundT]


class Recording:
    """A recording that was opened; its samples are read as they are asked for.

    Attributes:
        header: where it comes from. clock: how its times relate to the calendar's, as the last record of it that is
            intact says; None if none is.
        complete: whether it was ended; if not, its writer was killed or the file was cut off, perhaps before a repair.

    Raises:
        ConfigError: there is no such file, or it may not be read.
        EmptyRecording: the file is empty or holds no complete record.
        ForeignRecording: it is not MCAP, or not from microdrivers.
        FutureRecording: a newer version wrote it.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self._scan = open_scan(file)
        self._told = list(_told_losses(self._scan))
        self.complete = self._scan.complete and not any(NOT_ENDED in loss.what for loss in self._told)
        self.header = read_header(self._scan)
        self.clock = read_clock_record(self._scan)
        self._damaged: dict[int, Loss] = {}
        self._unreadable: dict[tuple[int, int], str] = {}
        self._survey: Survey | None = None
        self._frames: dict[int, tuple[str, int, int]] = {}
        """Topic, `t_ns` and `seq` of frames that were read, by the place of a chunk that holds nothing else."""

    def samples(
        self, topics: Collection[str] | None = None, *, leave_out: Collection[str] = ()
    ) -> Iterator[tuple[str, Sample]]:
        """Topic and sample, in recorded order; frames with their images.

        `topics` and `leave_out` may hold patterns: `truth/*`.

        Each call reads the file anew. What cannot be read is left out, and is told by `losses`.
        """
        return chain.from_iterable(self._walk(topics, lambda reader: reader.take, leave_out=leave_out))

    def _read_all(self) -> Survey:
        """What the file holds; once it has been read, what is damaged of it is known."""
        if self._survey is None:
            survey = Survey()
            for _ in self._walk(None, survey.counter, known_frame=survey.count_frame):
                pass
            self._survey = survey
        return self._survey

    @cached_property
    def _arrivals(self) -> Mapping[str, Sequence[int]]:
        notes = Survey()
        for _ in self._walk((ARRIVALS_TOPIC,), notes.counter):
            pass
        return notes.arrivals

    @property
    def topics(self) -> Mapping[str, TopicSummary]:
        """What there is of each topic; the first look at it reads all of the file."""
        return self._read_all().topics()

    @property
    def arrivals(self) -> Mapping[str, Sequence[int]]:
        """Order numbers of the samples in the order in which each estimator's inbox got them, by host.

        Of a recording that was not ended, the last ones may be of samples that it does not hold.
        """
        return self._arrivals

    @property
    def attachments(self) -> Mapping[str, bytes]:
        """Attached files by name; the last one of a name counts."""
        return {attachment.name: attachment.data for attachment in self._scan.attachments}

    @property
    def losses(self) -> list[Loss]:
        """All that cannot be read, damaged or cut off, and what the file itself tells of that.

        The latter is what was lost before a repair, or that its disk ended it. The first look at it reads all of the
        file.
        """
        return [*self._damage, *self._told]

    @property
    def _damage(self) -> list[Loss]:
        self._read_all()
        what = Counter(self._unreadable.values())
        unreadable = [Loss(0, 0, f"{count} × {text}") for text, count in what.items()]
        return [*self._scan.unreadable, *sorted([*self._scan.losses, *self._damaged.values()]), *unreadable]

    def check_indexes(self) -> list[Loss]:
        """What is damaged of the times and places that other programs find samples by; reads all of the file.

        No sample that is read here depends on it; a repair makes it anew.
        """
        chunks = ((place, self._scan.read_chunk(place)) for place in self._scan.chunks)
        return [
            loss for place, chunk in chunks if isinstance(chunk, bytes)
            for loss in self._scan.contradictions(place, chunk)
        ]  # fmt: skip

    @property
    def drops(self) -> list[str]:
        """What the recorder itself has lost, by topic; the first look at it reads all of the file."""
        return [
            f"not recorded: {topic.dropped} samples of {name!r}, which the recorder had to drop"
            for name, topic in self.topics.items()
            if topic.dropped
        ]

    @property
    def flaws(self) -> list[str]:
        """What whoever uses the recording should be told; the first look at it reads all of the file.

        That is all that cannot be read, what the recorder itself has lost, and samples out of the order of time.
        """
        told = [*(f"not readable: {loss}" for loss in self._damage), *map(str, self._told), *self.drops]
        for name, topic in self.topics.items():
            if topic.unsorted:
                told.append(f"out of order: {topic.unsorted} samples of {name!r} are older than their predecessor")
        return told

    def close(self) -> None:
        """Close the file; no samples can be read after it."""
        self._scan.close()

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ------------------------------------------------------------------ messages

    def _walk(
        self,
        topics: Collection[str] | None,
        action: Callable[[ChannelReader], Action[FoundT]],
        *,
        leave_out: Collection[str] = (),
        known_frame: Callable[[str, int, int], None] | None = None,
    ) -> Iterator[list[tuple[str, FoundT]]]:
        """By chunk: topic, and what the channel's action makes of each message of the wanted topics, if anything.

        Frames that were read before go to `known_frame`, if there is one, and are not read again.
        """
        actions: dict[int, _Wanted[FoundT] | None] = {}
        schemas: dict[int, Schema] = dict(self._scan.schemas)
        joins: dict[str, FrameJoin] = {}
        defined: dict[int, tuple[Channel, Schema | None]] = {}

        def define(channel: Channel) -> None:
            definition = channel, schemas.get(channel.schema_id)
            if defined.get(channel.id) == definition:
                return  # the summary's, again with its first message
            defined[channel.id] = definition
            reader = channel_reader(channel, schemas.get(channel.schema_id), joins)
            wanted = matches(reader.topic, topics) and not matches(reader.topic, leave_out)
            actions[channel.id] = _Wanted(reader.topic, reader.is_image, action(reader)) if wanted else None

        def define_with(record: Schema | Channel | None) -> None:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                define(record)

        for channel in self._scan.channels.values():
            define(channel)
        for place in self._scan.chunks:
            if _holds_an_unwanted_image(place, actions):
                continue
            if known_frame is not None and place.offset in self._frames:
                known_frame(*self._frames[place.offset])
                continue
            chunk = self._scan.read_chunk(place)
            if isinstance(chunk, Loss):
                self._damaged[place.offset] = chunk
            else:
                yield self._read_messages(place, chunk, actions, define_with)

    def _read_messages(
        self,
        place: ChunkPlace,
        chunk: bytes,
        actions: Mapping[int, _Wanted[FoundT] | None],
        define: Callable[[Schema | Channel | None], None],
    ) -> list[tuple[str, FoundT]]:
        """What is made of a chunk's messages; its definitions go to `define`."""
        made: list[tuple[str, FoundT]] = []
        records = 0
        head, body = MESSAGE_BEGIN.unpack_from, MESSAGE.size
        position, last = 0, len(chunk) - MESSAGE_BEGIN.size
        while position <= last:
            start = position
            opcode, length, number, sequence = head(chunk, start)
            position = end = start + RECORD.size + length
            records += 1
            if opcode != Opcode.MESSAGE:
                define(read_definition(opcode, chunk[start + RECORD.size : end]))
                continue
            try:
                wanted = actions[number]
            except KeyError:
                self._unreadable[place.offset, start] = "a message of a channel whose definition is lost"
                continue
            if wanted is None:
                continue
            topic, is_image, act = wanted
            try:
                found = act(memoryview(chunk)[start + body : end] if is_image else chunk[start + body : end], sequence)
            except Unreadable as error:
                self._unreadable[place.offset, start] = str(error)
                continue
            if found is not None:
                made.append((topic, found))
                if isinstance(found, Frame) and records == 2 and position == len(chunk):  # its info and its image
                    self._frames[place.offset] = topic, found.t_ns, found.seq
        return made


def open_scan(file: Path) -> McapScan:
    """The intact records of a file.

    Raises:
        ConfigError: there is no such file, or it may not be read.
    """
    try:
        return McapScan(file)
    except OSError as error:
        raise ConfigError(
            f"the recording cannot be read: {error.strerror}", file=str(file), remedy="check the path"
        ) from error


def _told_losses(scan: McapScan) -> Iterator[Loss]:
    """What the file's metadata tell of losses."""
    for record in scan.metadata:
        if record.name == REPAIR_RECORD and (losses := record.metadata.get("losses")):
            yield from (Loss(0, 0, f"lost before the repair: {loss}") for loss in losses.split(LIST_MARK))
        elif record.name == FAILURE_RECORD:
            reason = record.metadata.get("reason", "unknown")
            yield Loss(0, 0, f"the recording was stopped because it could not be written: {reason}")


def _holds_an_unwanted_image(place: ChunkPlace, actions: Mapping[int, object | None]) -> bool:
    """Whether the chunk holds nothing but an image and its info, and neither is asked for."""
    numbers = list(place.holds.items())
    return len(numbers) == 2 and all(count == 1 and actions.get(number, place) is None for number, count in numbers)


def read_clock_record(scan: McapScan) -> ClockMapping | None:
    """The last record of the clock that is intact; of others a loss is told."""
    records = [record.metadata for record in scan.metadata if record.name == CLOCK_RECORD]
    read = [from_metadata(data, ClockMapping) for data in records]
    intact = [clock for clock in read if clock is not None]
    if len(intact) < len(read):
        known = "another one is intact" if intact else "how its times relate to the calendar's is not known"
        end = " of its end" if intact and read[-1] is None else ""
        scan.losses.append(Loss(0, 0, f"the recording's clock record{end} is damaged: {known}"))
    return intact[-1] if intact else None


def read_header(scan: McapScan) -> RecordingHeader:
    """The recording's header, if the file is one.

    Raises:
        EmptyRecording, ForeignRecording, FutureRecording: it cannot be read as one.
    """
    file = scan.file
    if scan.size == 0:
        raise EmptyRecording(f"{file} is empty", remedy="record anew: nothing was written to it")
    records = [record.metadata for record in scan.metadata if record.name == HEADER_RECORD]
    headers = [header for data in records if (header := from_metadata(data, RecordingHeader)) is not None]
    if headers:
        _check_version(file, headers[0].schema_version, headers[0].microdrivers)
        if len(headers) < len(records):
            scan.losses.append(Loss(0, 0, "one of the recording's headers is damaged: another one is intact"))
        return headers[0]
    for data in records:
        number = data.get("schema_version", "")
        _check_version(file, int(number) if number.isdecimal() else 0, data.get("microdrivers", ""))
    if scan.profile == PROFILE and scan.chunks:
        scan.losses.append(Loss(0, 0, "the recording's header is damaged: who made it is not known"))
        return RecordingHeader(source="recorded")
    if scan.profile == PROFILE or (scan.has_magic and scan.profile is None and not scan.chunks):
        raise EmptyRecording(f"{file} ends before its first complete record", remedy="record anew")
    what = "an MCAP file, but microdrivers did not write it" if scan.has_magic else "no MCAP file"
    raise ForeignRecording(f"{file} is {what}", remedy="name a file that `microdrivers record` has written")


def _check_version(file: Path, number: int, writer: str) -> None:
    if number > SCHEMA_VERSION:
        raise FutureRecording(
            f"{file} has schema version {number}; this microdrivers reads up to {SCHEMA_VERSION}",
            remedy=f"install microdrivers {writer or 'as it wrote the file'} or newer",
        )
