"""Joint least-squares fit of the four blurred edges of a square: sub-pixel corners with their covariance.

Across a Gaussian-blurred edge the grey level follows the normal distribution function of the distance. All four
edges, the blur, and levels with linear gradients on both sides are fitted at once by Gauss–Newton with Levenberg
damping; the pixels near the corners, where two edges meet, are left out. On white noise of σ_n grey levels this
comes close to the Cramér–Rao bound of a straight edge of L px, (σ_n/contrast)·sqrt(2·sqrt(π)·blur/L).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from microdrivers.estimators.vision.edge_bands import Bands, Start, edge_frames, estimate_start, select_bands
from microdrivers.estimators.vision.points import GreyImage
from microdrivers.estimators.vision.quadrilateral import PRECEDING, FloatArray, intersect_lines, side_lengths

Float32Array = npt.NDArray[np.float32]

_MAX_ITERATIONS = 12
_CONVERGED_PX = 2e-3
"""A Gauss–Newton step this small leaves an error of some 1e-5 px."""
_MAX_STEP = 20.0
"""A step of so many px, or of the logarithm of the blur, leads nowhere."""
_OUTLIER_SIGMAS = 4.5
_PATCH_TOLERANCE = 0.01
"""A patch whose mean is off by less than this share of the contrast is uneven light, not dust."""
_MIN_PIXELS = 20
_PROFILE_REACH_PX = 12.0

# Parameters: for each edge the offset and the slope (px, the slope at the end of the edge), then the logarithm
# of the blur, then level, gradient along u and along v of the outside and of the contrast.
_LOG_BLUR = 8
_OUTSIDE = 9
_CONTRAST = 12
_PARAMETERS = 15


class EdgeFit(NamedTuple):
    """Outcome of one fit.

    Attributes:
        corners: 4×2, px from the top-left pixel centre, clockwise as displayed.
        covariances: 4×2×2, covariance of each corner, px².
        blur_px: standard deviation of the Gaussian blur.
        contrast: inside minus outside at the centre of the square, grey levels.
        residual_sigma: standard deviation of the residuals, grey levels.
        rejected: share of the pixels rejected as outliers (dust), 0 … 1.
        saturated: share of the pixels at either end of the grey scale, 0 … 1.
        converged: the steps became negligible.
    """

    corners: FloatArray
    covariances: FloatArray
    blur_px: float
    contrast: float
    residual_sigma: float
    rejected: float
    saturated: float
    converged: bool


class _Linear(NamedTuple):
    """The problem linearised at some parameters: residuals (measured − model), JᵀJ, Jᵀ·residuals, cost."""

    residuals: Float32Array
    normal: FloatArray
    gradient: FloatArray
    cost: float


class _Solution(NamedTuple):
    parameters: FloatArray
    at: _Linear
    inverse_normal: FloatArray
    converged: bool


def fit_edges(image: GreyImage, quad: FloatArray, *, full_scale: float) -> EdgeFit | None:
    """Fit the four edges of the square near `quad`.

    Args:
        image: grey image, rows × columns.
        quad: starting corners, 4×2, clockwise as displayed, good to two pixels or so.
        full_scale: largest grey level of the camera.

    Returns:
        The fit, or None where the image does not determine one.
    """
    shortest = float(side_lengths(quad).min())
    reach_px = min(_PROFILE_REACH_PX, 0.2 * shortest)
    start = estimate_start(image, quad, reach_px=reach_px)
    if start is None:
        return None
    fit = _fit_from(image, start, full_scale)
    if fit is not None and fit.blur_px > 1.3 * start.blur_px:
        # The bands were too narrow for this blur.
        fit = _fit_from(image, start._replace(quad=fit.corners, blur_px=fit.blur_px), full_scale)
    return fit


def _fit_from(image: GreyImage, start: Start, full_scale: float) -> EdgeFit | None:
    shortest = float(side_lengths(start.quad).min())
    half_width = min(0.3 * shortest, 3.2 * start.blur_px + 1.5)
    corner_gap = min(0.3 * shortest, 3.5 * start.blur_px + 1.5)
    bands = select_bands(image, start.quad, half_width=half_width, corner_gap=corner_gap)
    grey = bands.pixels[0]
    unsaturated = (grey > 0) & (grey < full_scale)
    saturated = 1.0 - np.count_nonzero(unsaturated) / max(1, len(grey))
    if saturated > 0:
        bands = bands.keep(unsaturated)
    parameters = np.zeros(_PARAMETERS)
    parameters[_LOG_BLUR] = math.log(start.blur_px)
    parameters[_OUTSIDE] = start.outside
    parameters[_CONTRAST] = start.contrast

    solution = _minimise(bands, parameters)
    if solution is None:
        return None
    dusty = _dusty(bands, solution.at.residuals, start.contrast)
    rejected = float(np.count_nonzero(dusty)) / len(dusty)
    if rejected > 0:
        bands = bands.keep(~dusty)
        solution = _minimise(bands, solution.parameters)
        if solution is None:
            return None
    if np.abs(solution.parameters[:_LOG_BLUR]).max() > 0.25 * shortest:
        return None
    variance = solution.at.cost / (sum(bands.counts) - _PARAMETERS)
    corners, covariances = _corners(start.quad, solution.parameters, variance * solution.inverse_normal)
    return EdgeFit(
        corners=corners,
        covariances=covariances,
        blur_px=math.exp(float(solution.parameters[_LOG_BLUR])),
        contrast=float(solution.parameters[_CONTRAST]),
        residual_sigma=math.sqrt(variance),
        rejected=rejected,
        saturated=saturated,
        converged=solution.converged,
    )


def _dusty(bands: Bands, residuals: Float32Array, contrast: float) -> npt.NDArray[np.bool_]:
    """Pixels whose residual stands out, alone or as a faint patch, and their neighbours within two pixels."""
    size = np.abs(residuals)
    middle = len(size) // 2
    sigma = 1.4826 * float(np.partition(size, middle)[middle])
    # Patches of 5 × 5 px: the sum of residuals over the square root of the number of pixels.
    layers = np.zeros((*bands.box_shape, 2), dtype=np.float32)
    flat = layers.reshape(-1, 2)
    flat[bands.cells, 0] = residuals
    flat[bands.cells, 1] = 1.0
    total, count = cv2.boxFilter(layers, -1, (5, 5), normalize=False).reshape(-1, 2)[bands.cells].T
    patch = np.abs(total) > _OUTLIER_SIGMAS * sigma * np.sqrt(count) + _PATCH_TOLERANCE * abs(contrast) * count
    standing_out = patch | (size > _OUTLIER_SIGMAS * sigma)
    if not standing_out.any():
        return np.asarray(standing_out)
    mask = np.zeros(bands.box_shape, dtype=np.uint8)
    mask.ravel()[bands.cells[standing_out]] = 1
    grown = cv2.dilate(mask, np.ones((5, 5), dtype=np.uint8))
    return np.asarray(grown.ravel()[bands.cells] > 0)


def _minimise(bands: Bands, parameters: FloatArray) -> _Solution | None:
    """Gauss–Newton with Levenberg damping; None with too few pixels or where it leaves all reason."""
    if min(bands.counts) < _MIN_PIXELS:
        return None
    work = np.ones((10, sum(bands.counts)), dtype=np.float32)
    work[4:6] = bands.pixels[3:]
    damping, converged = 1e-5, False
    here = _linearise(bands, parameters, work)
    try:
        for iteration in range(_MAX_ITERATIONS):
            damped = here.normal.copy()
            damped.ravel()[:: _PARAMETERS + 1] *= 1.0 + damping
            step = np.linalg.solve(damped, here.gradient)
            largest = float(np.abs(step[: _LOG_BLUR + 1]).max())
            if not largest < _MAX_STEP:
                return None
            # Not in the first: lines that begin where they end say nothing of grey levels, which make the residuals.
            if largest < _CONVERGED_PX and iteration > 0:
                parameters = parameters + step
                converged = True
                break
            there = _linearise(bands, parameters + step, work)
            if there.cost <= here.cost * (1.0 + 1e-5):
                parameters, here = parameters + step, there
                damping *= 0.1
            else:
                damping = max(damping, 1e-5) * 30.0
        inverse = np.linalg.inv(here.normal)
    except np.linalg.LinAlgError:
        return None
    return _Solution(parameters, here, np.asarray(inverse, dtype=np.float64), converged)


def _linearise(bands: Bands, parameters: FloatArray, work: Float32Array) -> _Linear:
    """Evaluate the model at `parameters`.

    The rows of `work` are the derivatives by offset, slope, logarithm of the blur, the six level parameters, and
    the residuals. It is overwritten, but for the constant rows 3 … 5.
    """
    grey, across, along, u, v = bands.pixels
    p = parameters.astype(np.float32)
    inverse_blur = math.exp(-float(parameters[_LOG_BLUR]))
    z = across - np.repeat(p[0:_LOG_BLUR:2], bands.counts)
    z -= np.repeat(p[1:_LOG_BLUR:2], bands.counts) * along
    z *= inverse_blur
    step = work[6]
    _normal_distribution(z, out=step)
    np.multiply(step, u, out=work[7])
    np.multiply(step, v, out=work[8])
    push = np.multiply(p[_CONTRAST:] @ work[3:6], _normal_density(z), out=work[2])
    np.multiply(push, -inverse_blur, out=work[0])
    np.multiply(work[0], along, out=work[1])
    work[2] *= -z
    residuals = grey - p[_OUTSIDE:] @ work[3:9]
    work[9] = residuals

    normal = np.zeros((_PARAMETERS, _PARAMETERS))
    gradient = np.zeros(_PARAMETERS)
    cost = 0.0
    for k, part in enumerate(bands.parts):
        block = work[:, part]
        products = block @ block.T
        own = slice(2 * k, 2 * k + 2)
        normal[own, own] = products[:2, :2]
        normal[own, _LOG_BLUR:] = products[:2, 2:9]
        normal[_LOG_BLUR:, own] = products[2:9, :2]
        normal[_LOG_BLUR:, _LOG_BLUR:] += products[2:9, 2:9]
        gradient[own] = products[9, :2]
        gradient[_LOG_BLUR:] += products[9, 2:9]
        cost += float(products[9, 9])
    return _Linear(residuals, normal, gradient, cost)


def _corners(quad: FloatArray, parameters: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Intersections of adjacent fitted lines, and their covariances by first-order propagation."""
    frames = edge_frames(quad)
    lines = frames.lines(parameters[0:_LOG_BLUR:2], parameters[1:_LOG_BLUR:2])
    corners = intersect_lines(lines)
    # Corner i ends line i − 1 and begins line i.
    meeting = np.stack([PRECEDING, np.arange(4)], axis=1)
    offset_to = (corners[:, None, :] - frames.middle[meeting]) * frames.tangent[meeting]
    along = offset_to.sum(axis=2) / frames.half_length[meeting]
    inverse = np.linalg.inv(lines[meeting, :2])
    by_parameter = np.stack([inverse, inverse * along[:, None, :]], axis=3).reshape(4, 2, 4)
    rows = np.stack([2 * meeting, 2 * meeting + 1], axis=2).reshape(4, 4)
    own = covariance[rows[:, :, None], rows[:, None, :]]
    return corners, by_parameter @ own @ by_parameter.transpose(0, 2, 1)


_TABLE_REACH = 6.5
_TABLE_PER_UNIT = 256
_TABLE_Z = np.linspace(-_TABLE_REACH, _TABLE_REACH, int(2 * _TABLE_REACH * _TABLE_PER_UNIT) + 1)
_TABLE_VALUES = [0.5 * math.erfc(-z / math.sqrt(2.0)) for z in _TABLE_Z.tolist()]
_TABLE_STEP = np.array(_TABLE_VALUES, dtype=np.float32)
_TABLE_RISE = np.diff(_TABLE_VALUES).astype(np.float32)


def _normal_distribution(z: Float32Array, out: Float32Array) -> None:
    """Normal distribution function by linear interpolation in a table, error below 1e-6."""
    place = z * np.float32(_TABLE_PER_UNIT)
    place += np.float32(_TABLE_REACH * _TABLE_PER_UNIT)
    np.clip(place, 0.0, len(_TABLE_RISE) - 1.0, out=place)
    index = place.astype(np.intp)
    place -= index
    np.take(_TABLE_RISE, index, out=out, mode="clip")
    out *= place
    out += np.take(_TABLE_STEP, index, out=place, mode="clip")


def _normal_density(z: Float32Array) -> Float32Array:
    density = np.exp(np.float32(-0.5) * z * z)
    return np.asarray(density * np.float32(1.0 / math.sqrt(2.0 * math.pi)))
