"""Analytic images of a square for the vision tests: geometry first, pixels from closed forms.

Nothing here uses the estimators' code. The blurred square is exact: in the square's own axes a Gaussian blur
of the indicator function is a product of differences of the normal distribution.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from microdrivers.core.samples import Frame

Array = npt.NDArray[np.float64]


def normal_cdf(x: Array) -> Array:
    """Cumulative normal distribution by Abramowitz & Stegun 7.1.26, absolute error below 1e-7."""
    z = np.abs(x) / np.sqrt(2.0)
    k = 1.0 / (1.0 + 0.3275911 * z)
    series = k * (0.254829592 + k * (-0.284496736 + k * (1.421413741 + k * (-1.453152027 + k * 1.061405429))))
    erf = 1.0 - series * np.exp(-z * z)
    return 0.5 * (1.0 + np.where(x < 0, -erf, erf))


def square_corners(*, centre: tuple[float, float], side_px: float, angle_deg: float) -> Array:
    """The 4×2 corners, px from the top-left pixel centre, clockwise as displayed, the first one at `angle_deg`=0
    being the top-left one. A positive angle turns clockwise as displayed (u right, v down)."""
    h = 0.5 * side_px
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    local = np.array([[-h, -h], [h, -h], [h, h], [-h, h]])
    return np.array(centre) + local @ np.array([[c, s], [-s, c]])


def square_coverage(
    shape: tuple[int, int], *, centre: tuple[float, float], side_px: float, angle_deg: float, blur_px: float
) -> Array:
    """Blurred indicator function of the square at each pixel centre, 0 … 1; exact for any angle and blur."""
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float64)
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    x = c * (u - centre[0]) + s * (v - centre[1])
    y = -s * (u - centre[0]) + c * (v - centre[1])
    h = 0.5 * side_px
    near = (np.abs(x) < h + 7 * blur_px) & (np.abs(y) < h + 7 * blur_px)
    coverage = np.zeros(shape)
    x, y = x[near], y[near]
    along_x = normal_cdf((x + h) / blur_px) - normal_cdf((x - h) / blur_px)
    along_y = normal_cdf((y + h) / blur_px) - normal_cdf((y - h) / blur_px)
    coverage[near] = along_x * along_y
    return coverage


def quad_coverage(shape: tuple[int, int], corners: Array, *, blur_px: float) -> Array:
    """As `square_coverage` for any convex quadrilateral, clockwise; exact but within some blurs of a corner."""
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float64)
    coverage = np.ones(shape)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        t = (b - a) / np.hypot(*(b - a))
        coverage *= normal_cdf((-t[1] * (u - a[0]) + t[0] * (v - a[1])) / blur_px)
    return coverage


def dust(shape: tuple[int, int], specks: list[tuple[float, float, float, float]]) -> Array:
    """Sum of Gaussian blobs, each (u, v, radius_px, grey levels)."""
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float64)
    total = np.zeros(shape)
    for u0, v0, radius, level in specks:
        total += level * np.exp(-0.5 * ((u - u0) ** 2 + (v - v0) ** 2) / radius**2)
    return total


def digitise(grey: Array, *, noise: float, rng: np.random.Generator, bits: int = 8) -> npt.NDArray[Any]:
    """Add white noise, round and clip to `bits`."""
    noisy = grey + noise * rng.standard_normal(grey.shape)
    return np.clip(np.rint(noisy), 0, 2**bits - 1).astype(np.uint8 if bits <= 8 else np.uint16)


def square_image(
    rng: np.random.Generator,
    *,
    centre: tuple[float, float],
    side_px: float = 97.0,
    angle_deg: float = 0.0,
    blur_px: float = 1.2,
    contrast: float = 120.0,
    background: float | None = None,
    gradient: tuple[float, float] = (0.0, 0.0),
    noise: float = 2.0,
    specks: list[tuple[float, float, float, float]] | None = None,
    shape: tuple[int, int] = (480, 640),
) -> npt.NDArray[np.uint8]:
    """An 8-bit image of one square; `contrast` is inside minus outside, `gradient` levels per px along u and v."""
    if background is None:
        background = 128.0 - 0.5 * contrast
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float64)
    grey = background + gradient[0] * (u - shape[1] / 2) + gradient[1] * (v - shape[0] / 2)
    grey += contrast * square_coverage(shape, centre=centre, side_px=side_px, angle_deg=angle_deg, blur_px=blur_px)
    grey += dust(shape, specks or [])
    return digitise(grey, noise=noise, rng=rng)


def frame(
    image: npt.NDArray[Any],
    *,
    seq: int = 0,
    bit_depth: int = 8,
    principal_point_px: tuple[float, float] | None = None,
    dropped_before: int = 0,
) -> Frame:
    """A frame at 30 Hz around `image`, read-only as cameras publish it."""
    image = image.view()
    image.flags.writeable = False
    centre = ((image.shape[1] - 1) / 2, (image.shape[0] - 1) / 2)
    return Frame(
        t_ns=1_000_000_000 + seq * 33_333_333,
        dt_ns=5_000,
        device="camera",
        seq=seq,
        image=image,
        exposure_ms=5.0,
        frame_id=seq,
        bit_depth=bit_depth,
        dropped_before=dropped_before,
        principal_point_px=principal_point_px or centre,
    )
