"""On-line calibration of the microscope from frames, stage poses and zoom samples (Bilen et al., section II.A)."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol, cast

from microdrivers.core.errors import IllConditioned
from microdrivers.core.samples import Frame, OpticsEstimate, Sample, TrackedPoint, XYThetaSample, ZoomSample
from microdrivers.core.synchroniser import PoseAt, Synchroniser, interpolate_pose
from microdrivers.core.units import NS_PER_S
from microdrivers.estimators.optics.optical_parameters import OpticalParameters, optical_parameters
from microdrivers.estimators.optics.recursion import ProjectionRecursion

_HALF_WIDTH_95 = 1.959964
"""A 95 % half-width in standard deviations of a normal distribution."""


class PointTracker(Protocol):
    """Finds one feature in each frame."""

    def update(self, frame: Frame) -> TrackedPoint:
        """Locate the feature; `found` is False if it is lost."""


class CalibratorSettings(NamedTuple):
    """How the recursion forgets.

    Attributes:
        forgetting: λ of eq. (18) while the zoom rests.
        flush_frames: frames after the zoom has come to rest for which λ stays 0. The stack of eq. (8) still holds
            measurements of the old zoom in the first two of them.
        ridge: δ of eq. (12), on coordinates normalised by `scale_um`.
        scale_um: normalisation of X and Y about the first pose.
        max_pose_gap_s: a frame whose neighbouring poses lie further apart is left out.
        zoom_still: relative change of zoom between two samples below which the zoom counts as resting.
        sigma_drift_um_s: how fast the sample may drift against the stage, standard deviation along X and Y; widens
            the intervals of long runs. 18 µm in an hour is a stage that is still warming up.
    """

    forgetting: float = 0.99
    flush_frames: int = 3
    ridge: float = 1e-9
    scale_um: float = 100.0
    max_pose_gap_s: float = 0.1
    zoom_still: float = 1e-3
    sigma_drift_um_s: float = 0.005


class OpticsCalibrator:
    """Samples of a stage, a zoom and a camera in; tracked points and running estimates of P out.

    A frame waits until a pose and a zoom sample lie on either side of its mid-exposure; the pose is interpolated
    there. "The forgetting factor is automatically increased once the magnification motor turns": λ = 0 while the
    motor's own samples say that it moves, and for `flush_frames` after.

    Args:
        tracker: finds the point in each frame.
        settings: how to forget.
        frames: how many frames to take; later ones are ignored. None takes all.
    """

    def __init__(
        self, tracker: PointTracker, settings: CalibratorSettings | None = None, *, frames: int | None = None
    ) -> None:
        self.settings = settings or CalibratorSettings()
        self.recursion: ProjectionRecursion | None = None
        self.lost_frames = 0
        self.skipped_frames = 0
        self._tracker = tracker
        self._frames_left = math.inf if frames is None else frames
        self._synchroniser: Synchroniser[TrackedPoint] = Synchroniser(("stage", "zoom"))
        self._first_ns = 0
        self._frame_index = 0
        self._clean_frames = 0
        self._to_flush = 0
        self._moving_before = False
        self._moved_ns = -1
        self._previous: tuple[int, float] | None = None

    @property
    def unmatched_frames(self) -> int:
        """Frames that had no pose or no zoom sample close enough on both sides."""
        return self._synchroniser.unmatched + self.skipped_frames

    @property
    def waiting_frames(self) -> int:
        """Frames that wait for a pose and a zoom sample after them; none does if these go on after the last frame."""
        return self._synchroniser.waiting

    def update(self, sample: Sample) -> list[Sample]:
        """Take one sample of any of the three streams.

        Returns:
            The tracked point, if the sample was a frame, and the estimates that it made possible, oldest first.
        """
        results: list[Sample] = []
        if isinstance(sample, XYThetaSample):
            self._synchroniser.add_reference("stage", sample)
        elif isinstance(sample, ZoomSample):
            if sample.moving:
                self._moved_ns = sample.t_ns
            self._synchroniser.add_reference("zoom", sample)
        elif isinstance(sample, Frame) and self._frames_left > 0:
            self._frames_left -= 1
            point = self._tracker.update(sample)
            results.append(point)
            if point.found:
                self._synchroniser.add(point)
            else:
                self.lost_frames += 1
        for matched, neighbours in self._synchroniser.release():
            before, after = cast("tuple[XYThetaSample, XYThetaSample]", neighbours["stage"])
            zooms = cast("tuple[ZoomSample, ZoomSample]", neighbours["zoom"])
            pose = interpolate_pose(before, after, matched.t_ns)
            if pose.gap_ns > self.settings.max_pose_gap_s * NS_PER_S:
                self.skipped_frames += 1
            else:
                results.append(self._estimate(matched, pose, *zooms))
        return results

    # ------------------------------------------------------------------ one frame

    def _estimate(self, point: TrackedPoint, pose: PoseAt, zoom: ZoomSample, next_zoom: ZoomSample) -> OpticsEstimate:
        recursion = self._started(pose, point.t_ns)
        moving = self._zoom_moves(point.t_ns - point.dt_ns, zoom, next_zoom)
        moved = moving or self._zoom_has_moved(point.t_ns, zoom)
        defined = recursion.frames_used >= 3
        prior_error = _distance(recursion.predict(pose.x_um, pose.y_um), point) if defined else math.nan
        recursion.update(
            x_um=pose.x_um,
            y_um=pose.y_um,
            u_px=point.u_px,
            v_px=point.v_px,
            forgetting=self._forgetting(moving, moved),
            vx_um_s=pose.velocity_x_um_s,
            vy_um_s=pose.velocity_y_um_s,
            sigma_time_s=math.hypot(point.dt_ns, pose.dt_ns) / (_HALF_WIDTH_95 * NS_PER_S),
            t_s=(point.t_ns - self._first_ns) / NS_PER_S,
        )
        # Three measurements of one zoom are fitted exactly: only from the fourth on does a residual say anything.
        overdetermined = self._clean_frames > 3
        posterior_error = _distance(recursion.predict(pose.x_um, pose.y_um), point) if overdetermined else math.nan
        valid = self._clean_frames >= 3 and recursion.is_determined
        estimate = self._report(point, pose, zoom, moving, prior_error, posterior_error, valid)
        self._frame_index += 1
        return estimate

    def _started(self, pose: PoseAt, t_ns: int) -> ProjectionRecursion:
        if self.recursion is None:
            self.recursion = ProjectionRecursion(
                centre_um=(pose.x_um, pose.y_um),
                scale_um=self.settings.scale_um,
                ridge=self.settings.ridge,
                sigma_drift_um_s=self.settings.sigma_drift_um_s,
            )
            self._first_ns = t_ns
        return self.recursion

    def _zoom_moves(self, earliest_ns: int, zoom: ZoomSample, next_zoom: ZoomSample) -> bool:
        """Whether the zoom may be moving at a frame that was taken at `earliest_ns` or later, between two samples."""
        changed = abs(next_zoom.zoom - zoom.zoom) > self.settings.zoom_still * abs(zoom.zoom)
        # A motor counts as moving until it has been read at its target for good: it came to rest at the first such
        # reading or before it, so that what is exposed after that one sees a resting zoom.
        arrived = next_zoom.zoom == zoom.zoom and earliest_ns > zoom.t_ns + zoom.dt_ns
        return (zoom.moving and not arrived) or next_zoom.moving or changed

    def _zoom_has_moved(self, t_ns: int, zoom: ZoomSample) -> bool:
        """Whether the zoom has moved since the last frame: between two frames it may come and go unseen."""
        previous, self._previous = self._previous, (t_ns, zoom.zoom)
        if previous is None:
            return False
        previous_ns, previous_zoom = previous
        changed = abs(zoom.zoom - previous_zoom) > self.settings.zoom_still * abs(previous_zoom)
        return changed or previous_ns < self._moved_ns <= t_ns

    def _forgetting(self, moving: bool, moved: bool) -> float:
        """λ for this frame: 0 from the first frame of a motion until the stack holds the new zoom alone."""
        assert self.recursion is not None
        if moved:
            if not self._moving_before:
                self.recursion.switch_prior()
            self._to_flush = self.settings.flush_frames
            self._clean_frames = 0
        self._moving_before = moving
        if moving:
            return 0.0
        self._clean_frames += 1
        if self._to_flush > 0:
            self._to_flush -= 1
            return 0.0
        return self.settings.forgetting

    def _report(
        self,
        point: TrackedPoint,
        pose: PoseAt,
        zoom: ZoomSample,
        moving: bool,
        prior_error: float,
        posterior_error: float,
        valid: bool,
    ) -> OpticsEstimate:
        assert self.recursion is not None
        uncertainty = self.recursion.uncertainty() if valid else None
        parameters = self._parameters()
        return OpticsEstimate(
            t_ns=point.t_ns,
            dt_ns=point.dt_ns,
            t_source="computed",
            device="optics",
            seq=self._frame_index,
            frame_index=self._frame_index,
            projection=self.recursion.projection,
            covariance=() if uncertainty is None else tuple(uncertainty.covariance.ravel().tolist()),
            degrees_of_freedom=0.0 if uncertainty is None else uncertainty.degrees_of_freedom,
            scale_px_per_um=math.nan if parameters is None else parameters.scale_px_per_um,
            angle_deg=math.nan if parameters is None else parameters.angle_deg,
            prediction_error_px=prior_error,
            posterior_error_px=posterior_error,
            x_um=pose.x_um,
            y_um=pose.y_um,
            u_px=point.u_px,
            v_px=point.v_px,
            zoom=zoom.zoom,
            zoom_moving=moving,
            valid=valid,
        )

    def _parameters(self) -> OpticalParameters | None:
        """What the present P says of the optics; None while it says nothing."""
        assert self.recursion is not None
        if not self.recursion.is_determined:
            return None
        try:
            return optical_parameters(self.recursion.projection)
        except IllConditioned:
            return None


def _distance(predicted: tuple[float, float], point: TrackedPoint) -> float:
    return math.hypot(predicted[0] - point.u_px, predicted[1] - point.v_px)
