"""A fixed piece of texture: where it lies in another image, by correlation, then least squares to sub-pixels."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

Float32Array = npt.NDArray[np.float32]
FloatArray = npt.NDArray[np.float64]

MIN_HALF_PX = 12
"""Half the side of the smallest window that can be tracked."""

MARGIN_PX = 3
"""Pixels around the window that interpolation needs."""

MIN_INDEPENDENCE = 1e-4
"""Least eigenvalue of the products of a model's rows, all of unit length: below it they cannot be told apart."""

ROUNDING_VARIANCE = 1.0 / 12.0
"""Of grey levels, in their squares: no image has less noise."""

_TAPS = 6
_NODES = np.arange(_TAPS) - (_TAPS // 2 - 1.0)
_LAGRANGE = np.linalg.inv(np.vander(_NODES, increasing=True)).T
"""Coefficients, by rising power, of the polynomial that is 1 at one node and 0 at all others; one tap a row."""

_COARSE_ROWS = 240
_MAX_REDUCTION = 8
_MAX_ITERATIONS = 30
_CONVERGED_PX = 1e-4
_MAX_REFINEMENT_PX = 2.5
_SMOOTHING_PX = 1.5
_STRUCTURE_RATIO = 3.0


class Match(NamedTuple):
    """The template found in an image.

    Attributes:
        shift: displacement (u, v) of the texture since the template was taken, px.
        sigma_px: standard deviation of the shift per axis, predicted from the residuals.
        correlation: correlation coefficient of the template with the image at the shift, after fitting gain, bias.
        deformation: largest change of length or angle across the window: 0.01 is 1 % or 0.6°.
        deformation_sigma: standard deviation of one element of the deformation.
    """

    shift: FloatArray
    sigma_px: float
    correlation: float
    deformation: float
    deformation_sigma: float


class Template:
    """The texture in a window of one image, which never changes afterwards.

    Least squares in the inverse-compositional form: the image, sampled at the current shift, is projected on the
    template, its two derivatives and a constant; that projection is computed once. Four more terms, linear in
    the place, tell a change of scale, angle or shape from noise.

    Made by `take_template`.
    """

    def __init__(
        self, image: Float32Array, rows: FloatArray, *, centre: tuple[int, int], half: tuple[int, int]
    ) -> None:
        self._centre = np.array(centre, dtype=np.float64)
        self._half = np.array(half)
        self._size = (2 * half[0] + 1, 2 * half[1] + 1)
        self._level = float(_window(image, centre, half).mean(dtype=np.float64))
        self._chip_half = np.array(_chip_half(half))
        self._chip = np.ascontiguousarray(_window(image, centre, _chip_half(half)))
        self._reduction = int(min(_MAX_REDUCTION, max(1, min(image.shape) // _COARSE_ROWS)))
        self._coarse_chip = reduced(self._chip, self._reduction)

        normal = rows @ rows.T
        self._rows = rows[:4]
        self._inverse_normal = np.linalg.inv(normal[:4, :4])
        self._projection = self._inverse_normal @ self._rows
        full_inverse = np.linalg.inv(normal)[4:]
        self._deformation = full_inverse @ rows
        self._deformation_spread = math.sqrt(float(np.diag(full_inverse[:, 4:]).max()))

    def search(self, image: Float32Array) -> tuple[FloatArray, float]:
        """Whole-pixel shift at which the middle of the template correlates best with `image`, and how well."""
        f = self._reduction
        if f == 1:
            place, peak = _best_place(image, self._chip)
        else:
            coarse, _ = _best_place(reduced(image, f), self._coarse_chip)
            low = np.maximum(coarse * f - f - 1, 0)
            high = coarse * f + np.array(self._chip.shape[::-1]) + f + 1
            region = image[low[1] : high[1], low[0] : high[0]]
            place, peak = _best_place(region, self._chip)
            place = place + low
        return place + self._chip_half - self._centre, peak

    def fits_in(self, shape: tuple[int, ...], shift: FloatArray) -> bool:
        """Whether the window, moved by `shift`, lies `MARGIN_PX` inside an image of `shape` (rows, columns)."""
        middle = self._centre + shift
        upper = np.array([shape[1] - 1.0, shape[0] - 1.0]) - MARGIN_PX
        return bool(np.all(middle - self._half >= MARGIN_PX) and np.all(middle + self._half <= upper))

    def refine(self, image: Float32Array, shift: FloatArray) -> Match | None:
        """Fit shift, gain and bias from the whole-pixel `shift` on; None if the fit runs away or leaves the image."""
        start = shift
        for _ in range(_MAX_ITERATIONS):
            sampled = self._sample(image, shift)
            fitted = product(self._projection, sampled)
            if not fitted[2] > 0.0:
                return None
            step = fitted[:2] / fitted[2]
            shift = shift - step
            if not np.abs(shift - start).max() < _MAX_REFINEMENT_PX or not self.fits_in(image.shape, shift):
                return None
            if np.abs(step).max() < _CONVERGED_PX:
                return self._judge(sampled, fitted, shift)
        return None

    def _sample(self, image: Float32Array, shift: FloatArray) -> FloatArray:
        """The image in the shifted window, interpolated, minus the template's mean level."""
        window = interpolated(image, self._centre - self._half + shift, self._size)
        return window.astype(np.float64).ravel() - self._level

    def _judge(self, sampled: FloatArray, fitted: FloatArray, shift: FloatArray) -> Match:
        residuals = sampled - np.einsum("i,ij->j", fitted, self._rows)
        squares = float((residuals * residuals).sum())
        total = len(residuals) * float(sampled.var())
        correlation = math.sqrt(max(0.0, 1.0 - squares / total)) if total > 0.0 else 0.0
        gain = float(fitted[2])
        variance = max(squares / (len(residuals) - 4), ROUNDING_VARIANCE) / gain**2
        affine = product(self._deformation, sampled) / gain
        return Match(
            shift=shift,
            sigma_px=math.sqrt(0.5 * variance * float(np.trace(self._inverse_normal[:2, :2]))),
            correlation=correlation,
            deformation=float(np.linalg.norm(affine.reshape(2, 2), ord=2)),
            deformation_sigma=math.sqrt(variance) * self._deformation_spread,
        )


def product(rows: FloatArray, vector: FloatArray) -> FloatArray:
    """`rows` @ `vector` without BLAS, whose threads get in the way of OpenCV's and cost ten times the product."""
    return np.asarray(np.einsum("ij,j->i", rows, vector))


def interpolated(image: Float32Array, corner: FloatArray, size: tuple[int, int]) -> Float32Array:
    """The window of `size` (columns, rows) whose top-left pixel lies at `corner` (u, v), between the pixels.

    `image` reaches `MARGIN_PX` beyond the window.
    """
    whole = np.floor(corner).astype(int)
    part_u, part_v = (corner - whole).tolist()
    u, v = (whole - _TAPS // 2 + 1).tolist()
    width, height = size
    surrounded = image[v : v + height + _TAPS - 1, u : u + width + _TAPS - 1]
    filtered = cv2.sepFilter2D(surrounded, -1, interpolator(part_u), interpolator(part_v), anchor=(0, 0))
    return np.asarray(filtered[:height, :width], dtype=np.float32)


def interpolator(part: float) -> FloatArray:
    """Six-tap Lagrange interpolation at `part` (0 … 1) between the third and fourth tap.

    Exact for polynomials up to the fifth degree. Two taps (bilinear) pull fine texture towards whole pixels by
    up to 0.01 px.
    """
    return np.asarray(_LAGRANGE @ part ** np.arange(_TAPS))


def _chip_half(half: tuple[int, int]) -> tuple[int, int]:
    return half[0] // 2, half[1] // 2


def _window(image: Float32Array, centre: tuple[int, int], half: tuple[int, int]) -> Float32Array:
    (u, v), (a, b) = centre, half
    return image[v - b : v + b + 1, u - a : u + a + 1]


def reduced(image: Float32Array, factor: int) -> Float32Array:
    """Means over `factor` × `factor` pixels, on a grid that begins at the top-left pixel."""
    rows, columns = image.shape[0] // factor, image.shape[1] // factor
    whole = image[: rows * factor, : columns * factor]
    return np.asarray(cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA), dtype=np.float32)


def _best_place(image: Float32Array, chip: Float32Array) -> tuple[npt.NDArray[np.int_], float]:
    """Top-left place (column, row) of `chip` in `image` and its correlation; −1 where the image is too small."""
    if image.shape[0] < chip.shape[0] or image.shape[1] < chip.shape[1]:
        return np.zeros(2, dtype=int), -1.0
    scores = cv2.matchTemplate(image, chip, cv2.TM_CCOEFF_NORMED)
    scores[~np.isfinite(scores)] = -1.0
    _, peak, _, place = cv2.minMaxLoc(scores)
    return np.array(place), float(peak)


def take_template(image: Float32Array, *, centre: tuple[int, int], half: tuple[int, int]) -> Template | None:
    """Template of a window of `image`, or None if its texture does not fix shift, scale and angle.

    Args:
        image: grey levels, rows × columns.
        centre: (column, row) of the window's centre.
        half: half-sizes (columns, rows): the window spans 2·half + 1 pixels and stays `MARGIN_PX` inside the image.
    """
    # The middle half is what the search goes by; the whole window contains it.
    if not _has_structure(_window(image, centre, _chip_half(half)).astype(np.float64)):
        return None
    rows = _model_rows(image, centre, half)
    lengths = np.sqrt((rows * rows).sum(axis=1))
    if not lengths.min() > 0.0:
        return None
    unit = rows / lengths[:, None]
    if np.linalg.eigvalsh(unit @ unit.T)[0] < MIN_INDEPENDENCE:
        return None
    return Template(image, rows, centre=centre, half=half)


def _model_rows(image: Float32Array, centre: tuple[int, int], half: tuple[int, int]) -> FloatArray:
    """What an image of the window is made of: both derivatives, texture, constant, derivatives by deformation."""
    a, b = half
    framed = _window(image, centre, (a + 1, b + 1)).astype(np.float64)
    patch = framed[1:-1, 1:-1]
    by_u = 0.5 * (framed[1:-1, 2:] - framed[1:-1, :-2])
    by_v = 0.5 * (framed[2:, 1:-1] - framed[:-2, 1:-1])
    y, x = np.mgrid[-b : b + 1, -a : a + 1].astype(np.float64)
    parts = [by_u, by_v, patch - patch.mean(), np.ones_like(patch), x * by_u, y * by_u, x * by_v, y * by_v]
    return np.stack([part.ravel() for part in parts])


def _has_structure(patch: FloatArray) -> bool:
    """Whether `patch` varies along both axes by more than white noise does after smoothing."""
    smooth = cv2.GaussianBlur(patch, (0, 0), _SMOOTHING_PX)
    noise_variance = float(np.var(patch - smooth)) + ROUNDING_VARIANCE
    by_v, by_u = np.gradient(smooth)
    weakest = float(np.linalg.eigvalsh(np.cov(by_u.ravel(), by_v.ravel()))[0])
    return weakest > _STRUCTURE_RATIO * noise_variance / (8.0 * math.pi * _SMOOTHING_PX**4)
