"""A camera's frames as numbered images, and as a video."""

from __future__ import annotations

import csv
import math
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.core.errors import MicrodriversError
from microdrivers.core.samples import Frame, Sample, XYThetaSample, ZoomSample
from microdrivers.core.units import NS_PER_S
from microdrivers.recording.channels import literal
from microdrivers.recording.reader import Recording
from microdrivers.recording.replay import notes_of

_INFO = ("t_ns", "exposure_ms", "frame_id", "seq", "dropped_before", "settings_id", "bit_depth")
_MISSING = "missing_before"
_RIFF = struct.Struct("<4sI")
"""What an AVI file begins with: `RIFF`, and how many bytes follow."""


class Track(NamedTuple):
    """Recorded values of a topic over time: t_ns, and one array a field, NaN where a stage was not referenced."""

    topic: str
    referenced: bool
    t_ns: npt.NDArray[np.int64]
    values: Mapping[str, npt.NDArray[np.float64]]

    def at(self, t_ns: int) -> dict[str, float]:
        """The values of one instant, linear between samples; NaN before the first, after the last and beside a NaN."""
        since = (self.t_ns - t_ns).astype(float)
        return {
            name: float(np.interp(0.0, since, array, left=math.nan, right=math.nan))
            for name, array in self.values.items()
        }


def track_of(recording: Recording, camera: str) -> list[Track]:
    """Pose and zoom of what the camera sees: as the recorded routine says or, if none does, the only ones there are."""
    names: dict[str, Any] = {}
    for note in notes_of(recording):
        told = note.content.get("names") if isinstance(note.content, dict) else None
        if isinstance(told, dict) and told.get("camera") == camera:
            names = told
    tracks = []
    for key, kind, fields in (("stage", XYThetaSample, ("x_um", "y_um")), ("zoom", ZoomSample, ("zoom",))):
        there = [name for name, found in recording.topics.items() if found.sample_type is kind and found.count]
        topic = names.get(key) if names.get(key) in there else there[0] if len(there) == 1 else None
        if topic is not None:
            samples = sorted((s for _, s in recording.samples([literal(topic)])), key=lambda sample: sample.t_ns)
            # The pose of a stage without its reference is not a place; a zoom is used as it reads, as in a live run.
            known = [not isinstance(s, XYThetaSample) or s.referenced for s in samples]
            values = {field: np.where(known, [getattr(s, field) for s in samples], math.nan) for field in fields}
            t_ns = np.array([sample.t_ns for sample in samples], dtype=np.int64)
            tracks.append(Track(topic, all(known), t_ns, values))
    return tracks


class ImageFolder:
    """Writes frames as numbered PNG files, lossless, with `frames.csv`, as `calibrate optics --images` reads it.

    In the table, `missing_before` is how many frames the recording lacks before this one, as their `seq` tells.
    """

    batch = 1

    def __init__(self, folder: Path, tracks: list[Track], *, start_ns: int) -> None:
        folder.mkdir()
        self._folder = folder
        self._tracks = tracks
        self._start_ns = start_ns
        self._count = 0
        self._lacking = [0 for _ in tracks]
        self._before: int | None = None
        self._stream = (folder / "frames.csv").open("x", encoding="utf-8", newline="")
        self._table = csv.writer(self._stream, lineterminator="\n")
        self._table.writerow(["file", "time_s", *(name for track in tracks for name in track.values), *_INFO, _MISSING])

    def write(self, samples: list[Sample]) -> None:
        """Append frames."""
        import cv2

        for frame in samples:
            assert isinstance(frame, Frame)
            name = f"{self._count:06d}.png"
            done, data = cv2.imencode(".png", np.ascontiguousarray(frame.image), [cv2.IMWRITE_PNG_COMPRESSION, 1])
            if not done:
                raise MicrodriversError(f"frame {frame.seq} could not be made a PNG", remedy="export to hdf5")
            (self._folder / name).write_bytes(data.tobytes())
            found = [[*track.at(frame.t_ns).values()] for track in self._tracks]
            self._lacking = [n + any(map(math.isnan, f)) for n, f in zip(self._lacking, found, strict=True)]
            places = [value for values in found for value in values]
            time_s = (frame.t_ns - self._start_ns) / NS_PER_S
            missing = 0 if self._before is None else max(0, frame.seq - self._before - 1)
            self._table.writerow([name, time_s, *places, *(getattr(frame, field) for field in _INFO), missing])
            self._before = frame.seq
            self._count += 1

    @property
    def remarks(self) -> list[str]:
        """Which values the table lacks."""
        return [
            f"frames without {', '.join(track.values)} in frames.csv: {lacking} of {self._count}, since "
            f"{track.topic} {'has no sample before or after them' if track.referenced else 'was not referenced'}"
            for track, lacking in zip(self._tracks, self._lacking, strict=True)
            if lacking
        ]

    def close(self) -> None:
        """Complete the table."""
        self._stream.close()

    def verify(self) -> None:
        """`write` and `close` have told."""


class VideoFile:
    """Writes frames as Motion JPEG at a constant rate: lossy, 8 bit, without their times. To look at, not to measure.

    `rate_hz` is that of the frames while there is no pause; NaN if it is not known.
    """

    batch = 1

    def __init__(self, file: Path, *, rate_hz: float) -> None:
        self._left_out = 0
        self._file = file
        self._rate_hz = rate_hz if math.isfinite(rate_hz) and rate_hz > 0 else 30.0
        self._shape: tuple[int, ...] = ()
        self._writer: Any = None
        self._written = 0

    def write(self, samples: list[Sample]) -> None:
        """Append frames."""
        import cv2

        for frame in samples:
            assert isinstance(frame, Frame)
            image = eight_bit(frame)
            if self._writer is None:
                self._open(image.shape)
            if image.shape == self._shape:
                self._writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
                self._written += 1
            else:
                self._left_out += 1

    @property
    def remarks(self) -> list[str]:
        """How it plays, and how many frames it lacks."""
        plays = f"it plays at {self._rate_hz:.4g} frames per second, without the pauses between frames"
        lacks = f"{self._left_out} frames of another size than the first one were left out"
        return [plays, lacks] if self._left_out else [plays]

    def _open(self, shape: tuple[int, ...]) -> None:
        import cv2

        self._shape = shape
        size = (shape[1], shape[0])
        fourcc = cv2.VideoWriter.fourcc(*"MJPG")
        # In colour: OpenCV's own encoder writes grey textures as broken streams.
        self._writer = cv2.VideoWriter(str(self._file), cv2.CAP_OPENCV_MJPEG, fourcc, self._rate_hz, size, True)
        if not self._writer.isOpened():
            raise MicrodriversError(
                f"no video of {size[0]}×{size[1]} px can be written", remedy="export to images, and check the disk"
            )

    def close(self) -> None:
        """Complete the file."""
        if self._writer is not None:
            self._writer.release()

    def verify(self) -> None:
        """Look whether the closed file holds every frame: OpenCV's writer tells no failure.

        Raises:
            MicrodriversError: it does not.
        """
        if self._written and not (self._has_its_size() and self._shows_its_frames()):
            raise MicrodriversError(
                f"the video {self._file.name} could not be written to its end",
                remedy="choose another --out folder, on a disk with space left",
            )

    def _has_its_size(self) -> bool:
        with self._file.open("rb") as stream:
            head = stream.read(_RIFF.size)
        return len(head) == _RIFF.size and _RIFF.unpack(head)[1] + _RIFF.size == self._file.stat().st_size

    def _shows_its_frames(self) -> bool:
        import cv2

        capture = cv2.VideoCapture(str(self._file), cv2.CAP_OPENCV_MJPEG)
        try:
            found = sum(capture.grab() for _ in range(self._written))
            last_is_whole = capture.retrieve()[0]
            return found == self._written and last_is_whole and not capture.grab()
        finally:
            capture.release()


def eight_bit(frame: Frame) -> npt.NDArray[np.uint8]:
    """The image with its upper 8 significant bits."""
    image = frame.image
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image)
    reduced: npt.NDArray[np.uint8] = np.minimum(image >> max(frame.bit_depth - 8, 0), 255).astype(np.uint8)
    return reduced
