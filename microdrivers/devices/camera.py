"""Cameras, and the frame sources that feed them."""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Literal, Protocol

import msgspec
import numpy.typing as npt

from microdrivers.core.errors import LinkLost, LinkTimeout, OutOfRange, UnsupportedError
from microdrivers.core.samples import DeviceEvent, Frame
from microdrivers.core.units import NS_PER_MS
from microdrivers.devices.base import Device

TriggerMode = Literal["free", "software", "hardware"]
FramePolicy = Literal["latest", "all"]

Roi = tuple[int, int, int, int]
"""Left, top, width, height in full-sensor pixels."""


class CameraSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Settings as the device read them back; `settings_id` changes with every change."""

    exposure_ms: float
    gain: float
    rate_hz: float
    roi: Roi
    binning: int
    pixel_format: str
    settings_id: int = 0


class RawFrame(msgspec.Struct, frozen=True, kw_only=True):
    """What a frame source delivers: pixels and, where the source knows it, the time of mid-exposure.

    `t_ns` is None if the source cannot tell; the camera then uses the arrival with `dt_ns` as stated in the rig file.
    `arrived_ns` is that arrival, for sources that hand frames on later than they receive them.
    """

    image: npt.NDArray[Any]
    frame_id: int
    t_ns: int | None
    dt_ns: int
    arrived_ns: int | None = None


FrameSink = Callable[[RawFrame], None]
LossHandler = Callable[[LinkLost], None]


class FrameSource(Protocol):
    """Where a camera's frames come from. A source calls `sink` for each frame, in its own time."""

    sensor_size_px: tuple[int, int]
    """Width, height of the full sensor."""
    model: str
    serial_number: str

    def open(self) -> None:
        """Connect."""

    def configure(self, wanted: CameraSettings) -> CameraSettings:
        """Apply settings and read them back; those in force stay in force if it raises."""

    def start(self, sink: FrameSink, lost: LossHandler) -> None:
        """Begin to deliver frames; `lost` is called once, after the last frame, if the device disappears."""

    def stop(self) -> None:
        """End delivery."""

    def close(self) -> None:
        """Disconnect."""


class Camera(Device[Frame]):
    """A camera that publishes frames on topic `<name>` while it runs.

    `principal_point_px` is in full-sensor pixels; ((W−1)/2, (H−1)/2) unless the rig file says otherwise.
    """

    sample_type = Frame

    sensor_size_px: tuple[int, int]
    pixel_pitch_um: float
    principal_point_px: tuple[float, float]
    settings: CameraSettings
    trigger_sources: frozenset[str] = frozenset({"free"})

    # ------------------------------------------------------------------ what a driver supplies

    @abstractmethod
    def _configure(self, wanted: CameraSettings) -> CameraSettings:
        """Apply settings and read them back."""

    @abstractmethod
    def _start(self) -> None:
        """Begin to publish frames."""

    @abstractmethod
    def _halt(self) -> None:
        """End publishing."""

    # ------------------------------------------------------------------ public

    def configure(
        self,
        *,
        exposure_ms: float | None = None,
        gain: float | None = None,
        rate_hz: float | None = None,
        roi: Roi | None = None,
        binning: int | None = None,
        pixel_format: str | None = None,
    ) -> CameraSettings:
        """Change settings; returns what the device read back, which may differ from what was asked.

        Raises:
            OutOfRange: the exposure does not fit the rate, or the region does not fit the sensor.
        """
        asked = {
            "exposure_ms": exposure_ms, "gain": gain, "rate_hz": rate_hz, "roi": roi, "binning": binning,
            "pixel_format": pixel_format,
        }  # fmt: skip
        wanted = msgspec.structs.replace(self.settings, **{k: v for k, v in asked.items() if v is not None})
        with self._naming_errors():
            self._require_open()
            self._check_settings(wanted)
            settings_id = self.settings.settings_id + 1
            self.settings = msgspec.structs.replace(self._configure(wanted), settings_id=settings_id)
        self._publish_event("settings_changed")
        return self.settings

    def set_trigger(self, mode: TriggerMode) -> None:
        """Choose what starts an exposure.

        Raises:
            UnsupportedError: the device has no such trigger.
        """
        if mode not in self.trigger_sources:
            raise UnsupportedError(
                f"trigger {mode!r} is not supported",
                device=self.name,
                remedy=f"use {sorted(self.trigger_sources)}",
            )

    def grab(self, *, timeout_s: float = 1.0) -> Frame:
        """A frame whose exposure STARTED after this call; older ones that are still under way are let pass.

        Raises:
            LinkTimeout: none came within `timeout_s`. LinkLost: the camera is gone.
        """
        called_ns = self.clock.now_ns()
        arrived = self.clock.event()
        fresh: list[Frame] = []

        def look(frame: Frame) -> None:
            started_ns = frame.t_ns - round(frame.exposure_ms * NS_PER_MS / 2)
            if not fresh and started_ns - frame.dt_ns >= called_ns:
                fresh.append(frame)
                arrived.set()

        subscriptions = (self.topic.subscribe(look), self.events.subscribe(_when_lost(arrived.set)))
        try:
            with self.running():
                arrived.wait(timeout_s)
        finally:
            for subscription in subscriptions:
                subscription.cancel()
        if not fresh:
            self._check_not_lost()
            raise LinkTimeout(
                f"no frame exposed after the call arrived within {timeout_s:g} s",
                device=self.name,
                moved="no",
                remedy="check that the camera runs, its exposure time and its cable",
            )
        return fresh[0]

    def frames(self, *, policy: FramePolicy = "all", timeout_s: float = 1.0) -> Iterator[Frame]:
        """Frames as they come: every one, or always the newest. Ends only when the caller stops iterating.

        Raises:
            LinkTimeout: none came within `timeout_s`. LinkLost: the camera is gone.
        """
        waiting: deque[Frame] = deque(maxlen=1 if policy == "latest" else None)
        arrived = self.clock.event()

        def take(frame: Frame) -> None:
            waiting.append(frame)
            arrived.set()

        subscriptions = (self.topic.subscribe(take), self.events.subscribe(_when_lost(arrived.set)))
        try:
            with self.running():
                while True:
                    if not waiting and not arrived.wait(timeout_s):
                        raise LinkTimeout(f"no frame within {timeout_s:g} s", device=self.name, moved="no")
                    arrived.clear()
                    while waiting:
                        yield waiting.popleft()
                    self._check_not_lost()
        finally:
            for subscription in subscriptions:
                subscription.cancel()

    def read(self) -> Frame:
        """A fresh frame, as `grab()`; the camera itself has published it."""
        return self.grab()

    @contextmanager
    def stream(self, rate_hz: float) -> Iterator[None]:
        """Deliver frames at `rate_hz` while the context is open."""
        if rate_hz != self.settings.rate_hz:
            self.configure(rate_hz=rate_hz)
        with self.running():
            yield

    def running(self) -> _Running:
        """Context in which the camera delivers frames; may be nested."""
        return _Running(self)

    def _check_settings(self, wanted: CameraSettings) -> None:
        left, top, width, height = wanted.roi
        sensor_width, sensor_height = self.sensor_size_px
        if (
            left < 0
            or top < 0
            or width < 1
            or height < 1
            or left + width > sensor_width
            or top + height > sensor_height
        ):
            raise OutOfRange(
                f"region {wanted.roi} does not fit the sensor of {sensor_width}×{sensor_height} px",
                remedy="give left, top, width, height in full-sensor pixels",
            )
        if not wanted.rate_hz > 0 or not 0 < wanted.exposure_ms <= 1000 / wanted.rate_hz:
            raise OutOfRange(
                f"an exposure of {wanted.exposure_ms:g} ms does not fit a rate of {wanted.rate_hz:g} Hz",
                remedy="shorten the exposure or lower the rate",
            )

    def _read(self) -> Frame:
        return self.grab()

    # ------------------------------------------------------------------ loss

    _loss: LinkLost | None = None

    def _lose(self, error: LinkLost) -> None:
        """For drivers, from any thread: the device is gone. Whoever waits for a frame is woken."""
        if self.link != "open":
            return
        self._loss = error
        self.link = "lost"
        self._publish_event("link_lost", reason=error.what)

    def _check_not_lost(self) -> None:
        if self.link == "lost" and self._loss is not None:
            raise LinkLost(self._loss.what, remedy=self._loss.remedy, device=self.name, moved="no")

    # ------------------------------------------------------------------ running

    _users: int = 0

    def _enter(self) -> None:
        self._require_open()
        self._users += 1
        if self._users == 1:
            self._start()

    def _leave(self) -> None:
        self._users -= 1
        if self._users == 0 and self.link != "closed":
            self._halt()


class _Running:
    def __init__(self, camera: Camera) -> None:
        self._camera = camera

    def __enter__(self) -> None:
        self._camera._enter()

    def __exit__(self, *_: object) -> None:
        self._camera._leave()


def _when_lost(call: Callable[[], None]) -> Callable[[DeviceEvent], None]:
    def look(event: DeviceEvent) -> None:
        if event.kind == "link_lost":
            call()

    return look
