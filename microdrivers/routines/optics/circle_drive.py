"""Along a circle: in motion at frame rate, or from point to point at rest."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from typing import NamedTuple

from microdrivers.core.clock import Clock, Timer
from microdrivers.core.errors import LinkTimeout
from microdrivers.core.samples import Frame
from microdrivers.core.units import NS_PER_MS, NS_PER_S, seconds_to_ns
from microdrivers.devices.camera import Camera
from microdrivers.devices.xytheta_stage import XYThetaStage
from microdrivers.devices.zoom_motor import ZoomMotor
from microdrivers.routines.progress import Progress

_LEAD_FRAMES = 2.5
"""The stage is sent to where the circle will be so many frames later: far enough that it never brakes."""
_TURN_SHARE = 1 / 3
"""Where between two exposures the stage changes its velocity, as a share of the period after the earlier one: a pose
after that exposure is read before, and the servo settles before the last pose ahead of the next one."""
_COMMAND_LEAD_S = 0.0095
"""From sending a target to the change of velocity: bytes on the line, and a poll that may be under way."""
_LEAD_IN_FRAMES = 6
_OLDEST_POSE_S = 0.1
_SILENCE_NS = NS_PER_S
_BRACKET_S = 0.045
"""Until the slowest stream has surely brought a sample that is younger than the newest frame."""


class Circle(NamedTuple):
    """Where the stage goes."""

    centre_um: tuple[float, float]
    radius_um: float

    def at(self, angle: float) -> tuple[float, float]:
        """The point at an angle, radians from +X."""
        x_um, y_um = self.centre_um
        return x_um + self.radius_um * math.cos(angle), y_um + self.radius_um * math.sin(angle)


class Instruments(NamedTuple):
    """What moves and looks."""

    stage: XYThetaStage
    zoom: ZoomMotor
    camera: Camera
    clock: Clock

    def stop(self) -> None:
        """Nothing moves any more."""
        self.stage.stop(by="calibration", reason="the way along the circle ended")
        self.zoom.stop(by="calibration", reason="the way along the circle ended")


class Pace(NamedTuple):
    """How the circle is gone along; the zoom changes after frame `change_after_frame`, counted from 0."""

    radians_per_frame: float
    frames: int
    change_after_frame: int
    zoom_to: float
    pose_rate_hz: float
    zoom_rate_hz: float


def fastest_um_s(stage: XYThetaStage) -> float:
    """A path speed that leaves the stage room to catch up."""
    return 0.8 * min(stage.max_speed["x"], stage.max_speed["y"])


def step_along(devices: Instruments, circle: Circle, pace: Pace, begin: Callable[[], None], progress: Progress) -> None:
    """From point to point: move, settle, then grab. Times need not be known better than the stage stands still."""
    with ExitStack() as stack:
        stack.enter_context(devices.stage.stream(pace.pose_rate_hz))
        stack.enter_context(devices.zoom.stream(pace.zoom_rate_hz))
        stack.callback(devices.stop)
        progress.step("calibrating on the circle, at rest")
        begin()
        for number in range(pace.frames):
            if number == pace.change_after_frame + 1:
                devices.zoom.move_to(zoom=pace.zoom_to)
            x_um, y_um = circle.at(number * pace.radians_per_frame)
            devices.stage.move_to(x_um=x_um, y_um=y_um)
            frame = devices.camera.grab()
            # The stage stays until poses surely lie on either side of the frame.
            devices.clock.sleep(frame.dt_ns / NS_PER_S + _BRACKET_S)
            progress.count(number + 1, pace.frames)


def stream_along(
    devices: Instruments, circle: Circle, pace: Pace, begin: Callable[[], None], progress: Progress
) -> None:
    """In motion: stream targets to the stage at frame rate. GCS knows no circle."""
    with ExitStack() as stack:
        stack.enter_context(devices.stage.stream(pace.pose_rate_hz))
        stack.enter_context(devices.zoom.stream(pace.zoom_rate_hz))
        arrivals = _Arrivals(devices.camera)
        stack.callback(arrivals.close)
        stack.enter_context(devices.camera.running())
        stack.callback(devices.stop)  # the last to enter is the first to leave: stop, then wait for threads to end
        arrivals.await_frames(devices.clock, 1)
        pursuit = _Pursuit(devices, circle, pace, arrivals)
        for _ in range(_LEAD_IN_FRAMES):
            pursuit.steer()
        progress.step("calibrating on the circle")
        begin()
        arrivals.restart_count()
        zoom_change: Timer | None = None
        while arrivals.count < pace.frames:
            if zoom_change is None and arrivals.count:
                zoom_change = _schedule_zoom_change(devices, pace, arrivals)
                stack.callback(zoom_change.cancel)
            pursuit.steer()
            progress.count(min(arrivals.count, pace.frames), pace.frames)
        # The last frame still needs a pose and a zoom sample after it.
        devices.clock.sleep(_BRACKET_S)


def _schedule_zoom_change(devices: Instruments, pace: Pace, arrivals: _Arrivals) -> Timer:
    """Command the zoom when the frame after which it is to change has been exposed.

    On the clock and not in the steering loop: the stage must not wait for the zoom's reply.
    """
    exposure_ns = round(devices.camera.settings.exposure_ms * NS_PER_MS)
    due_ns = arrivals.first_ns + pace.change_after_frame * arrivals.period_ns + exposure_ns
    return devices.clock.call_at(due_ns, lambda: devices.zoom.start_move_to(zoom=pace.zoom_to), name="zoom change")


class _Pursuit:
    """Sends the stage after a point that runs ahead on the circle."""

    def __init__(self, devices: Instruments, circle: Circle, pace: Pace, arrivals: _Arrivals) -> None:
        self._devices = devices
        self._circle = circle
        self._arrivals = arrivals
        self._radians_per_ns = pace.radians_per_frame / arrivals.period_ns
        self._started_ns = devices.clock.now_ns()

    def steer(self) -> None:
        """Command the next target so that the stage changes its velocity well between two exposures.

        It then runs at constant velocity around each exposure, and its pose may be interpolated there.
        """
        clock, stage = self._devices.clock, self._devices.stage
        now_ns = clock.now_ns()
        self._arrivals.check_alive(now_ns)
        command_ns = seconds_to_ns(_COMMAND_LEAD_S)
        turn_ns = self._arrivals.next_after_exposure_ns(now_ns + command_ns, share=_TURN_SHARE)
        clock.sleep_until(turn_ns - command_ns)
        lead_ns = round(_LEAD_FRAMES * self._arrivals.period_ns)
        x_um, y_um = self._circle.at(self._radians_per_ns * (turn_ns - self._started_ns + lead_ns))
        pose = stage.latest(max_age_s=_OLDEST_POSE_S)
        speed_um_s = math.hypot(x_um - pose.x_um, y_um - pose.y_um) * NS_PER_S / lead_ns
        stage.start_move_to(x_um=x_um, y_um=y_um, speed_um_s=min(speed_um_s, fastest_um_s(stage)))


class _Arrivals:
    """The times of a camera's frames: how many have come, and when the next will be exposed."""

    def __init__(self, camera: Camera) -> None:
        self.period_ns = round(NS_PER_S / camera.settings.rate_hz)
        self.count = 0
        self.first_ns = 0
        self._latest_ns = 0
        self._seen = 0
        self._camera = camera
        self._subscription = camera.topic.subscribe(self._arrived)

    def close(self) -> None:
        """Stop listening."""
        self._subscription.cancel()

    def restart_count(self) -> None:
        """Count from the next frame on."""
        self.count = 0

    def next_after_exposure_ns(self, now_ns: int, *, share: float) -> int:
        """The first instant after `now_ns` that lies this share of a period after a mid-exposure, by the grid."""
        grid_ns = self._latest_ns + round(share * self.period_ns)
        return grid_ns + ((now_ns - grid_ns) // self.period_ns + 1) * self.period_ns

    def await_frames(self, clock: Clock, number: int) -> None:
        """Wait until so many frames have come."""
        begun_ns = clock.now_ns()
        while self._seen < number:
            self._latest_ns = self._latest_ns or begun_ns
            self.check_alive(clock.now_ns())
            clock.sleep(0.002)

    def check_alive(self, now_ns: int) -> None:
        """Raise if the camera has fallen silent."""
        if now_ns - self._latest_ns > _SILENCE_NS:
            raise LinkTimeout(
                f"no frame for {(now_ns - self._latest_ns) / NS_PER_S:.1f} s", device=self._camera.name,
                remedy="check the camera's cable and power",
            )  # fmt: skip

    def _arrived(self, frame: Frame) -> None:
        if self.count == 0:
            self.first_ns = frame.t_ns
        self.count += 1
        self._seen += 1
        self._latest_ns = frame.t_ns
