"""The paper's experiment: a target on a circle, and a zoom change half-way (Bilen et al., section III.B)."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.core.clock import Clock, Timer
from microdrivers.core.errors import (
    CalibrationError,
    ConfigError,
    LinkTimeout,
    NotReferenced,
    OutOfRange,
    TargetLost,
    UnsupportedError,
)
from microdrivers.core.samples import Frame, TrackedPoint
from microdrivers.core.units import NS_PER_MS, NS_PER_S, Range, check_range, seconds_to_ns
from microdrivers.devices.camera import Camera
from microdrivers.devices.xytheta_stage import XYThetaStage
from microdrivers.devices.zoom_motor import ZoomMotor
from microdrivers.estimators.optics.calibrator import PointTracker
from microdrivers.rig import Rig
from microdrivers.routines.optics.source import Optics, SourceNames
from microdrivers.routines.optics.targets import make_tracker
from microdrivers.routines.progress import Progress

Array = npt.NDArray[np.float64]

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
_SMALLEST_RADIUS_UM = 50.0
_LARGEST_RADIUS_UM = 10_000.0
_PAPER_RADIUS_UM = 300.0
_SCALE_TRUST = 2.0
"""The observed scale may differ from objective × zoom by this factor before units are suspected."""


class CircleSettings(NamedTuple):
    """The experiment's figures; defaults are the paper's.

    `radius_um` None means the paper's 300 µm, or as much of it as fits the view; a stated radius must fit.
    `change_after_frame` is 0-based: the zoom is commanded once that frame has been exposed.
    """

    radius_um: float | None = None
    degrees_per_frame: float = 4.0
    zoom_from: float = 0.9
    zoom_to: float = 1.2
    change_after_frame: int = 44
    frames: int = 100
    probe_um: float = 50.0
    pose_rate_hz: float = 100.0
    zoom_rate_hz: float = 70.0
    margin_px: float = 20.0


class CircleExperiment:
    """Finds the target, centres it, streams the stage along a circle and changes the zoom on the way."""

    def __init__(self, rig: Rig, settings: CircleSettings | None = None) -> None:
        section = rig.file.microscope
        if section is None:
            raise ConfigError(
                "the rig file has no microscope section, which an optical calibration needs",
                file=str(rig.description.file),
                remedy="add a microscope section: sample_stage, zoom, camera, objective, target",
            )
        self.settings = settings or CircleSettings()
        if section.target.kind == "texture" and self.settings.zoom_to != self.settings.zoom_from:
            raise UnsupportedError(
                "texture is tracked against a fixed template, which no longer fits once the zoom has changed",
                remedy="use a square target, or calibrate at one zoom: --zoom-from Z --zoom-to Z",
            )
        self.bus = rig.bus
        self.clock = rig.clock
        self.names = SourceNames(section.sample_stage, section.zoom, section.camera)
        self._rig = rig
        self._section = section
        self._stage = rig.device(section.sample_stage, XYThetaStage)
        self._zoom = rig.device(section.zoom, ZoomMotor)
        self._camera = rig.device(section.camera, Camera)
        self._reach_px = 0.0
        self._check_settings()

    def _check_settings(self) -> None:
        asked = self.settings
        if asked.radius_um is not None:
            what = "radius of the circle"
            check_range(asked.radius_um, Range(_SMALLEST_RADIUS_UM, _LARGEST_RADIUS_UM), what=what, unit="µm")
        for name, zoom in (("zoom before the change", asked.zoom_from), ("zoom after the change", asked.zoom_to)):
            check_range(zoom, self._zoom.zoom_range, what=name, unit="x", device=self._zoom.name)

    def optics(self) -> Optics:
        """The rig's optics with the camera's present settings."""
        camera = self._camera.settings
        return Optics(
            camera=self.names.camera, binning=camera.binning, roi=camera.roi, objective=self._section.objective,
            pixel_pitch_um=self._camera.pixel_pitch_um * camera.binning,
        )  # fmt: skip

    def frames_expected(self) -> int:
        """Frames on the circle."""
        return self.settings.frames

    def run(self, begin: Callable[[PointTracker], None], progress: Progress) -> None:
        """Run the experiment; whatever happens, the stage and the zoom stand still afterwards."""
        try:
            self._prepare(progress)
            progress.step("finding the target")
            jacobian, corner = self._find_target()
            centre, radius_um = self._plan(jacobian, corner)
            progress.step(f"circle of {radius_um:.0f} µm about ({centre[0]:.0f}, {centre[1]:.0f}) µm")
            self._stage.move_to(x_um=centre[0] + radius_um, y_um=centre[1])
            near_px = jacobian @ np.array([radius_um, 0.0])
            tracker = make_tracker(self._section.target.kind, near_px=(float(near_px[0]), float(near_px[1])))
            self._require_found(tracker.update(self._camera.grab()))
            self._stream(centre, radius_um, lambda: begin(tracker), progress)
        finally:
            self._stage.stop(by="calibration", reason="the experiment ended")
            self._zoom.stop(by="calibration", reason="the experiment ended")

    # ------------------------------------------------------------------ before the circle

    def _prepare(self, progress: Progress) -> None:
        unknown = [axis for axis, known in self._stage.referenced.items() if not known]
        if unknown and self._rig.fake:
            progress.step(f"referencing {', '.join(unknown)} (emulated stage)")
            self._stage.reference(unknown)
        elif unknown:
            raise NotReferenced(
                f"the reference of axis {', '.join(unknown)} is not known; a calibration never references by itself",
                device=self._stage.name,
                remedy=f"clear the way, then: microdrivers reference {self._rig.description.file} "
                f"--axes {','.join(unknown)}",
            )
        progress.step(f"zoom to {self.settings.zoom_from:g}")
        self._zoom.move_to(zoom=self.settings.zoom_from)
        pose = self._stage.read()
        # θ is commanded where it stands, so that its servo holds it through the calibration.
        step = self._stage.resolution["theta"]
        self._stage.move_to(theta_deg=round(pose.theta_deg / step) * step)

    def _find_target(self) -> tuple[Array, Array]:
        """∂(u, v)/∂(X, Y) from two small moves, and where the tracked point is now with the stage where it is now."""
        tracker = make_tracker(self._section.target.kind)
        start = self._stage.read()
        points, poses = [], []
        for dx_um, dy_um in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)):
            pose = self._stage.move_to(
                x_um=start.x_um + dx_um * self._probe_um("x", start.x_um),
                y_um=start.y_um + dy_um * self._probe_um("y", start.y_um),
            )
            point = self._require_found(tracker.update(self._camera.grab()))
            points.append((point.u_px, point.v_px))
            poses.append((pose.x_um, pose.y_um))
        moved = np.diff(np.array(poses)[[0, 1, 0, 2]], axis=0)[[0, 2]]
        seen = np.diff(np.array(points)[[0, 1, 0, 2]], axis=0)[[0, 2]]
        jacobian = np.linalg.solve(moved, seen).T
        self._check_scale(jacobian)
        self._reach_px = tracker.reach_px
        # Where the point would be with the stage at the origin of its coordinates.
        corner = np.array(points[-1]) - jacobian @ np.array(poses[-1])
        return jacobian, corner

    def _probe_um(self, axis: str, position_um: float) -> float:
        """The probing step, towards the middle of the travel."""
        limits = self._stage.limits[axis]
        return math.copysign(self.settings.probe_um, 0.5 * (limits.min + limits.max) - position_um)

    def _check_scale(self, jacobian: Array) -> None:
        observed = math.sqrt(abs(float(np.linalg.det(jacobian))))
        nominal = (
            self.settings.zoom_from * self._section.objective * self._section.adapter / self._camera.pixel_pitch_um
        )
        if not nominal / _SCALE_TRUST < observed < nominal * _SCALE_TRUST:
            raise CalibrationError(
                f"a move of {self.settings.probe_um:g} µm shifts the image by "
                f"{observed * self.settings.probe_um:.2f} px, "
                f"but {nominal * self.settings.probe_um:.2f} px are expected at zoom {self.settings.zoom_from:g}",
                remedy="check the units of the stage axes, pixel_pitch_um, objective, adapter and the zoom curve",
                moved="yes",
            )

    def _require_found(self, point: TrackedPoint) -> TrackedPoint:
        if point.found:
            return point
        why = ", ".join(sorted(point.flags)).replace("_", " ") or "not found"
        raise TargetLost(
            f"the target ({self._section.target.kind}) is not wholly in view: {why}",
            device=self._camera.name,
            remedy="move the target to the middle of the view, focus, check light and exposure, then start again",
            moved="yes",
        )

    def _plan(self, jacobian: Array, corner: Array) -> tuple[tuple[float, float], float]:
        """Centre and radius of a circle that brings the tracked point about the image's centre and stays in view."""
        x_um, y_um = (float(value) for value in np.linalg.solve(jacobian, -corner))
        scale = math.sqrt(abs(float(np.linalg.det(jacobian))))
        growth = max(1.0, self.settings.zoom_to / self.settings.zoom_from)
        _, _, width, height = self._camera.settings.roi
        room_px = 0.5 * min(width, height) / self._camera.settings.binning - self.settings.margin_px
        in_view_um = (room_px / growth - self._reach_px) / scale
        limits = self._stage.limits
        in_travel_um = min(
            x_um - limits["x"].min, limits["x"].max - x_um, y_um - limits["y"].min, limits["y"].max - y_um
        )
        in_speed_um = self._fastest_um_s() / self._angular_speed()
        fits_um = min(in_view_um, in_travel_um, in_speed_um)
        asked_um = self.settings.radius_um
        needed_um = _SMALLEST_RADIUS_UM if asked_um is None else asked_um
        if fits_um < needed_um:
            raise OutOfRange(
                f"only a circle of {max(fits_um, 0.0):.0f} µm fits (view {max(in_view_um, 0.0):.0f} µm, travel "
                f"{in_travel_um:.0f} µm, speed {in_speed_um:.0f} µm); {needed_um:.0f} µm are needed",
                remedy="use a smaller radius, a smaller target or a lower zoom, or bring the target nearer to the "
                "middle of the travel",
            )
        return (x_um, y_um), min(_PAPER_RADIUS_UM, fits_um) if asked_um is None else asked_um

    def _angular_speed(self) -> float:
        return math.radians(self.settings.degrees_per_frame) * self._camera.settings.rate_hz

    def _fastest_um_s(self) -> float:
        return 0.8 * min(self._stage.max_speed["x"], self._stage.max_speed["y"])

    # ------------------------------------------------------------------ on the circle

    def _stream(
        self, centre: tuple[float, float], radius_um: float, begin: Callable[[], None], progress: Progress
    ) -> None:
        with ExitStack() as stack:
            stack.enter_context(self._stage.stream(self.settings.pose_rate_hz))
            stack.enter_context(self._zoom.stream(self.settings.zoom_rate_hz))
            arrivals = _Arrivals(self._camera)
            stack.callback(arrivals.close)
            stack.enter_context(self._camera.running())
            arrivals.await_frames(self.clock, 1)
            started_ns = self.clock.now_ns()
            for _ in range(_LEAD_IN_FRAMES):
                self._steer(centre, radius_um, started_ns, arrivals)
            progress.step("calibrating on the circle")
            begin()
            arrivals.restart_count()
            zoom_change: Timer | None = None
            while arrivals.count < self.settings.frames:
                if zoom_change is None and arrivals.count:
                    zoom_change = self._schedule_zoom_change(arrivals)
                    stack.callback(zoom_change.cancel)
                self._steer(centre, radius_um, started_ns, arrivals)
                progress.count(min(arrivals.count, self.settings.frames), self.settings.frames)
            # The last frame still needs a pose and a zoom sample after it.
            self.clock.sleep(3.0 / min(self.settings.pose_rate_hz, self.settings.zoom_rate_hz))

    def _schedule_zoom_change(self, arrivals: _Arrivals) -> Timer:
        """Command the zoom when the frame after which it is to change has been exposed.

        On the clock and not in the steering loop: the stage must not wait for the zoom's reply.
        """
        exposure_ns = round(self._camera.settings.exposure_ms * NS_PER_MS)
        due_ns = arrivals.first_ns + self.settings.change_after_frame * arrivals.period_ns + exposure_ns
        return self.clock.call_at(
            due_ns, lambda: self._zoom.start_move_to(zoom=self.settings.zoom_to), name="zoom change"
        )

    def _steer(self, centre: tuple[float, float], radius_um: float, started_ns: int, arrivals: _Arrivals) -> None:
        """Command the next target so that the stage changes its velocity well between two exposures.

        It then runs at constant velocity around each exposure, and its pose may be interpolated there.
        """
        now_ns = self.clock.now_ns()
        arrivals.check_alive(now_ns)
        command_ns = seconds_to_ns(_COMMAND_LEAD_S)
        turn_ns = arrivals.next_after_exposure_ns(now_ns + command_ns, share=_TURN_SHARE)
        self.clock.sleep_until(turn_ns - command_ns)
        lead_s = _LEAD_FRAMES * arrivals.period_ns / NS_PER_S
        elapsed_s = (turn_ns - started_ns) / NS_PER_S
        angle = self._angular_speed() * (elapsed_s + lead_s)
        x_um = centre[0] + radius_um * math.cos(angle)
        y_um = centre[1] + radius_um * math.sin(angle)
        pose = self._stage.latest(max_age_s=_OLDEST_POSE_S)
        speed_um_s = math.hypot(x_um - pose.x_um, y_um - pose.y_um) / lead_s
        self._stage.start_move_to(x_um=x_um, y_um=y_um, speed_um_s=min(speed_um_s, self._fastest_um_s()))


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
