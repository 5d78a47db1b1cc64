"""A recording as one HDF5 file, for h5py and MATLAB."""

from __future__ import annotations

import io
import os
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from microdrivers.core.samples import Frame, Sample
from microdrivers.recording.channels import literal
from microdrivers.recording.columns import Column, columns_of, describe
from microdrivers.recording.reader import Recording
from microdrivers.recording.views import Array, arrays_of, optional_module

_TEXTS = ("string", "strings", "bytes")
_CHUNK_BYTES = 256 * 1024
_FRAMES = 8


class _Output(io.RawIOBase):
    """The file as HDF5 sees it, one that takes everything.

    A file that HDF5 could not write to its end takes the process with it: so it is not told. What the disk refuses,
    and whatever follows, is dropped, and `check` tells.
    """

    def __init__(self, file: Path) -> None:
        self._raw = file.open("x+b", buffering=0)
        self._error: OSError | None = None
        self._at = 0
        self._size = 0

    def check(self) -> None:
        """Raises: OSError: something could not be written."""
        if self._error is not None:
            raise self._error

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._at = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._size}[whence]
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: Any) -> int:
        self._raw.seek(self._at)
        got = 0
        while got < len(buffer) and (more := self._raw.readinto(buffer[got:])):
            got += more
        buffer[got:] = bytes(len(buffer) - got)
        self._at += len(buffer)
        return len(buffer)

    def write(self, data: Any) -> int:
        done = 0
        try:
            self._raw.seek(self._at)
            while self._error is None and done < len(data):
                done += self._raw.write(data[done:])
        except OSError as error:
            self._error = error
        self._at += len(data)
        self._size = max(self._size, self._at)
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        size = self._at if size is None else size
        self._size = size
        try:
            if self._error is None:
                self._raw.truncate(size)
        except OSError as error:
            self._error = error
        return size

    def close(self) -> None:
        super().close()
        self._raw.close()


class Hdf5File:
    """One group a topic, in it one dataset a field; all first dimensions are samples. MATLAB sees them transposed.

    Texts have a fixed width and are UTF-8, flags one text, true is 1 (uint8), tuples of any length are of variable
    length. A camera's frames are `image`, samples × rows × columns, uint8 or uint16; where their size changes, further
    datasets begin, whose attribute `first_sample` tells which sample they begin with.

    Raises:
        UnsupportedError: h5py is not installed.
    """

    def __init__(self, file: Path, recording: Recording, *, start_ns: int) -> None:
        self._h5py = optional_module("h5py")
        self._output = _Output(file)
        self._file = self._h5py.File(self._output, "w")
        self._start_ns = start_ns
        about = msgspec.structs.asdict(recording.header)
        if recording.clock is not None:
            about |= {f"clock_{key}": value for key, value in msgspec.structs.asdict(recording.clock).items()}
        about |= {"start_ns": start_ns, "losses": "; ".join(map(str, recording.losses))}
        self._file.attrs.update({key: value for key, value in about.items() if value is not None})
        attached = self._file.create_group("attachments")
        for name, data in recording.attachments.items():
            attached.create_dataset(name.replace("/", "-"), data=np.frombuffer(data, dtype="u1"))

    def topic(self, name: str, topic: str, sample_type: type[Sample], widths: Mapping[str, int]) -> Hdf5Topic:
        """The group of a topic, to write to; `widths` of its texts, bytes."""
        group = self._file.create_group(name)
        group.attrs.update({"topic": topic, "sample_type": sample_type.__name__, "description": describe(sample_type)})
        return Hdf5Topic(self._h5py, group, sample_type, widths, start_ns=self._start_ns, check=self._output.check)

    def close(self) -> None:
        """Complete the file."""
        self._file.close()
        self._output.close()


class Hdf5Topic:
    """Writes one topic."""

    remarks: Sequence[str] = ()

    def __init__(
        self,
        h5py: Any,
        group: Any,
        sample_type: type[Sample],
        widths: Mapping[str, int],
        *,
        start_ns: int,
        check: Callable[[], None],
    ) -> None:
        self._check = check
        self.batch = _FRAMES if sample_type is Frame else 16_384
        self._h5py = h5py
        self._group = group
        self._type = sample_type
        self._start_ns = start_ns
        self._count = 0
        self._images: list[Any] = []
        self._make("time_s", np.dtype("f8"), (), {"units": "s", "description": "time since the recording's start"})
        for column in columns_of(sample_type):
            shape = (column.length,) if column.shape == "fixed" else ()
            about = {"units": column.unit, "description": column.description}
            self._make(column.name, self._dtype(column, widths), shape, about)

    def _dtype(self, column: Column, widths: Mapping[str, int]) -> Any:
        if column.kind in _TEXTS:
            return self._h5py.string_dtype("utf-8", max(widths.get(column.name, 1), 1))
        if column.shape == "any":
            return self._h5py.vlen_dtype(np.dtype("f8" if column.kind == "doubles" else "i8"))
        return np.dtype("u1") if column.kind == "bool" else column.dtype

    def _make(self, name: str, dtype: Any, shape: tuple[int, ...], about: Mapping[str, str]) -> None:
        rows = max(1, min(self.batch, _CHUNK_BYTES // (np.dtype(dtype).itemsize * max(1, *shape, 1))))
        made = self._group.create_dataset(
            name, (0, *shape), maxshape=(None, *shape), chunks=(rows, *shape), dtype=dtype, compression="gzip",
            compression_opts=1, shuffle=True,
        )  # fmt: skip
        made.attrs.update({key: said for key, said in about.items() if said})

    def write(self, samples: list[Sample]) -> None:
        """Append samples.

        Raises:
            OSError: the disk has refused some.
        """
        self.verify()
        end = self._count + len(samples)
        for name, array in arrays_of(samples, self._type, start_ns=self._start_ns).items():
            written = self._group[name]
            written.resize(end, axis=0)
            if array.dtype == object and written.dtype.kind == "O":
                for index, value in enumerate(array, self._count):  # h5py makes tuples of one length a matrix
                    written[index] = value
            else:
                written[self._count :] = _encoded(array, written.dtype)
        for offset, sample in enumerate(samples):
            if isinstance(sample, Frame):
                self._add_image(sample, self._count + offset)
        self._count = end
        self.verify()

    def _add_image(self, frame: Frame, index: int) -> None:
        image = frame.image
        if not self._images or (self._images[-1].shape[1:], self._images[-1].dtype) != (image.shape, image.dtype):
            number = len(self._images) + 1
            made = self._group.create_dataset(
                "image" if number == 1 else f"image_{number}", (0, *image.shape), maxshape=(None, *image.shape),
                chunks=(1, *image.shape), dtype=image.dtype,
            )  # fmt: skip
            made.attrs.update({"first_sample": index, "description": "samples × rows × columns, row 0 on top"})
            self._images.append(made)
        images = self._images[-1]
        images.resize(images.shape[0] + 1, axis=0)
        images[-1] = image

    def close(self) -> None:
        """Nothing is kept back."""

    def verify(self) -> None:
        """Look whether the disk has taken all of it so far.

        Raises:
            OSError: it has not.
        """
        self._check()


def text_widths(recording: Recording, topics: list[str]) -> Mapping[str, Mapping[str, int]]:
    """Bytes of the longest text of each text field, by topic; reads the samples once."""
    widths: dict[str, dict[str, int]] = defaultdict(dict)
    texts: dict[type[Sample], list[Column]] = {}
    seen: dict[str, set[tuple[object, ...]]] = defaultdict(set)
    for topic, sample in recording.samples([literal(topic) for topic in topics]):
        kind = type(sample)
        if kind not in texts:
            texts[kind] = [column for column in columns_of(kind) if column.kind in _TEXTS]
        values = tuple(getattr(sample, column.name) for column in texts[kind])
        if values in seen[topic]:
            continue
        if len(seen[topic]) < 1000:
            seen[topic].add(values)
        for column in texts[kind]:
            length = len(column.value(sample).encode())
            widths[topic][column.name] = max(length, widths[topic].get(column.name, 1))
    return widths


def _encoded(array: Array, dtype: np.dtype[Any]) -> Array:
    if dtype.kind == "S":
        return np.array([value.encode() for value in array], dtype=dtype)
    return array
