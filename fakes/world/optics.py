"""The simulated microscope: a tilted perspective camera at finite distance, Bilen et al., eqs. (1)–(3).

This is deliberately not the affine model that the estimators fit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class Microscope(NamedTuple):
    """One microscope on one camera.

    Attributes:
        scale_per_zoom_px_per_um: px/µm on the optical axis at zoom 1: objective × adapter / pixel pitch.
        distance_um: from the objective's principal plane to the stage's plane.
        angle_deg: rotation of the image about the optical axis, from the stage's +X to the image's +u.
        mirrored: the image sees the stage's plane with the other handedness (camera above, v down).
        tilt_deg, tilt_direction_deg: lean of the optical axis against the stage's normal.
        axis_um: stage coordinates where the optical axis meets the stage's plane.
        boresight_px: shift of the image at zoom 1 → e·zoom (the zoom lenses do not move on one line).
        drift_um_s: sample against objective, thermal.
    """

    scale_per_zoom_px_per_um: float
    distance_um: float
    angle_deg: float
    mirrored: bool
    tilt_deg: float
    tilt_direction_deg: float
    axis_um: tuple[float, float]
    boresight_px: tuple[float, float]
    drift_um_s: tuple[float, float]

    def rotation(self) -> Array:
        """R of eq. (1), world to objective frame; a reflection of it if `mirrored`."""
        a, t, d = (math.radians(v) for v in (self.angle_deg, self.tilt_deg, self.tilt_direction_deg))
        lean_axis = np.array([math.cos(d), math.sin(d), 0.0])
        k = np.array([[0, 0, lean_axis[1]], [0, 0, -lean_axis[0]], [-lean_axis[1], lean_axis[0], 0.0]])
        lean = np.eye(3) + math.sin(t) * k + (1.0 - math.cos(t)) * (k @ k)
        in_plane = np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1.0]])
        mirror = np.diag([1.0, -1.0, 1.0]) if self.mirrored else np.eye(3)
        return np.asarray(in_plane @ mirror @ lean)

    def project(self, points_um: Array, *, zoom: float, time_s: float) -> Array:
        """Image coordinates (N×2, px from the principal point, v down) of stage-plane points (N×2, µm)."""
        drifted = points_um - np.asarray(self.axis_um) + time_s * np.asarray(self.drift_um_s)
        rotation = self.rotation()
        objective = drifted @ rotation[:, :2].T
        depth = self.distance_um + objective[:, 2:3]
        scale = self.scale_per_zoom_px_per_um * zoom * self.distance_um
        boresight = np.asarray(self.boresight_px) * math.log(zoom)
        return np.asarray(scale * objective[:, :2] / depth + boresight)

    def jacobian(self, point_um: Array, *, zoom: float, time_s: float) -> Array:
        """∂(u, v)/∂(X, Y) at one stage-plane point, 2×2, px/µm, by central differences over ±1 µm."""
        steps = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        image = self.project(point_um[None, :] + steps, zoom=zoom, time_s=time_s)
        return np.column_stack([(image[0] - image[1]) / 2.0, (image[2] - image[3]) / 2.0])
