"""The frame source behind `fake://NAME`: exposes on its own grid, delivers late, stamps with an error of its own."""

from __future__ import annotations

import msgspec
import numpy as np

from microdrivers.core.clock import Clock, Timer
from microdrivers.core.errors import LinkLost, UnsupportedError
from microdrivers.core.units import NS_PER_MS, NS_PER_S, seconds_to_ns
from microdrivers.devices.camera import CameraSettings, FrameSink, LossHandler, RawFrame
from microdrivers.fakes.world.microscope_world import MicroscopeWorld
from microdrivers.fakes.world.scene import Renderer

_LATE_FRAMES = 5
_UNPLUGGED = "check its cable and power, then close and open it again"


class FakeFrameSource:
    """A camera that looks at a `MicroscopeWorld`."""

    model = "simulated CCD"

    def __init__(
        self,
        name: str,
        world: MicroscopeWorld,
        *,
        clock: Clock,
        sensor_size_px: tuple[int, int],
        principal_point_px: tuple[float, float],
        seed: int,
    ) -> None:
        self.clock = clock
        self.sensor_size_px = sensor_size_px
        self.serial_number = f"SIM-{name}"
        self.connected = True
        self._world = world
        self._view = world.view(name)
        self._principal_point_px = principal_point_px
        self._random = np.random.default_rng(seed)
        self._settings: CameraSettings | None = None
        self._renderer: Renderer | None = None
        self._timer: Timer | None = None
        self._frames_exposed = 0

    def open(self) -> None:
        """Connect."""
        if not self.connected:
            raise LinkLost("the camera does not answer", remedy=_UNPLUGGED, moved="no")

    def close(self) -> None:
        """Disconnect."""

    def configure(self, wanted: CameraSettings) -> CameraSettings:
        """Apply settings; the exposure is quantised to 0.01 ms as real sensors do, and read back."""
        if wanted.binning != 1 or wanted.pixel_format != "mono8":
            raise UnsupportedError("this sensor offers binning 1 and mono8 only", remedy="configure those")
        exposure_ms = round(wanted.exposure_ms, 2)
        self._settings = msgspec.structs.replace(wanted, exposure_ms=exposure_ms)
        _, _, width, height = wanted.roi
        self._renderer = Renderer(width, height, self._view.look)
        return self._settings

    def start(self, sink: FrameSink, lost: LossHandler) -> None:
        """Expose at the frame rate and deliver each frame some milliseconds after its exposure has ended."""
        settings, renderer = self._settings, self._renderer
        if settings is None or renderer is None:
            raise UnsupportedError("the camera has not been configured", remedy="configure it first")
        period_ns = round(NS_PER_S / settings.rate_hz)
        exposure_ns = round(settings.exposure_ms * NS_PER_MS)
        delay_ns = exposure_ns + seconds_to_ns(self._world.delivery_delay_s)
        first_ns = self.clock.now_ns() + period_ns // 3
        first_id = self._frames_exposed

        def deliver() -> None:
            # Which frame this is follows from the grid, not from the calls: a late call must not shift the stamps.
            newest = round((self.clock.now_ns() - first_ns - delay_ns) / period_ns)
            due = self._frames_exposed - first_id
            # A busy computer makes frames late, as they are behind a busy bus; it loses them only in the end.
            for number in range(max(due, newest - _LATE_FRAMES), newest + 1):
                middle_ns = first_ns + number * period_ns + exposure_ns // 2
                frame_id = first_id + number
                self._frames_exposed = frame_id + 1
                self._deliver(sink, settings, renderer, middle_ns, exposure_ns, frame_id)
            if not self.connected and self._timer is not None:
                self._timer.cancel()
                lost(LinkLost("the camera is gone", remedy=_UNPLUGGED, moved="no"))

        self._timer = self.clock.every(
            period_ns / NS_PER_S, deliver, start_ns=first_ns + delay_ns, name="simulated sensor"
        )

    def stop(self) -> None:
        """End delivery."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _deliver(
        self,
        sink: FrameSink,
        settings: CameraSettings,
        renderer: Renderer,
        middle_ns: int,
        exposure_ns: int,
        frame_id: int,
    ) -> None:
        if not self.connected:
            return
        left, top, _, _ = settings.roi
        pu, pv = self._principal_point_px
        image = self._view.render(
            middle_ns, exposure_ns=exposure_ns, renderer=renderer, principal_point_px=(pu - left, pv - top),
            frame_id=frame_id,
        )  # fmt: skip
        self._view.publish_truth(middle_ns, frame_id)
        times = self._world.settings.camera
        stamp_ns = middle_ns + seconds_to_ns(
            self._world.stamp_error_s + self._random.normal(0.0, times.stamp_jitter_ms / 1000.0)
        )
        late_ns = seconds_to_ns(abs(self._random.normal(0.0, times.delivery_jitter_ms / 1000.0)))
        raw = RawFrame(
            image=image,
            frame_id=frame_id,
            t_ns=stamp_ns,
            dt_ns=seconds_to_ns(times.stated_uncertainty_ms / 1000.0),
        )
        self.clock.call_at(self.clock.now_ns() + late_ns, lambda: sink(raw), name="frame")
