"""A camera whose pixels come from a frame source; adds time, identity and checks."""

from __future__ import annotations

import logging

import msgspec

from microdrivers.backends.camera.settings import CameraDeviceSettings
from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.core.errors import UnsupportedError
from microdrivers.core.samples import Frame
from microdrivers.core.units import NS_PER_MS
from microdrivers.devices.base import DeviceInfo
from microdrivers.devices.camera import Camera, CameraSettings, FrameSource, RawFrame
from microdrivers.devices.frame_sources import find_frame_source

_log = logging.getLogger(__name__)


class SourceCamera(Camera):
    """Publishes the frames of a `FrameSource`, stamped at mid-exposure.

    A frame whose shape is not that of the region that the device confirmed is refused and counted in `bad_frames`.
    """

    def __init__(self, name: str, settings: CameraDeviceSettings, *, clock: Clock, bus: Bus) -> None:
        super().__init__(name, clock=clock, bus=bus)
        self.bad_frames = 0
        self._rig = settings
        self._source: FrameSource | None = None
        self._last_frame_id: int | None = None
        width, height = settings.sensor_size_px
        self.sensor_size_px = settings.sensor_size_px
        self.pixel_pitch_um = settings.pixel_pitch_um
        self.principal_point_px = settings.principal_point_px or ((width - 1) / 2, (height - 1) / 2)
        self.settings = CameraSettings(
            exposure_ms=settings.exposure_ms, gain=settings.gain, rate_hz=settings.rate_hz,
            roi=(0, 0, width, height), binning=1, pixel_format="mono8",
        )  # fmt: skip

    def _connect(self) -> None:
        source = find_frame_source(self._rig.source, self.clock)
        source.open()
        self._source = source

    def _identify(self) -> DeviceInfo:
        source = self._source
        assert source is not None
        self._check_identity(source)
        self.settings = source.configure(self.settings)
        if self._users:  # it was lost and is back while somebody waits for frames
            source.start(self._take, self._lose)
        return DeviceInfo(driver="camera", model=source.model, serial_number=source.serial_number)

    def _close(self) -> None:
        source, self._source = self._source, None
        if source is not None:
            source.stop()
            source.close()

    def _stop(self) -> None:
        """A camera does not move."""

    def _configure(self, wanted: CameraSettings) -> CameraSettings:
        source = self._require_source()
        if not self._users:
            return source.configure(wanted)
        source.stop()
        try:
            confirmed = source.configure(wanted)
            # Known before the first frame that has them.
            self.settings = msgspec.structs.replace(confirmed, settings_id=self.settings.settings_id + 1)
        finally:
            source.start(self._take, self._lose)
        return confirmed

    def _start(self) -> None:
        self._last_frame_id = None
        self._require_source().start(self._take, self._lose)

    def _halt(self) -> None:
        if self._source is not None:
            self._source.stop()

    def _check_identity(self, source: FrameSource) -> None:
        if source.sensor_size_px != self.sensor_size_px:
            raise UnsupportedError(
                f"the camera has {source.sensor_size_px} px, the rig file says {self.sensor_size_px}",
                remedy="correct sensor_size_px in the rig file, or check that it is the right camera",
            )
        known = self.info.serial_number
        if known and source.serial_number != known:
            raise UnsupportedError(
                f"camera {source.serial_number or 'without a serial number'} answers in the place of {known}",
                remedy="connect the camera that was there before, or open the rig anew",
            )

    def _require_source(self) -> FrameSource:
        self._require_open()
        assert self._source is not None
        return self._source

    def _take(self, raw: RawFrame) -> None:
        left, top, width, height = self.settings.roi
        binning = self.settings.binning
        if raw.image.shape[:2] != (height // binning, width // binning):
            self.bad_frames += 1
            if self.bad_frames == 1:
                _log.warning(
                    "%s: a frame of shape %s was refused (further ones are counted)",
                    self.name,
                    raw.image.shape,
                )
            return
        dropped = 0 if self._last_frame_id is None else raw.frame_id - self._last_frame_id - 1
        self._last_frame_id = raw.frame_id
        raw.image.flags.writeable = False
        pu, pv = self.principal_point_px
        centre = (binning - 1) / 2
        t_ns, dt_ns = raw.t_ns, raw.dt_ns
        if t_ns is None:
            arrived_ns = raw.arrived_ns if raw.arrived_ns is not None else self.clock.now_ns()
            t_ns = arrived_ns - round(self._rig.arrival_delay_ms * NS_PER_MS)
            dt_ns = round(self._rig.arrival_uncertainty_ms * NS_PER_MS)
        self.topic.publish(
            Frame(
                t_ns=t_ns,
                dt_ns=dt_ns,
                t_source="device" if raw.t_ns is not None else "arrival",
                device=self.name,
                seq=self._next_seq(),
                image=raw.image,
                exposure_ms=self.settings.exposure_ms,
                frame_id=raw.frame_id,
                dropped_before=dropped,
                settings_id=self.settings.settings_id,
                bit_depth=8 * raw.image.itemsize,
                principal_point_px=((pu - left - centre) / binning, (pv - top - centre) / binning),
            )
        )
