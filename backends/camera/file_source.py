"""Recorded images and films in the place of a camera, at the camera's rate and on the rig's clock, simulated or real.

`images:///folder/img_%04d.png` plays the numbered images of a folder, with their bit depth; a number that is missing
counts as a dropped frame. `video:///path/film.avi` plays a film in grey. At the end the camera is gone, as one whose
cable was pulled: closing and opening it plays from the start.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Protocol

import cv2
import msgspec
import numpy.typing as npt

from microdrivers.core.clock import Clock, Timer
from microdrivers.core.errors import LinkLost, UnsupportedError
from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.devices.camera import CameraSettings, FrameSink, LossHandler, RawFrame

Image = npt.NDArray[Any]

_CHECK = "check the path in the camera's source in the rig file"
_PLAY_AGAIN = "close and open the camera to play it from the start"


class Film(Protocol):
    """Numbered images in order."""

    name: str

    def rewind(self) -> Image:
        """Go to the start; the first image, which comes again as the first of `next_image`.

        Raises:
            LinkLost: there is none that can be read.
        """

    def next_image(self) -> tuple[int, Image] | None:
        """The next image and its number; None at the end.

        Raises:
            LinkLost: it cannot be read.
        """

    def close(self) -> None:
        """Release the file."""


class FileSource:
    """A camera that sees a recording.

    Frame by frame in the recording's order, none left out, at the rate of the rig file; each is stamped as if it had
    been exposed then. Regions are cut out; binning is not offered. Gain is 1 and cannot be set.
    """

    serial_number = ""

    def __init__(self, film: Film, *, clock: Clock) -> None:
        self.model = film.name
        self.sensor_size_px = (0, 0)
        self._film = film
        self._clock = clock
        self._pixel_format = "mono8"
        self._settings: CameraSettings | None = None
        self._timer: Timer | None = None

    def open(self) -> None:
        """Look at the first image.

        Raises:
            LinkLost: the recording is missing, empty or damaged.
        """
        image = self._film.rewind()
        self.sensor_size_px = (image.shape[1], image.shape[0])
        self._pixel_format = f"mono{8 * image.itemsize}"

    def close(self) -> None:
        """Release the file."""
        self._film.close()

    def configure(self, wanted: CameraSettings) -> CameraSettings:
        """Settings that a recording can have.

        Raises:
            UnsupportedError: binning.
        """
        if wanted.binning != 1:
            raise UnsupportedError("a recording offers binning 1 only", remedy="configure binning=1")
        self._settings = msgspec.structs.replace(wanted, gain=1.0, pixel_format=self._pixel_format)
        return self._settings

    def start(self, sink: FrameSink, lost: LossHandler) -> None:
        """Go on playing; the first exposure begins now and each frame comes when its exposure ends."""
        settings = self._settings
        if settings is None:
            raise UnsupportedError("the camera has not been configured", remedy="configure it first")
        period_ns = round(NS_PER_S / settings.rate_hz)
        exposure_ns = round(settings.exposure_ms * NS_PER_MS)
        first_ns = self._clock.now_ns() + exposure_ns
        left, top, width, height = settings.roi

        def deliver() -> None:
            # The end of the exposure follows from the grid: a late call must not shift the stamp.
            end_ns = first_ns + (self._clock.now_ns() - first_ns) // period_ns * period_ns
            try:
                found = self._film.next_image()
            except LinkLost as error:
                self.stop()
                lost(error)
                return
            if found is None:
                self.stop()
                lost(LinkLost(f"{self._film.name} has ended", remedy=_PLAY_AGAIN, moved="no"))
                return
            number, image = found
            sink(
                RawFrame(
                    image=image[top : top + height, left : left + width].copy(), frame_id=number,
                    t_ns=end_ns - exposure_ns // 2, dt_ns=0,
                )
            )  # fmt: skip

        self._timer = self._clock.every(period_ns / NS_PER_S, deliver, start_ns=first_ns, name=self._film.name)

    def stop(self) -> None:
        """Pause."""
        timer, self._timer = self._timer, None
        if timer is not None:
            timer.cancel()


class ImageFiles:
    """The images of a folder whose names fit a pattern with one number, such as `img_%04d.png`, by number."""

    def __init__(self, pattern: str) -> None:
        path = Path(pattern)
        self.name = path.name
        self._folder = path.parent
        match = re.fullmatch(r"([^%]*)%0?\d*d([^%]*)", path.name)
        if match is None:
            raise UnsupportedError(
                f"{path.name!r} is no pattern for numbered images", remedy="write images:///folder/img_%04d.png"
            )
        self._expression = re.compile(re.escape(match[1]) + r"(\d+)" + re.escape(match[2]))
        self._files: list[tuple[int, Path]] = []
        self._position = 0

    def rewind(self) -> Image:
        """Go to the start; the first image.

        Raises:
            LinkLost: no image fits, or the first cannot be read.
        """
        try:
            names = sorted(self._folder.iterdir())
        except OSError as error:
            raise LinkLost(f"cannot read folder {self._folder}: {error}", remedy=_CHECK, moved="no") from error
        found = [(self._expression.fullmatch(path.name), path) for path in names]
        self._files = sorted((int(match[1]), path) for match, path in found if match is not None)
        self._position = 0
        if not self._files:
            raise LinkLost(f"no image in {self._folder} is called {self.name}", remedy=_CHECK, moved="no")
        return _load(self._files[0][1])

    def next_image(self) -> tuple[int, Image] | None:
        """The next image and its number; None at the end.

        Raises:
            LinkLost: it cannot be read.
        """
        if self._position == len(self._files):
            return None
        number, path = self._files[self._position]
        self._position += 1
        return number, _load(path)

    def close(self) -> None:
        """Nothing is held between images."""


class VideoFile:
    """A film that OpenCV can read, in grey, 8 bit."""

    def __init__(self, path: str) -> None:
        self._path = Path(path)
        self.name = self._path.name
        self._capture: cv2.VideoCapture | None = None
        self._first: Image | None = None
        self._number = 0

    def rewind(self) -> Image:
        """Go to the start; the first image.

        Raises:
            LinkLost: there is no such film, or it cannot be read.
        """
        self.close()
        if not self._path.is_file():
            raise LinkLost(f"there is no film {self._path}", remedy=_CHECK, moved="no")
        self._capture = cv2.VideoCapture(str(self._path))
        there, image = self._capture.read()
        if not there:
            self.close()
            raise LinkLost(f"{self._path} is not a film that OpenCV can read", remedy=_CHECK, moved="no")
        self._number = 0
        self._first = _grey(image)
        return self._first

    def next_image(self) -> tuple[int, Image] | None:
        """The next image and its number; None at the end."""
        image, self._first = self._first, None
        if image is None:
            if self._capture is None:
                return None
            there, coloured = self._capture.read()
            if not there:
                return None
            image = _grey(coloured)
        self._number += 1
        return self._number - 1, image

    def close(self) -> None:
        """Close the file."""
        capture, self._capture, self._first = self._capture, None, None
        if capture is not None:
            capture.release()


def _load(path: Path) -> Image:
    try:
        image = cv2.imread(str(path), cv2.IMREAD_ANYDEPTH) if path.stat().st_size else None
    except OSError as error:
        raise LinkLost(f"{path.name} has disappeared: {error}", remedy=_CHECK, moved="no") from error
    if image is None:
        raise LinkLost(
            f"{path.name} is not a readable image (damaged or truncated)", remedy="replace or remove it", moved="no"
        )
    return image


def _grey(image: Image) -> Image:
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
