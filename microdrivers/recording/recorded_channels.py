"""What the channels of a recording hold, and how their messages become samples again."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeVar

from google.protobuf.message import DecodeError
from mcap.records import Channel, Schema

from microdrivers.core.samples import Frame, Sample
from microdrivers.recording.codec import decoder_for
from microdrivers.recording.images import IMAGE_SCHEMA, INFO_SUFFIX, decode_image, frame_of
from microdrivers.recording.schemas import (
    Arrivals,
    Drops,
    FrameInfo,
    UnsupportedType,
    fields_of,
    sample_types,
    schema_name,
)

_STAMPS = struct.Struct("<BqBqBqBq")
"""How every sample of the present schema begins: t_ns, dt_ns, seq, order, each behind its tag."""
_STAMP_TAGS = tuple(
    field.number << 3 | 1
    for name in ("t_ns", "dt_ns", "seq", "order")
    for field in fields_of(FrameInfo)
    if field.name == name
)
_NOTES = {schema_name(kind): kind for kind in (Arrivals, Drops)}


class Stamps(NamedTuple):
    """What tells a sample from all others of its recording."""

    t_ns: int
    seq: int
    order: int


FoundT = TypeVar("FoundT", covariant=True)


class Action(Protocol[FoundT]):
    """What is made of a message's data and sequence number; None if nothing is."""

    def __call__(self, data: Any, sequence: int, /) -> FoundT | None:
        """Raises Unreadable: the message does not fit its schema."""


class Unreadable(Exception):
    """A message cannot be read, though its chunk is intact."""


class ChannelReader:
    """Reads the messages of one channel.

    Attributes:
        topic: on which its samples were published; of a frame's info, that of the frame.
        sample_type: of the topic; None if the channel holds no samples or none that are known.
        is_image: whether its messages are images.
    """

    sample_type: type[Sample] | None = None
    is_image = False

    def __init__(self, topic: str) -> None:
        self.topic = topic

    def take(self, data: Any, sequence: int) -> Sample | None:
        """The sample that the message completes, if it does.

        Raises:
            Unreadable: it does not fit its schema.
        """
        raise NotImplementedError

    def stamps(self, data: Any, sequence: int) -> Stamps | None:
        """Those of the sample that the message completes, for less than it costs to read it."""
        raise NotImplementedError


class SampleReader(ChannelReader):
    """Reads a channel of samples."""

    def __init__(self, topic: str, sample_type: type[Sample], schema: bytes) -> None:
        super().__init__(topic)
        self.sample_type = sample_type
        self._decode = decoder_for(sample_type, schema)

    def take(self, data: Any, _sequence: int) -> Sample | None:
        """As in `ChannelReader`."""
        try:
            return self._decode(data)
        except _MISFITS as error:
            raise _misfit(error) from error

    def stamps(self, data: Any, sequence: int) -> Stamps | None:
        """As in `ChannelReader`."""
        if len(data) >= _STAMPS.size:
            t_tag, t_ns, dt_tag, _, seq_tag, seq, order_tag, order = _STAMPS.unpack_from(data)
            if (t_tag, dt_tag, seq_tag, order_tag) == _STAMP_TAGS:
                return Stamps(t_ns, seq, order)
        sample = self.take(data, sequence)
        return None if sample is None else Stamps(sample.t_ns, sample.seq, sample.order)


class FrameJoin:
    """What the two channels of a camera share: an info that waits for its image."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self._info: FrameInfo | None = None
        self._sequence = -1

    def put(self, info: FrameInfo, sequence: int) -> None:
        """Keep the info of the image that follows."""
        self._info, self._sequence = info, sequence

    def claim(self, sequence: int) -> FrameInfo:
        """The info of an image.

        Raises:
            Unreadable: it is lost.
        """
        info, self._info = self._info, None
        if info is None or self._sequence != sequence:
            raise Unreadable(f"an image of {self.topic!r} whose info is lost")
        return info


class InfoReader(ChannelReader):
    """Reads a channel of `FrameInfo`; the frame is complete with its image."""

    def __init__(self, frame: FrameJoin, schema: bytes) -> None:
        super().__init__(frame.topic)
        self._frame = frame
        self._decode = _safely(decoder_for(FrameInfo, schema))

    def take(self, data: Any, sequence: int) -> Sample | None:
        """As in `ChannelReader`."""
        self._frame.put(self._decode(data), sequence)
        return None

    def stamps(self, data: Any, sequence: int) -> Stamps | None:
        """As in `ChannelReader`."""
        self.take(data, sequence)
        return None


class ImageReader(ChannelReader):
    """Reads a channel of images."""

    sample_type = Frame
    is_image = True

    def __init__(self, frame: FrameJoin) -> None:
        super().__init__(frame.topic)
        self._frame = frame

    def take(self, data: Any, sequence: int) -> Sample | None:
        """As in `ChannelReader`."""
        info = self._frame.claim(sequence)
        try:
            return frame_of(info, decode_image(data))
        except ValueError as error:
            raise Unreadable(str(error)) from error

    def stamps(self, _data: Any, sequence: int) -> Stamps | None:
        """As in `ChannelReader`."""
        info = self._frame.claim(sequence)
        return Stamps(info.t_ns, info.seq, info.order)


class NoteReader(ChannelReader):
    """Reads what the recorder itself notes: `note` gives it."""

    def __init__(self, topic: str, kind: type[Arrivals] | type[Drops], schema: bytes) -> None:
        super().__init__(topic)
        self.note: Callable[[bytes], Arrivals | Drops] = _safely(decoder_for(kind, schema))

    def take(self, _data: Any, _sequence: int) -> Sample | None:
        """As in `ChannelReader`."""
        return None

    def stamps(self, _data: Any, _sequence: int) -> Stamps | None:
        """As in `ChannelReader`."""
        return None


class UnknownReader(ChannelReader):
    """A channel whose messages this version of microdrivers does not know."""

    def __init__(self, topic: str, what: str) -> None:
        super().__init__(topic)
        self._what = what

    def take(self, _data: Any, _sequence: int) -> Sample | None:
        """As in `ChannelReader`."""
        raise Unreadable(self._what)

    stamps = take  # type: ignore[assignment]


def channel_reader(channel: Channel, schema: Schema | None, frames: dict[str, FrameJoin]) -> ChannelReader:
    """The reader of a channel; `frames` joins the two channels of each camera, by topic."""
    topic = channel.topic
    if schema is None or schema.encoding != "protobuf":
        return UnknownReader(topic, f"a message of {topic!r}, whose schema is lost or not protobuf")
    if schema.name == IMAGE_SCHEMA:
        return ImageReader(frames.setdefault(topic, FrameJoin(topic)))
    if schema.name == schema_name(FrameInfo):
        camera = topic.removesuffix(INFO_SUFFIX)
        return InfoReader(frames.setdefault(camera, FrameJoin(camera)), schema.data)
    if schema.name in _NOTES:
        return NoteReader(topic, _NOTES[schema.name], schema.data)
    sample_type = sample_types().get(schema.name)
    try:
        if sample_type is not None:
            return SampleReader(topic, sample_type, schema.data)
    except UnsupportedType:
        pass
    return UnknownReader(topic, f"a message of {topic!r}, of the unknown type {schema.name}")


_MISFITS = (DecodeError, TypeError, ValueError, KeyError)


def _misfit(error: Exception) -> Unreadable:
    return Unreadable(f"a message that does not fit its schema ({error})")


def _safely(decode: Callable[[bytes], Any]) -> Callable[[bytes], Any]:
    def safe(data: bytes) -> Any:
        try:
            return decode(data)
        except _MISFITS as error:
            raise _misfit(error) from error

    return safe
