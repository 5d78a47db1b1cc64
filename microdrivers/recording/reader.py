"""Reads recordings, whole, torn or damaged: what is intact is delivered, what is not is told."""

from __future__ import annotations

import os
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
from microdrivers.recording.channels import ARRIVALS_TOPIC, PATTERN, matches
from microdrivers.recording.mcap_records import MESSAGE, MESSAGE_BEGIN, RECORD, read_definition
from microdrivers.recording.mcap_scan import NOT_ENDED, ChunkPlace, Loss
from microdrivers.recording.opening import open_scan, read_clock_record, read_header, told_losses
from microdrivers.recording.recorded_channels import (
    Action,
    ChannelReader,
    FrameJoin,
    Stamps,
    Unreadable,
    channel_reader,
)
from microdrivers.recording.survey import Survey, TopicSummary, unexplained_gaps

__all__ = ["Recording", "TopicSummary"]

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

    def __init__(self, file: str | os.PathLike[str]) -> None:
        self.file = Path(file)
        self._scan = open_scan(self.file)
        self._told = list(told_losses(self._scan))
        self.complete = self._scan.complete and not any(NOT_ENDED in loss.what for loss in self._told)
        self.header = read_header(self._scan)
        self.clock = read_clock_record(self._scan)
        self._damaged: dict[int, Loss] = {}
        self._unreadable: dict[tuple[int, int], str] = {}
        self._frames: dict[int, tuple[str, Stamps]] = {}
        """Topic and stamps of frames that were read, by the place of a chunk that holds nothing else."""

    def samples(
        self, topics: Collection[str] | None = None, *, leave_out: Collection[str] = (), required: bool = True
    ) -> Iterator[tuple[str, Sample]]:
        """Topic and sample, in recorded order; frames with their images.

        `topics` and `leave_out` may hold patterns: `truth/*`.

        Each call reads the file anew. What cannot be read is left out, and is told by `losses`.

        Raises:
            ConfigError: `topics` or `leave_out` is one text; or, at the end, one of `topics` that is no pattern is
                `required` and not in the recording.
        """
        for names in (topics, leave_out):
            if isinstance(names, str):
                raise ConfigError(
                    f"names of topics must be several, not one text, {names!r}", remedy=f"give [{names!r}]"
                )
        topics, leave_out = None if topics is None else tuple(topics), tuple(leave_out)
        seen: set[str] = set()

        def take(reader: ChannelReader) -> Action[Sample]:
            seen.add(reader.topic)
            return reader.take

        found = chain.from_iterable(self._walk(topics, take, leave_out=leave_out))
        return chain(found, self._check_seen(topics, seen)) if topics is not None and required else found

    def _check_seen(self, topics: Collection[str], seen: Collection[str]) -> Iterator[tuple[str, Sample]]:
        """Yields nothing; refuses names that no topic had."""
        for name in topics:
            if not PATTERN & set(name) and name not in seen and name not in self.topics:
                raise ConfigError(
                    f"{self.file} has no topic {name!r}",
                    remedy=f"give one of {', '.join(map(repr, self.topics))}, or a pattern such as 'truth/*'",
                )
        yield from ()

    @cached_property
    def _arrivals(self) -> Mapping[str, Sequence[int]]:
        notes = Survey()
        for _ in self._walk((ARRIVALS_TOPIC,), notes.counter):
            pass
        return notes.arrivals

    @cached_property
    def topics(self) -> Mapping[str, TopicSummary]:
        """What there is of each topic; the first look at it reads all of the file."""
        survey = Survey()
        for _ in self._walk(None, survey.counter, known_frame=survey.count_frame):
            pass
        return survey.topics()

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
        _ = self.topics  # reads all
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
    def skipped(self) -> list[str]:
        """What is not there for no reason that is known, by topic; the first look at it reads all of the file."""
        return [] if self.losses else unexplained_gaps(self.topics)

    @property
    def flaws(self) -> list[str]:
        """What whoever uses the recording should be told; the first look at it reads all of the file.

        That is all that cannot be read, is not there or was lost by the recorder, and samples that are repeated, or out
        of order of time.
        """
        told = [*(f"not readable: {loss}" for loss in self._damage), *map(str, self._told), *self.drops, *self.skipped]
        for name, topic in self.topics.items():
            if topic.repeated:
                told.append(f"repeated: {topic.repeated} samples of {name!r} stand in the file once more")
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
        known_frame: Callable[[str, Stamps], None] | None = None,
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
                    self._frames[place.offset] = topic, Stamps(found.t_ns, found.seq, found.order)
        return made


def _holds_an_unwanted_image(place: ChunkPlace, actions: Mapping[int, object | None]) -> bool:
    """Whether the chunk holds nothing but an image and its info, and neither is asked for."""
    numbers = list(place.holds.items())
    return len(numbers) == 2 and all(count == 1 and actions.get(number, place) is None for number, count in numbers)
