"""Camera frames as foxglove.RawImage, which Foxglove and Rerun show, and all else of them in a `FrameInfo`."""

from __future__ import annotations

import functools
import struct
from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt
from google.protobuf import descriptor_pb2, timestamp_pb2

from microdrivers.core.samples import Frame
from microdrivers.core.units import NS_PER_S
from microdrivers.recording.codec import varint
from microdrivers.recording.schemas import FrameInfo

IMAGE_SCHEMA = "foxglove.RawImage"
INFO_SUFFIX = "/info"

_INFO_FIELDS = FrameInfo.__struct_fields__
_ENCODINGS: dict[str, np.dtype[Any]] = {"mono8": np.dtype("u1"), "mono16": np.dtype("<u2")}
_STAMP, _WIDTH, _HEIGHT, _ENCODING = b"\x0a", b"\x15", b"\x1d", b"\x22"
_STEP, _DATA, _FRAME_ID = b"\x2d", b"\x32", b"\x3a"


class WrittenImage(NamedTuple):
    """A RawImage message in two parts, so that the pixels need not be copied."""

    head: bytes
    pixels: memoryview


@functools.cache
def image_schema() -> bytes:
    """The serialised FileDescriptorSet of foxglove.RawImage."""
    from foxglove_schemas_protobuf import RawImage_pb2

    files = []
    for module in (timestamp_pb2, RawImage_pb2):
        file = descriptor_pb2.FileDescriptorProto()
        module.DESCRIPTOR.CopyToProto(file)
        files.append(file)
    return descriptor_pb2.FileDescriptorSet(file=files).SerializeToString(deterministic=True)


def info_of(frame: Frame) -> FrameInfo:
    """Everything of a frame but the image."""
    return FrameInfo(**{name: getattr(frame, name) for name in _INFO_FIELDS})


def frame_of(info: FrameInfo, image: npt.NDArray[Any]) -> Frame:
    """The frame again."""
    return Frame(image=image, **{name: getattr(info, name) for name in _INFO_FIELDS})


def encode_image(frame: Frame, *, wall_ns: int) -> WrittenImage:
    """The frame's RawImage; `wall_ns` ≥ 0 is its time for tools that show it.

    Raises:
        ValueError: the image is not of rows × columns of 8 or 16 bit.
    """
    image = frame.image
    encoding = {1: "mono8", 2: "mono16"}.get(image.itemsize if image.dtype.kind == "u" else 0)
    if encoding is None or image.ndim != 2:
        raise ValueError(f"an image of {image.ndim} dimensions of {image.dtype} cannot be recorded")
    pixels = np.ascontiguousarray(image, dtype=_ENCODINGS[encoding])
    rows, columns = image.shape
    seconds, nanos = divmod(wall_ns, NS_PER_S)
    stamp = b"\x08" + varint(seconds) + b"\x10" + varint(nanos)
    name = frame.device.encode()
    head = b"".join((
        _STAMP, varint(len(stamp)), stamp,
        _WIDTH, struct.pack("<I", columns), _HEIGHT, struct.pack("<I", rows),
        _ENCODING, varint(len(encoding)), encoding.encode(), _STEP, struct.pack("<I", columns * image.itemsize),
        _FRAME_ID, varint(len(name)), name, _DATA, varint(pixels.nbytes),
    ))  # fmt: skip
    return WrittenImage(head, memoryview(pixels.reshape(-1).data).cast("B") if pixels.size else memoryview(b""))


def decode_image(data: memoryview) -> npt.NDArray[Any]:
    """The read-only image of a RawImage that `encode_image` wrote; it shares the memory of `data` where it can.

    Raises:
        ValueError: it is none of ours.
    """
    values = _fields(data)
    encoding = bytes(values.get(_ENCODING[0], b"")).decode("ascii", "replace")
    if encoding not in _ENCODINGS:
        raise ValueError(f"an image is encoded as {encoding!r}, not as {' or '.join(_ENCODINGS)}")
    dtype = _ENCODINGS[encoding]
    shape = cast("int", values.get(_HEIGHT[0], 0)), cast("int", values.get(_WIDTH[0], 0))
    image = np.frombuffer(values.get(_DATA[0], b""), dtype).reshape(shape)
    if not image.flags.aligned:
        image = image.copy()
    image.flags.writeable = False
    return image


def _fields(data: memoryview) -> dict[int, Any]:
    """Values by tag, as far as the kinds of field go that a RawImage has."""
    values: dict[int, Any] = {}
    position = 0
    try:
        while position < len(data):
            tag = data[position]
            position += 1
            if tag & 7 == 5:
                values[tag] = struct.unpack_from("<I", data, position)[0]
                position += 4
                continue
            if tag & 7 != 2:
                raise ValueError("an image has a field of a kind that it should not have")
            size = shift = 0
            while True:
                byte = data[position]
                position += 1
                size |= (byte & 0x7F) << shift
                shift += 7
                if byte < 0x80:
                    break
            values[tag] = data[position : position + size]
            position += size
    except (IndexError, struct.error) as error:
        raise ValueError("an image's message is cut off") from error
    return values
