"""Rig-file settings of a camera."""

from __future__ import annotations

import difflib
from typing import Annotated, Literal

import pydantic

from microdrivers.devices.drivers import DeviceSettings
from microdrivers.devices.frame_sources import known_schemes

_Pixels = Annotated[int, pydantic.Field(gt=0, le=20_000)]


class CameraDeviceSettings(DeviceSettings):
    """A camera.

    `source` is a URL whose scheme names a frame source:

    | source | what it is |
    |---|---|
    | `v4l2:///dev/video0`, `v4l2://0` | Video4Linux camera or frame grabber; options: see `opencv_source` |
    | `mjpeg+http://127.0.0.1:8080/camera_fine` | HTTP stream of images, as `microdrivers serve` sends |
    | `images:///folder/img_%04d.png` | numbered images of a folder, played at `rate_hz` |
    | `video:///path/film.avi` | a film, played at `rate_hz` |

    `view` says whether it looks down on the stage's plane or along it. `sensor_size_px` is width, height;
    `principal_point_px` is where the optical axis meets the sensor, full-sensor pixels from the centre of the top-left
    pixel (default: the middle). `arrival_delay_ms` ± `arrival_uncertainty_ms` (95 %) say how long after mid-exposure a
    frame arrives; they are used only for sources that cannot tell the time of capture.
    """

    driver: Literal["camera"] = "camera"
    source: str
    sensor_size_px: tuple[_Pixels, _Pixels]
    view: Literal["top", "lateral"] = "top"
    pixel_pitch_um: float = pydantic.Field(gt=0, le=100)
    principal_point_px: tuple[float, float] | None = None
    rate_hz: float = pydantic.Field(default=30.0, gt=0, le=10_000)
    exposure_ms: float = pydantic.Field(default=2.0, gt=0)
    gain: float = pydantic.Field(default=1.0, gt=0)
    arrival_delay_ms: float = pydantic.Field(default=20.0, ge=0)
    arrival_uncertainty_ms: float = pydantic.Field(default=20.0, gt=0)

    @pydantic.field_validator("source")
    @classmethod
    def _of_a_known_kind(cls, source: str) -> str:
        scheme, separator, _ = source.partition("://")
        known = known_schemes()
        if not separator or scheme not in known:
            close = difflib.get_close_matches(scheme, known, n=1) if separator else []
            hint = f"did you mean {close[0]}://?" if close else f"begin it with one of {', '.join(known)}, then ://"
            raise ValueError(f"source {source!r} names no installed frame source; {hint}")
        return source

    @pydantic.model_validator(mode="after")
    def _exposure_fits(self) -> CameraDeviceSettings:
        if self.exposure_ms * self.rate_hz > 1000:
            raise ValueError(f"exposure_ms = {self.exposure_ms:g} does not fit rate_hz = {self.rate_hz:g}")
        return self

    def claims(self) -> tuple[str, ...]:
        """The camera, unless many may watch it."""
        return (f"camera {self.source}",) if self.source.startswith("v4l2") else ()
