"""Gathers the ground truth of a simulation from `truth/*` topics and compares a result with it."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from microdrivers.core.bus import Bus
from microdrivers.core.samples import OpticsEstimate, OpticsTruth
from microdrivers.results.optics import OpticsResult, Truth

_FEWEST_POSES = 4

Array = npt.NDArray[np.float64]


class OpticsTruthCollector:
    """Listens to `truth/optics`; holds nothing if nobody publishes there."""

    def __init__(self, bus: Bus) -> None:
        self.samples: list[OpticsTruth] = []
        bus.topic("truth/optics", OpticsTruth).subscribe(self.samples.append)

    def compare(self, result: OpticsResult, estimates: list[OpticsEstimate]) -> Truth | None:
        """The truth under the result's names, with errors; None if there is none.

        The true P is the affine map that fits the simulation's own (perspective) image points best over the poses
        that were visited while the zoom was the result's.
        """
        if not self.samples or not estimates:
            return None
        resting = _at_the_zoom_of(result, estimates)
        if len(resting) < _FEWEST_POSES:
            return None
        truths = self._matching(resting)
        corner = _tracked_corner(resting, truths)
        projection = _fit([(t.x_um, t.y_um) for t in truths], [_corner(t, corner) for t in truths])
        scale = float(np.mean([t.scale_px_per_um for t in truths]))
        last = truths[-1]
        pitch_um = None if result.magnification is None else result.magnification / result.scale_px_per_um
        translation = (float(projection[0, 2]) / scale, float(projection[1, 2]) / scale)
        return Truth(
            projection=(_row(projection[0]), _row(projection[1])),
            scale_px_per_um=scale,
            zoom=last.zoom,
            magnification=None if pitch_um is None else scale * pitch_um,
            angle_deg=last.angle_deg,
            tilt_deg=last.tilt_deg,
            view="along_minus_z_or_mirrored" if last.mirrored else "along_plus_z",
            translation_um=translation,
            errors={
                "scale_percent": 100.0 * (result.scale_px_per_um / scale - 1.0),
                "zoom_percent": 100.0 * (result.zoom / last.zoom - 1.0),
                "angle_deg": (result.angle_deg - last.angle_deg + 180.0) % 360.0 - 180.0,
                "projection": (np.array(result.projection) - projection).ravel().tolist(),
                "translation_um": [a - b for a, b in zip(result.translation_um, translation, strict=True)],
            },
        )

    def _matching(self, estimates: list[OpticsEstimate]) -> list[OpticsTruth]:
        """The truth of each estimate's frame: the nearest in time, since a camera's stamps are a little off."""
        times = np.array([truth.t_ns for truth in self.samples])
        return [self.samples[int(np.argmin(np.abs(times - estimate.t_ns)))] for estimate in estimates]


def _at_the_zoom_of(result: OpticsResult, estimates: list[OpticsEstimate]) -> list[OpticsEstimate]:
    """The frames that belong to the result: those at its zoom, at rest, after the last change."""
    first = result.zoom_change.last_moving_frame + 1 if result.zoom_change else 0
    return [e for e in estimates[first:] if not e.zoom_moving and math.isclose(e.zoom, result.zoom, rel_tol=1e-3)]


def _corner(truth: OpticsTruth, corner: int) -> tuple[float, float]:
    return truth.corners_px[2 * corner], truth.corners_px[2 * corner + 1]


def _tracked_corner(estimates: list[OpticsEstimate], truths: list[OpticsTruth]) -> int:
    """Which of the target's corners the estimator has followed."""
    corners = np.array([truth.corners_px for truth in truths]).reshape(len(truths), -1, 2)
    tracked = np.array([(estimate.u_px, estimate.v_px) for estimate in estimates])
    return int(np.argmin(np.linalg.norm(corners - tracked[:, None, :], axis=2).mean(axis=0)))


def _fit(poses_um: list[tuple[float, float]], points_px: list[tuple[float, float]]) -> Array:
    poses = np.array(poses_um)
    centre = poses.mean(axis=0)
    regressors = np.column_stack([poses - centre, np.ones(len(poses))])
    fitted = np.linalg.lstsq(regressors, np.array(points_px), rcond=None)[0].T
    fitted[:, 2] -= fitted[:, :2] @ centre
    return np.asarray(fitted)


def _row(values: Array) -> tuple[float, float, float]:
    a, b, c = values.tolist()
    return (a, b, c)
