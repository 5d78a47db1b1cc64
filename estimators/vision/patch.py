"""A fixed piece of an image of any outline: where it lies in another image, to a hundredth of a pixel.

Least squares in the inverse-compositional form of Lucas and Kanade: what the image shows at the current shift is
projected on the patch, its two derivatives and a constant; the projection is computed once, the patch never changes.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from microdrivers.estimators.vision.template import (
    MARGIN_PX,
    MIN_INDEPENDENCE,
    ROUNDING_VARIANCE,
    Float32Array,
    FloatArray,
    interpolated,
    interpolator,
    product,
    reduced,
)

BoolArray = npt.NDArray[np.bool_]

MIN_PIXELS = 120
"""A patch of fewer pixels is not tracked."""

_MAX_ITERATIONS = 20
_CONVERGED_PX = 2e-3
"""The next step would be a tenth of it at most, where the patch fits."""

_MAX_REFINEMENT_PX = 3.0
_PLAIN = np.eye(4)
_SEARCH_SIZE_PX = 200
_LEAST_SEARCHED_PX = 8
_DERIVATIVE = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12.0
"""Of the cubic through five pixels; right within 1 % down to wavelengths of 8 px."""


class PatchMatch(NamedTuple):
    """The patch found in an image.

    Attributes:
        shift: displacement (u, v) of the patch since it was taken, px.
        covariance: of the shift, 2×2, px²; from the residuals, the patch's own noise included.
        correlation: of the patch with the image at the shift, after fitting gain and bias.
        unrigid: by how much the pivot's shift would differ from `shift` if the patch may also stretch and turn, px.
        unrigid_covariance: of that difference, 2×2, px².
    """

    shift: FloatArray
    covariance: FloatArray
    correlation: float
    unrigid: FloatArray
    unrigid_covariance: FloatArray


class Patch:
    """The pixels of one image under a mask, tracked as a rigid piece under a gain and a bias of its own.

    Made by `take_patch`.
    """

    def __init__(
        self,
        image: Float32Array,
        mask: BoolArray,
        *,
        corner: tuple[int, int],
        pivot_px: FloatArray,
        noise_levels: float,
        noise_share: float,
        nuisance: FloatArray | None,
    ) -> None:
        (u, v), (height, width) = corner, mask.shape
        self._corner = np.array(corner, dtype=np.float64)
        self._size = (width, height)
        self._inside = np.flatnonzero(mask)
        self._mask = mask.astype(np.float32)
        self._chip = np.ascontiguousarray(image[v : v + height, u : u + width])
        self._level = float(self._chip[mask].mean(dtype=np.float64))
        self._noise_share = noise_share
        rows = _model_rows(image, mask, self._corner, nuisance)
        self._rows = rows
        self._products = rows @ rows.T
        self._normal = _without_noise(self._products, noise_share * noise_levels**2, self.pixels)
        self._inverse = _inverse(self._normal[:4, :4])
        self._spread = self._inverse[:2, :2]
        self._score_inverse = _inverse(self._normal[:5, :5])
        stretched = np.vstack([rows[:4], _stretch_rows(rows[:2], mask, pivot_px - self._corner)])
        full_products = stretched @ stretched.T
        full_products[:4, :4] = self._normal[:4, :4]
        full_inverse = _inverse(full_products)
        self._stretched_projection = full_inverse[:2] @ stretched
        self._stretched_excess = full_inverse[:2, :2] - self._spread

    @property
    def pixels(self) -> int:
        """How many pixels it has."""
        return len(self._inside)

    def sigma_px(self, noise_levels: float, direction: FloatArray) -> float:
        """Standard deviation of the shift along a unit vector in frames of that noise, Cramér–Rao."""
        share = 1.0 + self._noise_share
        return noise_levels * math.sqrt(share * float(direction @ self._spread @ direction))

    def fits_in(self, shape: tuple[int, ...], shift: FloatArray) -> bool:
        """Whether the patch, moved by `shift`, lies `MARGIN_PX` inside an image of `shape` (rows, columns)."""
        low = self._corner + shift - MARGIN_PX
        high = self._corner + shift + self._size + MARGIN_PX
        return bool(low.min() >= 0.0 and high[0] <= shape[1] and high[1] <= shape[0])

    def search(self, image: npt.NDArray[Any], shift: FloatArray, radius_px: float) -> FloatArray | None:
        """The whole-pixel shift within `radius_px` of `shift` that correlates best; None if none lies in the image."""
        margin = np.array([MARGIN_PX, MARGIN_PX])
        low = np.maximum(np.floor(self._corner + shift - radius_px).astype(int), margin)
        high = np.ceil(self._corner + shift + radius_px).astype(int) + self._size
        high = np.minimum(high, np.array(image.shape[::-1]) - margin)
        if (high - low - self._size).min() < 0:
            return None
        reduction = math.ceil(int((high - low).max()) / _SEARCH_SIZE_PX)
        reduction = max(1, min(reduction, min(self._size) // _LEAST_SEARCHED_PX))
        place = low + self._best_place(image[low[1] : high[1], low[0] : high[0]], reduction)
        if reduction > 1:
            low = np.maximum(place - reduction - 1, margin)
            upper = np.minimum(place + reduction + 1 + self._size, np.array(image.shape[::-1]) - margin)
            place = low + self._best_place(image[low[1] : upper[1], low[0] : upper[0]], 1)
        return np.asarray(place - self._corner)

    def score(self, image: npt.NDArray[Any], shift: FloatArray) -> float:
        """Correlation at a shift that is right within about 1 px, without fitting it; 0 outside the image."""
        if not self.fits_in(image.shape, shift):
            return 0.0
        sampled, _ = self._sample(image, shift)
        products = product(self._rows, sampled)[: len(self._score_inverse)]
        weights = self._score_inverse @ products
        return _correlation(sampled, float(weights @ products)) if weights[2] > 0.0 else 0.0

    def refine(self, image: npt.NDArray[Any], shift: FloatArray) -> PatchMatch | None:
        """Fit shift, gain and bias from `shift` on; None if the fit runs away or leaves the image."""
        start, extra = shift, 0.0
        for _ in range(_MAX_ITERATIONS):
            if not np.abs(shift - start).max() < _MAX_REFINEMENT_PX or not self.fits_in(image.shape, shift):
                return None
            sampled, part = self._sample(image, shift)
            products = product(self._rows, sampled)
            mixture, inverse = self._model(extra)
            fitted = inverse @ (mixture @ products)
            if not fitted[2] > 0.0:
                return None
            step = fitted[:2] / fitted[2]
            shift = shift - step
            if np.abs(step).max() < _CONVERGED_PX:
                return self._judge(sampled, products, fitted @ mixture, inverse[:2, :2], shift, part)
            extra = float(fitted[4] / fitted[2]) if len(fitted) > 4 else 0.0
        return None

    def _model(self, extra: float) -> tuple[FloatArray, FloatArray]:
        """How the rows combine while `extra` of the nuisance lies on the patch, and the inverse normal matrix."""
        if len(self._rows) == 4:
            return _PLAIN, self._inverse
        mixture = np.eye(5, 7)
        mixture[0, 5] = mixture[1, 6] = extra
        return mixture, _inverse(mixture @ self._normal @ mixture.T)

    def _sample(self, image: npt.NDArray[Any], shift: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What the image shows under the shifted mask minus the patch's mean level, and the shift's fraction."""
        place = self._corner + shift
        whole = np.floor(place).astype(int)
        (u, v), (width, height) = whole.tolist(), self._size
        around = image[v - MARGIN_PX : v + height + MARGIN_PX, u - MARGIN_PX : u + width + MARGIN_PX]
        window = interpolated(around.astype(np.float32), place - whole + MARGIN_PX, self._size)
        return window.ravel()[self._inside].astype(np.float64) - self._level, place - whole

    def _judge(
        self,
        sampled: FloatArray,
        products: FloatArray,
        weights: FloatArray,
        spread: FloatArray,
        shift: FloatArray,
        part: FloatArray,
    ) -> PatchMatch:
        gain = float(weights[2])
        count = len(weights)
        unexplained = float(weights @ self._products[:count, :count] @ weights) - 2.0 * float(weights @ products)
        squares = float((sampled * sampled).sum()) + unexplained
        # Interpolation evens out a part of the noise that the residuals show, but not of what moves the fit.
        smoothing = math.prod(float((interpolator(x) ** 2).sum()) for x in part.tolist())
        noise = max(squares / (len(sampled) - count) / (smoothing + self._noise_share), ROUNDING_VARIANCE)
        variance = noise * (1.0 + self._noise_share) / gain**2
        return PatchMatch(
            shift=shift,
            covariance=variance * spread,
            correlation=_correlation(sampled, -unexplained),
            unrigid=-product(self._stretched_projection, sampled) / gain,
            unrigid_covariance=variance * self._stretched_excess,
        )

    def _best_place(self, image: npt.NDArray[Any], reduction: int) -> npt.NDArray[np.int_]:
        """Top-left place (column, row) of the patch in `image`, both first reduced by a whole factor."""
        whole, chip, mask = image.astype(np.float32), self._chip, self._mask
        if reduction > 1:
            whole, chip, mask = (reduced(array, reduction) for array in (whole, chip, mask))
            mask = (mask > 0.5).astype(np.float32)
        scores = cv2.matchTemplate(whole, chip, cv2.TM_CCOEFF_NORMED, mask=mask)
        scores[~np.isfinite(scores) | (scores > 1.001)] = -1.0
        return np.array(cv2.minMaxLoc(scores)[3]) * reduction


def take_patch(
    image: Float32Array,
    mask: BoolArray,
    *,
    noise_levels: float,
    noise_share: float,
    pivot_px: FloatArray | None = None,
    nuisance: FloatArray | None = None,
) -> Patch | None:
    """The patch of `image` under `mask`, or None if it is too small, at the border, or does not fix both axes.

    Args:
        image: grey levels, rows × columns; a mean of several images makes a better patch than one.
        mask: which pixels belong to the patch, as large as the image.
        noise_levels: standard deviation of the noise of the frames to come.
        noise_share: variance of the noise in `image` over that of the frames to come: 1/n for a mean of n frames.
        pivot_px: the point (u, v) whose shift is wanted, for `PatchMatch.unrigid`; the middle of the patch if None.
        nuisance: levels, as large as the image, of which any multiple may come on top of the patch.
    """
    v, u = np.nonzero(mask)
    if len(u) < MIN_PIXELS:
        return None
    low, high = (int(u.min()), int(v.min())), (int(u.max()) + 1, int(v.max()) + 1)
    if min(low) < MARGIN_PX or high[0] > image.shape[1] - MARGIN_PX or high[1] > image.shape[0] - MARGIN_PX:
        return None
    window = (slice(low[1], high[1]), slice(low[0], high[0]))
    cut = None if nuisance is None else nuisance[window]
    rows = _model_rows(image, mask[window], np.array(low, dtype=np.float64), cut)[:5]
    if not _independent(_without_noise(rows @ rows.T, noise_share * noise_levels**2, len(u))):
        return None
    pivot = np.array([u.mean(), v.mean()]) if pivot_px is None else pivot_px
    return Patch(
        image,
        mask[window],
        corner=low,
        pivot_px=pivot,
        noise_levels=noise_levels,
        noise_share=noise_share,
        nuisance=cut,
    )


def _correlation(sampled: FloatArray, explained: float) -> float:
    """Of what was sampled with what the model explains of its sum of squares."""
    mean_part = float(sampled.sum()) ** 2 / len(sampled)
    total = float((sampled * sampled).sum()) - mean_part
    return math.sqrt(min(1.0, max(0.0, (explained - mean_part) / total))) if total > 0.0 else 0.0


def _model_rows(image: Float32Array, mask: BoolArray, corner: FloatArray, nuisance: FloatArray | None) -> FloatArray:
    """What an image of the patch is made of.

    Both derivatives, the patch itself, a constant; if there is a nuisance, it and both its derivatives.
    """
    (u, v), (height, width) = corner.astype(int).tolist(), mask.shape
    framed = image[v - 2 : v + height + 2, u - 2 : u + width + 2].astype(np.float64)
    patch = framed[2:-2, 2:-2]
    parts = [*_derivatives(framed), patch - patch[mask].mean(), np.ones_like(patch)]
    if nuisance is not None:
        parts += [nuisance, *_derivatives(np.pad(nuisance, 2, mode="edge"))]
    return np.stack([part[mask] for part in parts])


def _derivatives(framed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """By u and v, of all but two pixels at the border."""
    height, width = framed.shape[0] - 4, framed.shape[1] - 4
    by_u = sum(c * framed[2:-2, k : k + width] for k, c in enumerate(_DERIVATIVE))
    by_v = sum(c * framed[k : k + height, 2:-2] for k, c in enumerate(_DERIVATIVE))
    return np.asarray(by_u), np.asarray(by_v)


def _stretch_rows(derivatives: FloatArray, mask: BoolArray, pivot: FloatArray) -> FloatArray:
    v, u = np.nonzero(mask)
    return np.stack([derivative * lever for derivative in derivatives for lever in (u - pivot[0], v - pivot[1])])


def _without_noise(products: FloatArray, variance: float, pixels: int) -> FloatArray:
    """What the products of the rows would be if the patch had no noise.

    With it, a fit takes some of the patch for noise and the gain for too small. On a finite patch the gain depends on
    the shift, so that the shift would be off too, by up to 0.01 px.
    """
    corrected = products.copy()
    slope = float((_DERIVATIVE**2).sum())
    for row, share in enumerate((slope, slope, 1.0)):
        corrected[row, row] -= share * variance * pixels
    return corrected


def _independent(normal: FloatArray) -> bool:
    diagonal = np.diag(normal)
    if not diagonal.min() > 0.0:
        return False
    lengths = np.sqrt(diagonal)
    return bool(np.linalg.eigvalsh(normal / np.outer(lengths, lengths))[0] > MIN_INDEPENDENCE)


def _inverse(normal: FloatArray) -> FloatArray:
    """Inverse of a normal matrix, its rows and columns first scaled to a diagonal of ones."""
    lengths = np.sqrt(np.diag(normal))
    return np.asarray(np.linalg.inv(normal / np.outer(lengths, lengths)) / np.outer(lengths, lengths))
