"""Frames from a Video4Linux camera or frame grabber, through OpenCV.

`v4l2:///dev/video0` or `v4l2://0`, with options as a query:

| option | meaning | default |
|---|---|---|
| `size=640x480` | what counts as the full sensor | the largest that the device offers |
| `fourcc=GREY` | pixel format of the device | GREY, else YUYV (its luminance), else the device's own |
| `stamp=start` or `stamp=end` | what the driver's buffer time marks: the start or end of the frame | not known |
| `stamp_uncertainty_ms` | 95 % half-width of that time | 1 |

The kernel stamps each buffer on the monotonic clock, but OpenCV does not pass on what the stamp marks. Without `stamp`
it is taken to lie anywhere from the exposure's start to the end of a readout of one period; that is free of scheduling
delays, yet too wide to calibrate in motion. A driver whose stamps are once seen to be no monotonic times of the past
gets arrival stamps from then on.
"""

from __future__ import annotations

import logging
import math
import re
import urllib.parse
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import msgspec
import numpy.typing as npt

from microdrivers.backends.camera.frame_pump import FramePump, require_real_time
from microdrivers.backends.camera.v4l2_node import busy, query_node
from microdrivers.core.clock import Clock
from microdrivers.core.errors import LinkLost, UnsupportedError
from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.devices.camera import CameraSettings, FrameSink, LossHandler, RawFrame

_log = logging.getLogger(__name__)

_LARGEST = (100_000, 100_000)
_MANUAL_EXPOSURE = 1  # V4L2_EXPOSURE_MANUAL
_EXPOSURE_UNITS_PER_MS = 10  # exposure_time_absolute counts 100 µs
_QUEUE_LENGTH = 4  # OpenCV's own, where it does not tell
_OLDEST_STAMP_NS = 2 * NS_PER_S
_WAIT_NS = 100 * NS_PER_MS
_RAW_FORMATS = ("GREY", "Y16 ", "YUYV")


@dataclass(frozen=True)
class V4l2Options:
    """The query of a `v4l2://` address."""

    size: tuple[int, int] | None = None
    fourcc: str | None = None
    stamp: Literal["start", "end"] | None = None
    stamp_uncertainty_ms: float = 1.0

    @classmethod
    def parse(cls, query: str) -> V4l2Options:
        """Options from a query.

        Raises:
            UnsupportedError: an unknown option, or a value that it cannot have.
        """
        asked = dict(urllib.parse.parse_qsl(query, keep_blank_values=True))
        values: dict[str, Any] = {}
        for key, text in asked.items():
            if key == "size" and (size := re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", text)):
                values[key] = (int(size[1]), int(size[2]))
            elif key == "fourcc" and 1 <= len(text) <= 4 and text.isascii():
                values[key] = text.ljust(4)
            elif key == "stamp" and text in ("start", "end"):
                values[key] = text
            elif key == "stamp_uncertainty_ms" and re.fullmatch(r"\d*\.?\d+", text) and float(text) > 0:
                values[key] = float(text)
            else:
                raise UnsupportedError(
                    f"the option {key}={text!r} of a v4l2 source is not understood",
                    remedy="use size=640x480, fourcc=GREY, stamp=start or stamp=end, stamp_uncertainty_ms=0.5",
                )
        return cls(**values)


class V4l2Source:
    """A Video4Linux device.

    Whole images only: OpenCV cannot set a region or binning. Gain is in the device's own units. Automatic exposure is
    switched off. A device that does not tell its exposure is taken to expose for the whole period.
    """

    def __init__(self, rest: str, *, clock: Clock) -> None:
        where, _, query = rest.partition("?")
        self.path = f"/dev/video{where}" if where.isdecimal() else where
        self.model = ""
        self.serial_number = ""
        self.sensor_size_px = (0, 0)
        self._options = V4l2Options.parse(query)
        self._clock = clock
        self._capture: cv2.VideoCapture | None = None
        self._settings: CameraSettings | None = None
        self._pump: FramePump | None = None
        self._frame_id = 0
        self._last_stamp_ns: int | None = None
        self._streamed = False
        self._stamps_hold = True

    def open(self) -> None:
        """Open the device and choose its pixel format and size.

        Raises:
            LinkLost: it is missing or may not be opened. BusyError: another program uses it.
            UnsupportedError: it is no camera, or does not offer the pixel format or size.
        """
        require_real_time(self._clock, self.path)
        info = query_node(self.path)
        self.model, self.serial_number = info.card, info.bus_info
        capture = cv2.VideoCapture(self.path, cv2.CAP_V4L2)
        if not capture.isOpened():
            capture.release()
            raise busy(self.path)
        self._capture = capture
        self._streamed, self._stamps_hold = False, True
        try:
            fourcc = self._choose_format(capture)
            self._choose_size(capture)
        except UnsupportedError:
            self.close()
            raise
        capture.set(cv2.CAP_PROP_CONVERT_RGB, 0 if fourcc in _RAW_FORMATS else 1)
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        self._pixel_format = "mono16" if fourcc == "Y16 " else "mono8"

    def close(self) -> None:
        """Close the device; idempotent."""
        capture, self._capture = self._capture, None
        if capture is not None:
            capture.release()

    def configure(self, wanted: CameraSettings) -> CameraSettings:
        """Set rate, exposure and gain, and read all three back.

        Raises:
            UnsupportedError: a region or binning.
        """
        capture = self._require_capture()
        whole = (0, 0, *self.sensor_size_px)
        if wanted.binning != 1 or wanted.roi != whole:
            raise UnsupportedError(
                "a v4l2 camera sends whole images without binning",
                remedy=f"configure roi={whole} and binning=1, or choose another size in the camera's source",
            )
        capture.set(cv2.CAP_PROP_FPS, wanted.rate_hz)
        rate_hz = _positive(capture.get(cv2.CAP_PROP_FPS), wanted.rate_hz)
        capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE)
        capture.set(cv2.CAP_PROP_EXPOSURE, max(1, round(wanted.exposure_ms * _EXPOSURE_UNITS_PER_MS)))
        told = capture.get(cv2.CAP_PROP_AUTO_EXPOSURE) == _MANUAL_EXPOSURE
        exposure_ms = capture.get(cv2.CAP_PROP_EXPOSURE) / _EXPOSURE_UNITS_PER_MS if told else 0.0
        if not exposure_ms > 0:
            _log.warning("%s does not tell its exposure; a whole period is assumed", self.path)
        gain = wanted.gain if capture.set(cv2.CAP_PROP_GAIN, wanted.gain) else 1.0
        self._settings = msgspec.structs.replace(
            wanted,
            rate_hz=rate_hz,
            exposure_ms=min(_positive(exposure_ms, math.inf), 1000.0 / rate_hz),
            gain=_positive(capture.get(cv2.CAP_PROP_GAIN), gain),
            pixel_format=self._pixel_format,
        )
        return self._settings

    def start(self, sink: FrameSink, lost: LossHandler) -> None:
        """Deliver frames, without those that lie in the driver's queue since the last time."""
        capture, settings = self._require_capture(), self._settings
        if settings is None:
            raise UnsupportedError("the camera has not been configured", remedy="configure it first")
        stopping = self._clock.event()
        queued = round(_positive(capture.get(cv2.CAP_PROP_BUFFERSIZE), _QUEUE_LENGTH)) if self._streamed else 0
        self._streamed = True
        self._last_stamp_ns = None
        discard = iter(range(queued))

        def read() -> RawFrame | None:
            while not stopping.is_set():
                if self._grab(capture):
                    return self._frame(capture, settings) if next(discard, None) is None else None
            return None

        self._pump = FramePump(read, stopping.set, clock=self._clock, sink=sink, lost=lost, name=self.path)

    def stop(self) -> None:
        """End delivery."""
        pump, self._pump = self._pump, None
        if pump is not None:
            pump.stop()

    # ------------------------------------------------------------------ inside

    def _choose_format(self, capture: cv2.VideoCapture) -> str:
        """Before the size: it decides which sizes there are."""
        for fourcc in (self._options.fourcc,) if self._options.fourcc else ("GREY", "YUYV"):
            capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*fourcc))
            if (found := _fourcc(capture)) == fourcc:
                return found
        if self._options.fourcc:
            raise UnsupportedError(
                f"{self.path} does not offer {self._options.fourcc!r}, it stays at {found!r}",
                remedy=f"see v4l2-ctl --device {self.path} --list-formats-ext",
            )
        return found

    def _choose_size(self, capture: cv2.VideoCapture) -> None:
        width, height = self._options.size or _LARGEST
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
        self.sensor_size_px = (
            round(capture.get(cv2.CAP_PROP_FRAME_WIDTH)),
            round(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)),
        )
        if self._options.size not in (None, self.sensor_size_px):
            raise UnsupportedError(
                f"{self.path} offers {self.sensor_size_px} px in the place of {self._options.size}",
                remedy=f"see v4l2-ctl --device {self.path} --list-formats-ext",
            )

    def _grab(self, capture: cv2.VideoCapture) -> bool:
        """Take the next frame; whether there was one within a short while (`grab` alone waits for ten seconds)."""
        try:
            if not cv2.VideoCapture.waitAny([capture], timeoutNs=_WAIT_NS)[0]:
                return False
            if capture.grab():
                return True
            why = "no frame"
        except cv2.error as error:
            why = error.err
        raise LinkLost(
            f"{self.path} has failed: {why}", remedy="check its cable and power, then close and open it", moved="no"
        )

    def _frame(self, capture: cv2.VideoCapture, settings: CameraSettings) -> RawFrame | None:
        arrived_ns = self._clock.now_ns()
        stamp_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * NS_PER_MS)
        if self._stamps_hold and not 0 < stamp_ns <= arrived_ns <= stamp_ns + _OLDEST_STAMP_NS:
            self._stamps_hold = False
            _log.warning("%s: its driver's stamps are no times of the past; arrival times are used", self.path)
        self._count(stamp_ns if self._stamps_hold else None, settings.rate_hz)
        decoded, image = capture.retrieve()
        if not decoded or image is None:
            return None
        t_ns, dt_ns = self._middle(stamp_ns, settings) if self._stamps_hold else (None, 0)
        return RawFrame(image=_mono(image), frame_id=self._frame_id, t_ns=t_ns, dt_ns=dt_ns, arrived_ns=arrived_ns)

    def _count(self, stamp_ns: int | None, rate_hz: float) -> None:
        """OpenCV hides the driver's own counter; stamps tell how many frames lie between two."""
        steps = 1
        if stamp_ns is not None and self._last_stamp_ns is not None:
            steps = max(1, round((stamp_ns - self._last_stamp_ns) * rate_hz / NS_PER_S))
        self._frame_id += steps
        self._last_stamp_ns = stamp_ns

    def _middle(self, stamp_ns: int, settings: CameraSettings) -> tuple[int, int]:
        """Mid-exposure and its uncertainty, from the buffer's time."""
        half_exposure_ns = round(settings.exposure_ms * NS_PER_MS / 2)
        dt_ns = round(self._options.stamp_uncertainty_ms * NS_PER_MS)
        match self._options.stamp:
            case "start":
                return stamp_ns + half_exposure_ns, dt_ns
            case "end":
                return stamp_ns - half_exposure_ns, dt_ns
            case None:
                half_period_ns = round(NS_PER_S / settings.rate_hz / 2)
                return stamp_ns - half_period_ns, half_period_ns + half_exposure_ns + dt_ns

    def _require_capture(self) -> cv2.VideoCapture:
        if self._capture is None:
            raise LinkLost(f"{self.path} is closed", remedy="open the camera first", moved="no")
        return self._capture


def _fourcc(capture: cv2.VideoCapture) -> str:
    return int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little", signed=False).decode("latin-1")


def _mono(image: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """A copy of its own: the device's buffer is written again. YUYV has its luminance in the first channel."""
    if image.ndim == 3 and image.shape[2] == 3:
        return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return image[:, :, 0].copy() if image.ndim == 3 else image.copy()


def _positive(value: float, otherwise: float) -> float:
    return value if math.isfinite(value) and value > 0 else otherwise
