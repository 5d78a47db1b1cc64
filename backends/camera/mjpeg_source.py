"""Frames from an HTTP stream of images (multipart/x-mixed-replace), as network cameras and `microdrivers serve` send.

Any such stream of JPEG, PNG or PGM images can be read. A server may say more, in headers of the response and of each
part; what it does not say is taken from the rig file:

| header | of | meaning |
|---|---|---|
| Model, Serial-Number | response | identity |
| Sensor-Size | response | `640x480`, full sensor; otherwise the size of the first image |
| Rate-Hz, Exposure-Ms, Roi | response | the settings really used (`Roi: 0,0,640,480`), taken as query by the server |
| Timestamp | part | mid-exposure, ns on the sender's monotonic clock; used only if the sender runs on this computer |
| Timestamp-Uncertainty | part | half-width of the 95 % interval of it, ns |
| Frame-Id | part | the sender's counter; otherwise parts are counted |
"""

from __future__ import annotations

import http.client
import ipaddress
import logging
import math
import socket
import urllib.parse
from email.message import Message
from typing import Any, cast

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from microdrivers.backends.camera.frame_pump import FramePump, require_real_time
from microdrivers.backends.camera.multipart import MultipartReader
from microdrivers.core.clock import Clock
from microdrivers.core.errors import LinkError, LinkLost, ProtocolError, UnsupportedError
from microdrivers.core.units import NS_PER_S
from microdrivers.devices.camera import CameraSettings, FrameSink, LossHandler, RawFrame

_log = logging.getLogger(__name__)

_CONNECT_TIMEOUT_S = 2.0
_OLDEST_STAMP_NS = 2 * NS_PER_S
_ACCEPT = "multipart/x-mixed-replace, image/x-portable-graymap, image/png, image/jpeg;q=0.5"
_REMEDY = "check that the server runs (microdrivers serve) and that the camera's source in the rig file names it"


class MjpegSource:
    """The camera behind `mjpeg+http://HOST:PORT/PATH?QUERY`.

    Regions are taken by the server if it can; binning is not offered. Gain is 1 and cannot be set.
    """

    def __init__(self, rest: str, *, clock: Clock) -> None:
        self.model = "HTTP stream"
        self.serial_number = ""
        self.sensor_size_px = (0, 0)
        self._clock = clock
        self._url = urllib.parse.urlsplit(f"http://{rest}")
        self._settings: CameraSettings | None = None
        self._settable = False
        self._stream: _Stream | None = None
        self._pump: FramePump | None = None
        self._pixel_format = "mono8"

    def open(self) -> None:
        """Connect, and learn who sends what.

        Raises:
            LinkLost: nobody answers. ProtocolError: what answers is no such stream.
        """
        require_real_time(self._clock, self._url.geturl())
        stream = _Stream(self._url, {}, self._clock)
        try:
            image = stream.read_image()
        finally:
            stream.close()
        headers = stream.headers
        self.model = headers.get("Model", self.model)
        self.serial_number = headers.get("Serial-Number", "")
        height, width = image.shape
        self.sensor_size_px = _pair(headers["Sensor-Size"]) if "Sensor-Size" in headers else (width, height)
        self._settable = "Rate-Hz" in headers
        self._pixel_format = f"mono{8 * image.itemsize}"

    def configure(self, wanted: CameraSettings) -> CameraSettings:
        """Ask for settings and read back what the server really uses.

        Raises:
            UnsupportedError: binning, or a region of a stream that cannot be set, or settings that the server refuses.
        """
        whole = (0, 0, *self.sensor_size_px)
        if wanted.binning != 1:
            raise UnsupportedError("an HTTP stream offers binning 1 only", remedy="configure binning=1")
        if wanted.roi != whole and not self._settable:
            raise UnsupportedError(
                "this HTTP stream sends whole images only", remedy=f"configure roi={whole}, and crop the images"
            )
        confirmed = msgspec.structs.replace(wanted, gain=1.0, pixel_format=self._pixel_format)
        if self._settable:
            stream = _Stream(self._url, _query(wanted), self._clock)
            stream.close()
            confirmed = _read_back(confirmed, stream.headers)
        else:
            _log.info("%s does not tell its settings: those of the rig file are assumed", self._url.geturl())
        self._settings = confirmed
        return confirmed

    def start(self, sink: FrameSink, lost: LossHandler) -> None:
        """Connect and deliver what comes.

        Raises:
            LinkLost: nobody answers. UnsupportedError: the server has other settings by now.
        """
        settings = self._settings
        if settings is None:
            raise UnsupportedError("the camera has not been configured", remedy="configure it first")
        stream = _Stream(self._url, _query(settings) if self._settable else {}, self._clock)
        if self._settable and _read_back(settings, stream.headers) != settings:
            stream.close()
            raise UnsupportedError(
                "another client has changed the settings of this stream", remedy="configure the camera again"
            )
        self._pump = FramePump(
            stream.read_frame, stream.interrupt, clock=self._clock, sink=sink, lost=lost, name=self._url.netloc
        )
        self._stream = stream

    def stop(self) -> None:
        """Disconnect from the stream."""
        pump, self._pump = self._pump, None
        stream, self._stream = self._stream, None
        if pump is not None:
            pump.stop()
        if stream is not None:
            stream.close()

    def close(self) -> None:
        """Nothing is held between streams."""


class _Stream:
    """One open response."""

    def __init__(self, url: urllib.parse.SplitResult, query: dict[str, str], clock: Clock) -> None:
        self._clock = clock
        self._where = url.netloc
        pairs = {**dict(urllib.parse.parse_qsl(url.query, keep_blank_values=True)), **query}
        target = urllib.parse.urlunsplit(("", "", url.path or "/", urllib.parse.urlencode(pairs, safe=","), ""))
        self._count = 0
        try:
            connection = http.client.HTTPConnection(url.hostname or "", url.port, timeout=_CONNECT_TIMEOUT_S)
            connection.connect()
            self._socket = cast(socket.socket, connection.sock)
        except (OSError, ValueError) as error:  # ValueError: an impossible port
            raise LinkLost(f"nobody answers at {self._where}: {error}", remedy=_REMEDY, moved="no") from error
        peer, own = self._socket.getpeername()[0], self._socket.getsockname()[0]
        self._same_computer = peer == own or ipaddress.ip_address(peer).is_loopback
        try:
            connection.request("GET", target, headers={"Accept": _ACCEPT})
            self._response = connection.getresponse()
            self.headers: Message = self._response.headers
            self._parts = MultipartReader(self._response, self._check())
        except (OSError, http.client.HTTPException) as error:
            connection.close()
            raise LinkLost(f"{self._where} does not answer in HTTP: {error!r}", remedy=_REMEDY, moved="no") from error
        except LinkError:
            self.close()
            raise

    def _check(self) -> str:
        """The boundary, of a response that is such a stream."""
        response = self._response
        if response.status == http.client.BAD_REQUEST:
            said = response.read(500).decode("utf-8", "replace").strip()
            self.close()
            raise UnsupportedError(f"{self._where} refuses the settings: {said}", remedy="configure others")
        if response.status != http.client.OK:
            raise ProtocolError(f"{self._where} answers {response.status} {response.reason}", remedy=_REMEDY)
        boundary = self.headers.get_param("boundary")
        if self.headers.get_content_type() != "multipart/x-mixed-replace" or not isinstance(boundary, str):
            kind = self.headers.get("Content-Type", "nothing")
            raise ProtocolError(
                f"{self._where} sends {kind}, not multipart/x-mixed-replace with a boundary",
                remedy="name the address of the stream itself, not that of the camera's web page",
            )
        return boundary

    def read_image(self) -> npt.NDArray[Any]:
        """Wait for the first image.

        Raises:
            LinkLost: none comes. ProtocolError: what comes is no image.
        """
        image = _decode(self._parts.body(self._parts.next_headers()))
        if image is None:
            raise ProtocolError(f"{self._where} sends parts that are no images", remedy=_REMEDY)
        return image

    def read_frame(self) -> RawFrame | None:
        """Wait for the next frame as long as it takes; None if it is damaged, which shows as a gap in `frame_id`."""
        self._socket.settimeout(None)
        try:
            headers = self._parts.next_headers()
            body = self._parts.body(headers)
        except ProtocolError as error:
            raise LinkLost(f"the stream is garbled: {error.what}", remedy=_REMEDY, moved="no") from error
        arrived_ns = self._clock.now_ns()
        self._count += 1
        image = _decode(body)
        if image is None:
            return None
        t_ns = self._stamp(headers, arrived_ns)
        return RawFrame(
            image=image,
            frame_id=_whole_number(headers.get("Frame-Id"), self._count),
            t_ns=t_ns,
            dt_ns=0 if t_ns is None else _whole_number(headers.get("Timestamp-Uncertainty"), 0),
            arrived_ns=arrived_ns,
        )

    def _stamp(self, headers: Message, arrived_ns: int) -> int | None:
        """The sender's stamp, if it is on this computer's clock and says how good it is."""
        stamp_ns = _whole_number(headers.get("Timestamp"), -1)
        stated = "Timestamp-Uncertainty" in headers
        on_this_clock = self._same_computer and 0 <= arrived_ns - stamp_ns <= _OLDEST_STAMP_NS
        return stamp_ns if stated and on_this_clock else None

    def interrupt(self) -> None:
        """End the connection under a waiting reader."""
        try:
            self._socket.shutdown(socket.SHUT_RDWR)
        except OSError:  # the other side was faster
            _log.debug("%s had closed the stream already", self._where)

    def close(self) -> None:
        """Disconnect."""
        self._response.close()
        self._socket.close()


def _decode(body: bytes) -> npt.NDArray[Any] | None:
    """Grey, with the depth that the image has; None if it is no image."""
    return cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_ANYDEPTH) if body else None


def _query(settings: CameraSettings) -> dict[str, str]:
    return {
        "rate_hz": repr(settings.rate_hz),
        "exposure_ms": repr(settings.exposure_ms),
        "roi": ",".join(str(number) for number in settings.roi),
    }


def _read_back(wanted: CameraSettings, headers: Message) -> CameraSettings:
    try:
        roi = tuple(int(text) for text in headers["Roi"].split(",")) if "Roi" in headers else wanted.roi
        if len(roi) != 4:
            raise ValueError(f"Roi {roi}")
        rate_hz = float(headers.get("Rate-Hz", wanted.rate_hz))
        exposure_ms = float(headers.get("Exposure-Ms", wanted.exposure_ms))
        if not math.isfinite(rate_hz) or not math.isfinite(exposure_ms):
            raise ValueError(f"Rate-Hz {rate_hz}, Exposure-Ms {exposure_ms}")
        return msgspec.structs.replace(wanted, rate_hz=rate_hz, exposure_ms=exposure_ms, roi=roi)
    except ValueError as error:
        raise ProtocolError(f"the server states settings that are no numbers: {error}") from error


def _pair(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    try:
        return int(width), int(height)
    except ValueError as error:
        raise ProtocolError(f"the server states a sensor of {text[:32]!r}, not WIDTHxHEIGHT") from error


def _whole_number(text: str | None, otherwise: int) -> int:
    return int(text) if text is not None and text.strip().isdecimal() else otherwise
