"""What the simulated camera sees, rendered analytically: no resampling, so that the truth is exact."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.fakes.world.normal import normal_cdf
from microdrivers.fakes.world.painting import Overlay

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]


class Speck(NamedTuple):
    """A grain of dust on the slide: a Gaussian blob; position relative to the target's centre, µm."""

    x_um: float
    y_um: float
    radius_um: float
    depth_levels: float


class Look(NamedTuple):
    """Grey levels and blur of the scene.

    `contrast_levels` is target minus background; negative for a dark target. `gradient_levels` is the change of
    illumination from the image's centre to its right and lower border.
    """

    background_levels: float
    contrast_levels: float
    blur_px: float
    noise_levels: float
    gradient_levels: tuple[float, float]


class Renderer:
    """Renders convex quadrilaterals and blobs on an illuminated background.

    Pixel (0, 0) is the centre of the top-left pixel. A pixel's value is the scene convolved with a Gaussian of
    `blur_px` (pixel area included) at its centre, plus noise, rounded to whole grey levels.
    """

    def __init__(self, width_px: int, height_px: int, look: Look) -> None:
        self.look = look
        self.size = (width_px, height_px)
        columns, rows = np.arange(width_px, dtype=np.float64), np.arange(height_px, dtype=np.float64)
        tilt_u, tilt_v = look.gradient_levels
        across = tilt_u * (2.0 * columns / max(width_px - 1, 1) - 1.0)
        down = tilt_v * (2.0 * rows / max(height_px - 1, 1) - 1.0)
        self._background = (look.background_levels + across[None, :] + down[:, None]).astype(np.float32)

    def render(
        self,
        corners_px: Array,
        travel_px: Array,
        blobs_px: Array,
        *,
        random: np.random.Generator,
        overlay: Overlay | None = None,
    ) -> Image:
        """One frame.

        Args:
            corners_px: 4×2 corners of the target in cyclic order, pixel coordinates.
            travel_px: 4×2, how far each corner moved during the exposure (motion blur).
            blobs_px: K×4 rows of u, v, sigma, depth in grey levels.
            random: source of this frame's noise.
            overlay: what lies over all that.
        """
        image = self._background.copy()
        for u, v, sigma, depth in blobs_px:
            self._add_blob(image, float(u), float(v), float(sigma), float(depth))
        self._add_target(image, corners_px, travel_px)
        if overlay is not None:
            overlay.paint(image, blur_px=self.look.blur_px)
        width, height = self.size
        noise = random.standard_normal((height, width), dtype=np.float32)
        image += np.float32(self.look.noise_levels) * noise
        np.rint(image, out=image)
        np.clip(image, 0.0, 255.0, out=image)
        return image.astype(np.uint8)

    def _add_target(self, image: npt.NDArray[np.float32], corners: Array, travel: Array) -> None:
        window = self._window(corners.min(axis=0), corners.max(axis=0), 7.0 * self.look.blur_px + 3.0)
        if window is None:
            return
        rows, columns = window
        u = np.arange(columns.start, columns.stop, dtype=np.float64)
        v = np.arange(rows.start, rows.stop, dtype=np.float64)[:, None]
        centre = corners.mean(axis=0)
        cover = []
        for i in range(4):
            start, end = corners[i], corners[(i + 1) % 4]
            along = (end - start) / np.hypot(*(end - start))
            normal = np.array([-along[1], along[0]])
            if normal @ (centre - start) < 0.0:
                normal = -normal
            smear = normal @ (travel[i] + travel[(i + 1) % 4]) / 2.0
            sigma = math.sqrt(self.look.blur_px**2 + float(smear) ** 2 / 12.0)
            cover.append(normal_cdf(((u - start[0]) * normal[0] + (v - start[1]) * normal[1]) / sigma))
        # Exact for parallel opposite edges: the blurred strip between them is the sum of two edges minus one.
        inside = (cover[0] + cover[2] - 1.0) * (cover[1] + cover[3] - 1.0)
        image[rows, columns] += (self.look.contrast_levels * inside).astype(np.float32)

    def _add_blob(self, image: npt.NDArray[np.float32], u: float, v: float, sigma: float, depth: float) -> None:
        sigma = math.hypot(sigma, self.look.blur_px)
        at = np.array([u, v])
        window = self._window(at, at, 4.0 * sigma)
        if window is None:
            return
        rows, columns = window
        across = np.exp(-0.5 * ((np.arange(columns.start, columns.stop) - u) / sigma) ** 2)
        down = np.exp(-0.5 * ((np.arange(rows.start, rows.stop) - v) / sigma) ** 2)
        image[rows, columns] -= (depth * down[:, None] * across[None, :]).astype(np.float32)

    def _window(self, low: Array, high: Array, margin: float) -> tuple[slice, slice] | None:
        width, height = self.size
        left, right = max(0, math.floor(low[0] - margin)), min(width, math.ceil(high[0] + margin) + 1)
        top, bottom = max(0, math.floor(low[1] - margin)), min(height, math.ceil(high[1] + margin) + 1)
        if left >= right or top >= bottom:
            return None
        return slice(top, bottom), slice(left, right)
