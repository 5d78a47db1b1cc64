"""A recording as it is written: samples become messages on channels, and what cannot be written is told."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from microdrivers.core.samples import Frame, Sample
from microdrivers.recording.channels import ARRIVALS_TOPIC, DROPS_TOPIC
from microdrivers.recording.codec import Codec, codec_of
from microdrivers.recording.header import (
    CLOCK_RECORD,
    FAILURE_RECORD,
    HEADER_RECORD,
    PROFILE,
    ClockMapping,
    RecordingHeader,
    to_metadata,
)
from microdrivers.recording.images import IMAGE_SCHEMA, INFO_SUFFIX, encode_image, image_schema, info_of
from microdrivers.recording.look_back import is_as_written, messages_left
from microdrivers.recording.mcap_writer import ChannelKey, McapWriter, Output
from microdrivers.recording.schemas import Arrivals, Drops, FrameInfo, schema_data, schema_name


class TopicCount:
    """What has become of a topic's samples so far.

    Attributes:
        taken: how many came to be written. lost: how many of these are not in the file: the disk was full, a value does
            not fit the format, or an interruption came between. refused: how many did not get so far.
        bytes: how many the messages are, also those that a full disk has refused.
    """

    __slots__ = ("bytes", "lost", "refused", "taken")

    def __init__(self) -> None:
        self.taken = self.lost = self.refused = self.bytes = 0

    @property
    def messages(self) -> int:
        """How many were written."""
        return self.taken - self.lost

    @property
    def dropped(self) -> int:
        """How many were not."""
        return self.lost + self.refused

    def __repr__(self) -> str:
        return f"TopicCount(messages={self.messages}, bytes={self.bytes}, dropped={self.dropped})"


class _Channel:
    """One topic's way into the file."""

    __slots__ = ("codec", "count", "image_number", "last_log_ns", "number", "sample_type")

    def __init__(self, sample_type: type[msgspec.Struct]) -> None:
        self.sample_type = sample_type
        self.codec: Codec[Any] = codec_of(FrameInfo if sample_type is Frame else sample_type)
        self.count = TopicCount()
        self.number = 0
        self.image_number = 0
        self.last_log_ns = 0


class SampleFile:
    """Writes one recording; not for several threads at once, `add_topic` excepted.

    What is lost is counted by comparing what was taken with what is in the file: whatever has gone wrong, and wherever
    an interruption came, is found at the next `flush`.

    Args:
        output: the file.
        header, clock: its first records.
        on_misfit: called with a topic, and why a sample of it will not be in the file.
        on_failure: called when samples could not be written.
        compress_images: see `McapWriter`.

    Attributes:
        counts: by topic.

    Raises:
        OSError: the file's beginning cannot be written.
    """

    def __init__(
        self,
        output: Output,
        *,
        header: RecordingHeader,
        clock: ClockMapping,
        on_misfit: Callable[[str, str], object],
        on_failure: Callable[[OSError, str], object],
        compress_images: bool,
    ) -> None:
        self._writer = McapWriter(
            output, profile=PROFILE, library=f"microdrivers {header.microdrivers}", compress_images=compress_images
        )
        self._header = header
        self._clock = clock
        self._on_misfit = on_misfit
        self._on_failure = on_failure
        self.counts: dict[str, TopicCount] = {}
        self._channels: dict[str, _Channel] = {}
        self._noted_arrivals: dict[str, int] = {}
        self._noted_drops: dict[str, int] = {}
        self._notes = {ARRIVALS_TOPIC: _Channel(Arrivals), DROPS_TOPIC: _Channel(Drops)}
        self._writer.add_metadata(HEADER_RECORD, to_metadata(header))
        self._writer.add_metadata(CLOCK_RECORD, to_metadata(clock))

    @property
    def size(self) -> int:
        """Bytes in the file so far."""
        return self._writer.size

    @property
    def disturbed(self) -> bool:
        """Whether another program was seen to write to the file, or to cut it off, while it was written."""
        return self._writer.disturbed

    def add_topic(self, name: str, sample_type: type[Sample]) -> None:
        """Samples of that type will come on topic `name`.

        Raises:
            UnsupportedType: it has a field that has no place in the format.
        """
        channel = _Channel(sample_type)
        self.counts[name] = channel.count
        self._channels[name] = channel

    def write(self, waiting: Iterable[tuple[str, Sample, int]]) -> None:
        """Write samples: topic, sample, and when it was published, ns on the rig's clock."""
        for topic, sample, now_ns in waiting:
            channel = self._channels[topic]
            channel.count.taken += 1  # first: if anything comes between, it is found to be missing
            self._write(topic, channel, sample, now_ns)

    def _write(self, topic: str, channel: _Channel, sample: Sample, now_ns: int) -> None:
        if type(sample) is not channel.sample_type:
            self._on_misfit(topic, f"the topic carries {channel.sample_type.__name__}, not {type(sample).__name__}")
            return
        log_ns = channel.last_log_ns = max(now_ns + self._clock.offset_ns, channel.last_log_ns)
        publish_ns = max(sample.t_ns + self._clock.offset_ns, 0)
        try:
            if isinstance(sample, Frame):
                self._write_frame(topic, channel, sample, log_ns, publish_ns)
                return
            data = channel.codec.encode(sample)
            number = channel.number or self._number(channel, topic)
            channel.count.bytes += len(data)
            self._writer.add_message(number, data, sequence=sample.seq, log_ns=log_ns, publish_ns=publish_ns)
        except OSError as error:
            self._failed(error)
        except (struct.error, UnicodeEncodeError, ValueError, TypeError) as error:
            self._on_misfit(topic, f"a value does not fit the format: {error}")

    def _write_frame(self, topic: str, channel: _Channel, frame: Frame, log_ns: int, publish_ns: int) -> None:
        info = channel.codec.encode(info_of(frame))
        head, pixels = encode_image(frame, wall_ns=publish_ns)
        number = channel.number or self._number(channel, topic)
        channel.count.bytes += len(info) + len(head) + pixels.nbytes
        self._flush_chunk()
        self._writer.add_image(
            channel.image_number, head, pixels, sequence=frame.seq, log_ns=log_ns, publish_ns=publish_ns,
            info=(number, info),
        )  # fmt: skip

    def _number(self, channel: _Channel, topic: str) -> int:
        """Register the channel with its first message."""
        kind = channel.sample_type
        name = topic
        if kind is Frame:
            channel.image_number = self._writer.channel(ChannelKey(topic, IMAGE_SCHEMA, image_schema()))
            name, kind = f"{topic}{INFO_SUFFIX}", FrameInfo
        channel.number = self._writer.channel(ChannelKey(name, schema_name(kind), schema_data(kind)))
        return channel.number

    def write_arrivals(self, arrivals: Mapping[str, Sequence[int]], *, now_ns: int) -> None:
        """Note what the inbox of each estimator's host has received since the last time."""
        count = self._notes[ARRIVALS_TOPIC].count
        for host, orders in arrivals.items():
            begin, end = self._noted_arrivals.get(host, 0), len(orders)
            if end == begin:
                continue
            count.taken += 1
            self._noted_arrivals[host] = end
            try:
                self._note(ARRIVALS_TOPIC, Arrivals(host=host, orders=tuple(orders[begin:end])), now_ns)
            except OSError as error:
                self._failed(error)

    def _note(self, topic: str, note: Arrivals | Drops, now_ns: int) -> None:
        channel = self._notes[topic]
        log_ns = channel.last_log_ns = max(now_ns + self._clock.offset_ns, channel.last_log_ns)
        number = channel.number or self._number(channel, topic)
        data = channel.codec.encode(note)
        self._writer.add_message(number, data, sequence=0, log_ns=log_ns, publish_ns=log_ns)

    def flush(self, *, now_ns: int) -> None:
        """Hand all of it to the operating system, with a note of what was dropped since the last time."""
        self._flush_chunk()
        self._count_lost(self._writer.count)
        dropped = {topic: count.dropped for topic, count in tuple(self.counts.items())}
        new = {topic: number for topic, number in dropped.items() if number != self._noted_drops.get(topic, 0)}
        try:
            for topic, number in new.items():
                self._note(DROPS_TOPIC, Drops(topic=topic, dropped=number), now_ns)
            self._writer.flush()
        except OSError as error:
            self._failed(error)
        else:
            self._noted_drops |= new

    def _flush_chunk(self) -> None:
        try:
            self._writer.flush()
        except OSError as error:
            self._failed(error)

    def _failed(self, error: OSError) -> None:
        self._on_failure(error, "samples could not be written")

    def look_back(self, file: Path) -> bool:
        """Whether the file is as it was written; if not, what a reader does not find in it any more is counted as lost.

        Raises:
            OSError: it cannot be read.
        """
        if not self.disturbed and is_as_written(file, self._writer.written, self.size):
            return True
        self._count_lost(messages_left(file, self._writer.written).__getitem__)
        return False

    def _count_lost(self, held: Callable[[int], int]) -> None:
        """What was taken and is not held by the file, in messages of a channel, is lost, if nothing waits."""
        arrivals = self._notes[ARRIVALS_TOPIC]
        for channel in (*tuple(self._channels.values()), arrivals):
            channel.count.lost = channel.count.taken - held(channel.image_number or channel.number)
        if arrivals.count.lost:
            self.counts[ARRIVALS_TOPIC] = arrivals.count

    def attach(self, name: str, data: bytes, media_type: str, *, now_ns: int) -> None:
        """Attach a file.

        Raises:
            OSError: it could not be written.
        """
        self._flush_chunk()
        self._writer.add_attachment(name, media_type, data, log_ns=max(now_ns + self._clock.offset_ns, 0))

    def finish(self, end: ClockMapping, *, now_ns: int, failure: str | None) -> None:
        """Write the file's end, with the `failure` that has stopped the recording, if one has.

        Raises:
            OSError: it could not be written; what the file holds can be read all the same.
        """
        try:
            self.flush(now_ns=now_ns)
            clock = msgspec.structs.replace(
                self._clock, end_offset_ns=end.offset_ns, end_uncertainty_ns=end.uncertainty_ns
            )
            self._writer.add_metadata(HEADER_RECORD, to_metadata(self._header))
            self._writer.add_metadata(CLOCK_RECORD, to_metadata(clock))
            if failure is not None:
                self._writer.add_metadata(FAILURE_RECORD, {"reason": failure})
            self._writer.finish()
        finally:
            self._count_lost(self._writer.count)
