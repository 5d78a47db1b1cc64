"""What a viewer of the emulated camera's stream may ask for, and how a frame is written into the stream."""

from __future__ import annotations

import math
import urllib.parse
from typing import NamedTuple

import msgspec

from microdrivers.devices.camera import CameraSettings, RawFrame

BOUNDARY = "frame"
_MAX_RATE_HZ = 1000.0


class Coding(NamedTuple):
    """How images are coded: the media type, and OpenCV's name for it."""

    media_type: str
    suffix: str


CODINGS = {
    "png": Coding("image/png", ".png"),
    "pgm": Coding("image/x-portable-graymap", ".pgm"),
    "jpeg": Coding("image/jpeg", ".jpg"),
}


def parse_query(query: str, defaults: CameraSettings, accept: str) -> tuple[CameraSettings, str]:
    """The settings and the name of the coding that a request asks for.

    Raises:
        ValueError: saying what is wrong with it.
    """
    asked = dict(urllib.parse.parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query)))
    coding = asked.pop("format", None) or _accepted(accept)
    if coding not in CODINGS:
        raise ValueError(f"format must be one of {', '.join(CODINGS)}")
    rate_hz = _number(asked, "rate_hz", defaults.rate_hz)
    exposure_ms = _number(asked, "exposure_ms", defaults.exposure_ms)
    roi = tuple(int(text) for text in asked.pop("roi", ",".join(map(str, defaults.roi))).split(","))
    if asked:
        raise ValueError(f"unknown: {', '.join(asked)}; known are rate_hz, exposure_ms, roi and format")
    if rate_hz > _MAX_RATE_HZ or rate_hz * exposure_ms > 1000.0:
        raise ValueError(f"an exposure of {exposure_ms:g} ms does not fit a rate of {rate_hz:g} Hz")
    if len(roi) != 4:
        raise ValueError("roi must be left,top,width,height")
    left, top, width, height = roi
    _, _, full_width, full_height = defaults.roi
    if min(left, top) < 0 or min(width, height) < 1 or left + width > full_width or top + height > full_height:
        raise ValueError(f"the region does not fit the sensor of {full_width}x{full_height}")
    settings = msgspec.structs.replace(
        defaults, rate_hz=rate_hz, exposure_ms=exposure_ms, roi=(left, top, width, height)
    )
    return settings, coding


def _number(asked: dict[str, str], key: str, otherwise: float) -> float:
    value = float(asked.pop(key, otherwise))
    if not math.isfinite(value) or value <= 0:
        raise ValueError(f"{key} must be a positive number")
    return value


def _accepted(accept: str) -> str:
    named = [choice.partition(";")[0].strip() for choice in accept.split(",")]
    return next((name for media in named for name, coding in CODINGS.items() if coding.media_type == media), "png")


def write_part(raw: RawFrame, coding: Coding) -> bytes:
    """A frame as a part of the stream, with its headers."""
    import cv2

    # OpenCV's own choices: naming a PNG level would switch its fast strategy off, at twice the time.
    body = cv2.imencode(coding.suffix, raw.image)[1].tobytes()
    header = (
        f"--{BOUNDARY}\r\nContent-Type: {coding.media_type}\r\nContent-Length: {len(body)}\r\n"
        f"Frame-Id: {raw.frame_id}\r\n"
    )
    if raw.t_ns is not None:
        header += f"Timestamp: {raw.t_ns}\r\nTimestamp-Uncertainty: {raw.dt_ns}\r\n"
    return header.encode() + b"\r\n" + body + b"\r\n"
