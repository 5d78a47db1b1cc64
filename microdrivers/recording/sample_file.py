"""A recording as it is written: samples become messages on channels, and what cannot be written is told."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any, Protocol

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
from microdrivers.recording.mcap_writer import ChannelKey, LostChunk, McapWriter, Output
from microdrivers.recording.schemas import Arrivals, Drops, FrameInfo, schema_data, schema_name


class TopicCount:
    """What has become of a topic's samples so far.

    Attributes:
        messages: how many were written. bytes: how many these are, and those that a full disk has refused.
        dropped: how many were not written: the queue was full, the disk was, or a value does not fit the format.
    """

    __slots__ = ("bytes", "dropped", "messages")

    def __init__(self) -> None:
        self.messages = self.bytes = self.dropped = 0

    def __repr__(self) -> str:
        return f"TopicCount(messages={self.messages}, bytes={self.bytes}, dropped={self.dropped})"


class LossCall(Protocol):
    """Who is told that samples are lost, and why."""

    def __call__(self, topic: str, number: int, why: str, error: OSError | None = None) -> None:
        """So many samples of a topic will not be in the file."""


class _Channel:
    """One topic's way into the file."""

    __slots__ = ("codec", "image_number", "last_log_ns", "number", "sample_type")

    def __init__(self, sample_type: type[msgspec.Struct]) -> None:
        self.sample_type = sample_type
        self.codec: Codec[Any] = codec_of(FrameInfo if sample_type is Frame else sample_type)
        self.number = 0
        self.image_number = 0
        self.last_log_ns = 0


class SampleFile:
    """Writes one recording; not for several threads at once, `add_topic` excepted.

    Raises:
        OSError: the file's beginning cannot be written.
    """

    def __init__(
        self,
        output: Output,
        *,
        header: RecordingHeader,
        clock: ClockMapping,
        counts: Mapping[str, TopicCount],
        on_loss: LossCall,
        compress_images: bool,
    ) -> None:
        self._writer = McapWriter(
            output, profile=PROFILE, library=f"microdrivers {header.microdrivers}", compress_images=compress_images
        )
        self._header = header
        self._clock = clock
        self._counts = counts
        self._on_loss = on_loss
        self._channels: dict[str, _Channel] = {}
        self._topics: dict[int, str] = {}
        self._noted_drops: dict[str, int] = {}
        self._notes = {ARRIVALS_TOPIC: _Channel(Arrivals), DROPS_TOPIC: _Channel(Drops)}
        self._writer.add_metadata(HEADER_RECORD, to_metadata(header))
        self._writer.add_metadata(CLOCK_RECORD, to_metadata(clock))

    @property
    def size(self) -> int:
        """Bytes in the file so far."""
        return self._writer.size

    def add_topic(self, name: str, sample_type: type[Sample]) -> None:
        """Samples of that type will come on topic `name`.

        Raises:
            UnsupportedType: it has a field that has no place in the format.
        """
        self._channels[name] = _Channel(sample_type)

    def write(self, topic: str, sample: Sample, *, now_ns: int) -> None:
        """Write a sample that was published at `now_ns`."""
        channel = self._channels[topic]
        if type(sample) is not channel.sample_type:
            self._on_loss(topic, 1, f"the topic carries {channel.sample_type.__name__}, not {type(sample).__name__}")
            return
        log_ns = channel.last_log_ns = max(now_ns + self._clock.offset_ns, channel.last_log_ns)
        publish_ns = max(sample.t_ns + self._clock.offset_ns, 0)
        try:
            if isinstance(sample, Frame):
                self._write_frame(topic, channel, sample, log_ns, publish_ns)
                return
            data = channel.codec.encode(sample)
            number = channel.number or self._number(channel, topic)
            count = self._counts[topic]
            count.messages += 1
            count.bytes += len(data)
            self._writer.add_message(number, data, sequence=sample.seq, log_ns=log_ns, publish_ns=publish_ns)
        except LostChunk as lost:
            self._count_lost(lost)
        except (struct.error, UnicodeEncodeError, ValueError, TypeError) as error:
            self._on_loss(topic, 1, f"a value does not fit the format: {error}")

    def _write_frame(self, topic: str, channel: _Channel, frame: Frame, log_ns: int, publish_ns: int) -> None:
        info = channel.codec.encode(info_of(frame))
        head, pixels = encode_image(frame, wall_ns=publish_ns)
        number = channel.number or self._number(channel, topic)
        count = self._counts[topic]
        count.messages += 1
        count.bytes += len(info) + len(head) + pixels.nbytes
        self._flush_chunk()
        stamps = {"sequence": frame.seq, "log_ns": log_ns, "publish_ns": publish_ns}
        self._writer.add_message(number, info, **stamps)
        self._writer.add_image(channel.image_number, head, pixels, **stamps)

    def _number(self, channel: _Channel, topic: str) -> int:
        """Register the channel with its first message."""
        kind = channel.sample_type
        name = topic
        if kind is Frame:
            channel.image_number = self._writer.channel(ChannelKey(topic, IMAGE_SCHEMA, image_schema()))
            self._topics[channel.image_number] = topic
            name, kind = f"{topic}{INFO_SUFFIX}", FrameInfo
        channel.number = self._writer.channel(ChannelKey(name, schema_name(kind), schema_data(kind)))
        if channel.sample_type is not Frame:
            self._topics[channel.number] = topic
        return channel.number

    def write_arrivals(self, host: str, orders: list[int], *, now_ns: int) -> None:
        """Note what an estimator's inbox has received."""
        self._note(ARRIVALS_TOPIC, Arrivals(host=host, orders=tuple(orders)), now_ns)

    def _note(self, topic: str, note: Arrivals | Drops, now_ns: int) -> None:
        channel = self._notes[topic]
        log_ns = channel.last_log_ns = max(now_ns + self._clock.offset_ns, channel.last_log_ns)
        number = channel.number or self._number(channel, topic)
        data = channel.codec.encode(note)
        try:
            self._writer.add_message(number, data, sequence=0, log_ns=log_ns, publish_ns=log_ns)
        except LostChunk as lost:
            self._count_lost(lost)

    def flush(self, *, now_ns: int) -> None:
        """Hand all of it to the operating system, with a note of what was dropped since the last time."""
        for topic, count in tuple(self._counts.items()):
            if count.dropped != self._noted_drops.get(topic, 0):
                self._noted_drops[topic] = count.dropped
                self._note(DROPS_TOPIC, Drops(topic=topic, dropped=count.dropped), now_ns)
        self._flush_chunk()

    def _flush_chunk(self) -> None:
        try:
            self._writer.flush()
        except LostChunk as lost:
            self._count_lost(lost)

    def _count_lost(self, lost: LostChunk) -> None:
        for number, messages in lost.messages.items():
            topic = self._topics.get(number)
            if topic == DROPS_TOPIC:
                self._noted_drops.clear()
            elif topic == ARRIVALS_TOPIC:
                self._on_loss(topic, messages, "samples could not be written", lost.error)
            elif topic is not None:
                self._counts[topic].messages -= messages
                self._on_loss(topic, messages, "samples could not be written", lost.error)

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
        self.flush(now_ns=now_ns)
        clock = msgspec.structs.replace(self._clock, end_offset_ns=end.offset_ns, end_uncertainty_ns=end.uncertainty_ns)
        self._writer.add_metadata(HEADER_RECORD, to_metadata(self._header))
        self._writer.add_metadata(CLOCK_RECORD, to_metadata(clock))
        if failure is not None:
            self._writer.add_metadata(FAILURE_RECORD, {"reason": failure})
        self._writer.finish()
