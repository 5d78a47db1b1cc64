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

from microdrivers.estimators.vision.edge_bands import Bands, Start, estimate_start, select_bands
from microdrivers.estimators.vision.edge_crossings import edges_of
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
_OF_EDGE = np.arange(_LOG_BLUR).reshape(4, 2)
_OF_CORNER = np.concatenate([_OF_EDGE[PRECEDING], _OF_EDGE], axis=1)


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
    shortest = min(side_lengths(quad))
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
    shortest = min(side_lengths(start.quad))
    half_width = min(0.3 * shortest, 3.2 * start.blur_px + 1.5) + 0.25
    corner_gap = min(0.3 * shortest, 3.5 * start.blur_px + 1.5) - 0.5
    bands = select_bands(image, start.quad, half_width=half_width, corner_gap=corner_gap)
    found = sum(bands.counts)
    grey = bands.pixels[0]
    if np.count_nonzero(grey) < found or float(grey.max()) >= full_scale:
        bands = bands.without((grey <= 0.0) | (grey >= full_scale))
    unsaturated = sum(bands.counts)
    parameters = np.zeros(_PARAMETERS)
    parameters[_LOG_BLUR] = math.log(start.blur_px)
    parameters[_OUTSIDE] = start.outside
    parameters[_CONTRAST] = start.contrast

    solution = _minimise(bands, parameters)
    if solution is None:
        return None
    dusty = _dusty(bands, solution.at.residuals, start.contrast)
    if dusty is not None:
        bands = bands.without(dusty)
        solution = _minimise(bands, solution.parameters)
        if solution is None:
            return None
    if np.abs(solution.parameters[:_LOG_BLUR]).max() > 0.25 * shortest:
        return None
    used = sum(bands.counts)
    variance = solution.at.cost / (used - _PARAMETERS)
    corners, covariances = _corners(start.quad, solution.parameters, variance * solution.inverse_normal)
    return EdgeFit(
        corners=corners,
        covariances=covariances,
        blur_px=math.exp(float(solution.parameters[_LOG_BLUR])),
        contrast=float(solution.parameters[_CONTRAST]),
        residual_sigma=math.sqrt(variance),
        rejected=1.0 - used / unsaturated,
        saturated=1.0 - unsaturated / found,
        converged=solution.converged,
    )


def _dusty(bands: Bands, residuals: Float32Array, contrast: float) -> npt.NDArray[np.bool_] | None:
    """Pixels whose residual stands out, alone or as a faint patch, and their neighbours within two pixels.

    None without any.
    """
    # All lines side by side: what is left out at both ends of an edge keeps its patches from those of the next one.
    _, across, lines = residuals.shape
    residuals, ones = (part.transpose(1, 0, 2).reshape(across, -1) for part in (residuals, bands.pixels[1]))
    size = np.abs(residuals)
    # The residuals of what is left out are 0 and thus the smallest.
    middle = size.size - sum(bands.counts) // 2
    sigma = 1.4826 * float(np.partition(size, middle, axis=None)[middle])
    # Patches of 5 × 5 px: the sum of residuals over the square root of the number of pixels.
    total, count = (
        cv2.boxFilter(layer, -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT) for layer in (residuals, ones)
    )
    allowed = _OUTLIER_SIGMAS * sigma * np.sqrt(count) + _PATCH_TOLERANCE * abs(contrast) * count
    standing_out = (np.abs(total) > allowed) | (size > _OUTLIER_SIGMAS * sigma)
    standing_out &= ones > 0.0
    if not standing_out.any():
        return None
    grown = cv2.dilate(standing_out.astype(np.uint8), np.ones((5, 5), dtype=np.uint8))
    return np.asarray(grown.reshape(across, 4, lines).transpose(1, 0, 2) > 0)


def _minimise(bands: Bands, parameters: FloatArray) -> _Solution | None:
    """Gauss–Newton with Levenberg damping; None with too few pixels or where it leaves all reason."""
    if min(bands.counts) < _MIN_PIXELS:
        return None
    work = np.empty((10, *bands.pixels.shape[1:]), dtype=np.float32)
    work[3:6] = bands.pixels[1:4]
    damping, converged = 1e-5, False
    here = _linearise(bands, parameters, work)
    for iteration in range(_MAX_ITERATIONS):
        damped = here.normal.copy()
        damped.ravel()[:: _PARAMETERS + 1] *= 1.0 + damping
        regular, inverse = cv2.invert(damped, flags=cv2.DECOMP_CHOLESKY)
        step = inverse @ here.gradient
        largest = float(np.abs(step[: _LOG_BLUR + 1]).max())
        if not regular or not largest < _MAX_STEP:
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
    return _Solution(parameters, here, np.asarray(inverse, dtype=np.float64), converged)


def _linearise(bands: Bands, parameters: FloatArray, work: Float32Array) -> _Linear:
    """Evaluate the model at `parameters`.

    The rows of `work` are the derivatives by offset, slope, logarithm of the blur, the six level parameters, and
    the residuals. It is overwritten, but for the constant rows 3 … 5.
    """
    grey, across, along = bands.pixels[0], bands.pixels[4], bands.pixels[5]
    p = parameters.astype(np.float32)
    flat = work.reshape(10, -1)
    per_px = np.float32(_TABLE_PER_UNIT * math.exp(-float(parameters[_LOG_BLUR])))
    place = across * per_px
    place -= along * (per_px * p[1:_LOG_BLUR:2])[:, None, None]
    place -= (per_px * p[0:_LOG_BLUR:2])[:, None, None]
    step, rise = _normal_distribution(place)
    np.multiply(step, work[3:6], out=work[6:9])
    push = (-p[_CONTRAST:] @ flat[3:6]).reshape(step.shape)
    push *= rise
    np.multiply(push, per_px, out=work[0])
    np.multiply(work[0], along, out=work[1])
    np.multiply(push, place, out=work[2])
    residuals = grey - (p[_OUTSIDE:] @ flat[3:9]).reshape(step.shape)
    work[9] = residuals

    rows = work.reshape(10, 4, -1).transpose(1, 0, 2)
    # With one row less on the left: a matrix times its own transpose takes BLAS three times as long.
    products = (rows[:, :9] @ rows.transpose(0, 2, 1)).astype(np.float64)
    equations = np.zeros((_PARAMETERS, _PARAMETERS + 1))
    equations[_OF_EDGE[:, :, None], _OF_EDGE[:, None, :]] = products[:, :2, :2]
    equations[:_LOG_BLUR, _LOG_BLUR:] = products[:, :2, 2:].reshape(_LOG_BLUR, -1)
    equations[_LOG_BLUR:, _LOG_BLUR:] = products[:, 2:, 2:].sum(axis=0)
    equations[_LOG_BLUR:, :_LOG_BLUR] = equations[:_LOG_BLUR, _LOG_BLUR:-1].T
    return _Linear(residuals, equations[:, :-1], equations[:, -1], float(flat[9] @ flat[9]))


def _corners(quad: FloatArray, parameters: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Intersections of adjacent fitted lines, and their covariances by first-order propagation."""
    edges = edges_of(quad)
    own = parameters[:_LOG_BLUR].reshape(4, 2).tolist()
    lines = [edge.line(*parts) for edge, parts in zip(edges, own, strict=True)]
    corners = intersect_lines(lines)
    rows = []
    for i, (u, v) in enumerate(corners.tolist()):
        # Corner i ends line i − 1 and begins line i.
        (m_u, m_v, _), (n_u, n_v, _) = lines[i - 1], lines[i]
        inverse = 1.0 / (m_u * n_v - m_v * n_u)
        before, after = edges[i - 1].along(u, v) * inverse, edges[i].along(u, v) * inverse
        rows.append((n_v * inverse, n_v * before, -m_v * inverse, -m_v * after))
        rows.append((-n_u * inverse, -n_u * before, m_u * inverse, m_u * after))
    by_parameter = np.array(rows).reshape(4, 2, 4)
    meeting = covariance[_OF_CORNER[:, :, None], _OF_CORNER[:, None, :]]
    return corners, by_parameter @ meeting @ by_parameter.transpose(0, 2, 1)


_TABLE_REACH = 6.5
_TABLE_PER_UNIT = 256
_TABLE_Z = np.linspace(-_TABLE_REACH, _TABLE_REACH, int(2 * _TABLE_REACH * _TABLE_PER_UNIT) + 1)
_TABLE_VALUES = [0.5 * math.erfc(-z / math.sqrt(2.0)) for z in _TABLE_Z.tolist()]
_TABLE_STEP = np.array(_TABLE_VALUES, dtype=np.float32)
_TABLE_RISE = np.diff(_TABLE_VALUES).astype(np.float32)


def _normal_distribution(place: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Normal distribution function at z = `place` / `_TABLE_PER_UNIT`, and its derivative by `place`.

    By linear interpolation in a table: errors below 1e-6, and of the derivative below 0.1 % of its largest value.
    """
    entry = place + np.float32(_TABLE_REACH * _TABLE_PER_UNIT)
    index = entry.astype(np.intp)
    entry -= index
    rise = _TABLE_RISE.take(index, mode="clip")
    entry *= rise
    entry += _TABLE_STEP.take(index, mode="clip")
    return entry, rise
