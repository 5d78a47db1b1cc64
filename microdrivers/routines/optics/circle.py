"""The paper's experiment: a target on a circle, and a zoom change half-way (Bilen et al., section III.B)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.core.errors import (
    CalibrationError,
    ConfigError,
    NotReferenced,
    OutOfRange,
    TargetLost,
    UnsupportedError,
)
from microdrivers.core.samples import Frame, TrackedPoint
from microdrivers.core.units import NS_PER_MS, NS_PER_S, Range, check_range
from microdrivers.devices.camera import Camera
from microdrivers.devices.xytheta_stage import XYThetaStage
from microdrivers.devices.zoom_motor import ZoomMotor
from microdrivers.estimators.optics.calibrator import PointTracker
from microdrivers.rig import Rig
from microdrivers.routines.notes import note
from microdrivers.routines.optics.circle_drive import (
    Circle,
    Instruments,
    Pace,
    fastest_um_s,
    step_along,
    stream_along,
)
from microdrivers.routines.optics.source import BEGIN, Optics, SourceNames
from microdrivers.routines.optics.targets import make_tracker
from microdrivers.routines.past_run import PastRun
from microdrivers.routines.progress import Progress

Array = npt.NDArray[np.float64]

LARGEST_TIME_UNCERTAINTY_NS = 200_000
"""Half-width (95 %) of the time between pose and frame up to which frames are taken in motion: 0.2 ms are 0.024°."""
_SMALLEST_RADIUS_UM = 50.0
_LARGEST_RADIUS_UM = 10_000.0
_FRAMES_TO_SETTLE = 12
_TIMED_READS = 5
_POSES_PER_FRAME = 3.0
"""Poses for each frame in motion: fewer, and the line between two of them cuts the circle's corner."""
_PAPER_RADIUS_UM = 300.0
_SCALE_TRUST = 2.0
"""The observed scale may differ from objective × zoom by this factor before units are suspected."""


class CircleSettings(NamedTuple):
    """The experiment's figures; defaults are the paper's.

    `radius_um` None means the paper's 300 µm, or as much of it as fits the view; a stated radius must fit.
    `change_after_frame` is 0-based: the zoom is commanded once that frame has been exposed. `settled` True stops at
    each point before the frame is taken, False never does; None decides by how well the times of poses and frames
    are known.
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
    settled: bool | None = None

    def pace(self) -> Pace:
        """What the drive along the circle needs of these settings."""
        return Pace(
            radians_per_frame=self.radians_per_frame,
            frames=self.frames,
            change_after_frame=self.change_after_frame,
            zoom_to=self.zoom_to,
            pose_rate_hz=self.pose_rate_hz,
            zoom_rate_hz=self.zoom_rate_hz,
        )

    @property
    def radians_per_frame(self) -> float:
        """Angle between two frames."""
        return math.radians(self.degrees_per_frame)


class CircleExperiment:
    """Finds the target, centres it, streams the stage along a circle and changes the zoom on the way."""

    past_run = PastRun()
    past_settings = None

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
        self._settled = bool(self.settings.settled)
        self._check_settings()

    def _check_settings(self) -> None:
        asked = self.settings
        if asked.radius_um is not None:
            what = "radius of the circle"
            check_range(
                asked.radius_um, Range(_SMALLEST_RADIUS_UM, _LARGEST_RADIUS_UM), what=what, unit="µm", in_file=""
            )
        needed = asked.change_after_frame + 1 + _FRAMES_TO_SETTLE
        if asked.zoom_to != asked.zoom_from and asked.frames < needed:
            raise OutOfRange(
                f"{asked.frames} frames end before the calibration can settle after the zoom change",
                remedy=f"take at least {needed} frames, or stay at one zoom: --zoom-from Z --zoom-to Z",
            )
        for name, zoom in (("zoom before the change", asked.zoom_from), ("zoom after the change", asked.zoom_to)):
            check_range(zoom, self._zoom.zoom_range, what=name, unit="x", device=self._zoom.name)

    def optics(self) -> Optics:
        """The rig's optics with the camera's present settings."""
        camera = self._camera.settings
        return Optics(
            camera=self.names.camera, binning=camera.binning, roi=camera.roi, objective=self._section.objective,
            pixel_pitch_um=self._camera.pixel_pitch_um * camera.binning,
        )  # fmt: skip

    def frames_expected(self) -> int | None:
        """Frames on the circle; None at rest, where a point may give more than one."""
        return None if self._settled else self.settings.frames

    def run(self, begin: Callable[[PointTracker], None], progress: Progress) -> None:
        """Run the experiment; whatever happens, the stage and the zoom stand still afterwards."""
        try:
            self._prepare(progress)
            progress.step("finding the target")
            jacobian, corner = self._find_target()
            centre, radius_um = self._plan(jacobian, corner)
            progress.step(f"circle of {radius_um:.0f} µm about ({centre[0]:.0f}, {centre[1]:.0f}) µm")
            self._stage.move_to(x_um=centre[0] + radius_um, y_um=centre[1])
            near_px = tuple((jacobian @ np.array([radius_um, 0.0])).tolist())
            tracker = make_tracker(self._section.target.kind, near_px=near_px)
            frame = self._camera.grab()
            self._require_found(tracker.update(frame))

            def start() -> None:
                self._note_beginning(near_px, frame)
                begin(tracker)

            self._drive(Circle(centre, radius_um), frame, start, progress)
        finally:
            self._stage.stop(by="calibration", reason="the experiment ended")
            self._zoom.stop(by="calibration", reason="the experiment ended")

    def _note_beginning(self, near_px: tuple[float, float], first_frame: Frame) -> None:
        """What a replay needs to begin as this run does."""
        known = {
            "names": self.names._asdict(),
            "target": self._section.target.kind,
            "near_px": near_px,
            "first_frame": first_frame.seq,
            "frames_expected": self.frames_expected(),
            "optics": self.optics()._asdict(),
        }
        note(self.bus, self.clock, BEGIN, known)

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
        in_speed_um = fastest_um_s(self._stage) / (self.settings.radians_per_frame * self._camera.settings.rate_hz)
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

    def _drive(self, circle: Circle, frame: Frame, begin: Callable[[], None], progress: Progress) -> None:
        """In motion if times are known well enough for that, else at rest."""
        devices = Instruments(self._stage, self._zoom, self._camera, self.clock)
        why = "" if self.settings.settled is not None else self._unfit_for_motion(frame)
        if why:
            self._settled = True
            progress.step(f"{why}: taking frames at rest")
        drive = step_along if self._settled else stream_along
        drive(devices, circle, self.settings.pace(), begin, progress)

    def _unfit_for_motion(self, frame: Frame) -> str:
        """Why frames cannot be taken in motion; empty if they can."""
        begun_ns = self.clock.now_ns()
        poses = [self._stage.read() for _ in range(_TIMED_READS)]
        read_s = (self.clock.now_ns() - begun_ns) / (_TIMED_READS * NS_PER_S)
        known_to_ns = math.hypot(frame.dt_ns, poses[-1].dt_ns)
        rate_hz = self._camera.settings.rate_hz
        if known_to_ns > LARGEST_TIME_UNCERTAINTY_NS:
            return (
                f"pose against frame is known to ±{known_to_ns / NS_PER_MS:.2g} ms only, and motion needs "
                f"{LARGEST_TIME_UNCERTAINTY_NS / NS_PER_MS:g} ms"
            )
        if read_s * self.settings.pose_rate_hz > 1.0 or self.settings.pose_rate_hz < _POSES_PER_FRAME * rate_hz:
            poses_hz = min(1.0 / read_s, self.settings.pose_rate_hz)
            return f"poses at {poses_hz:.0f} Hz are too few for {rate_hz:g} frames a second"
        return ""
