"""What moved between images: the region that changed, how far its content came, the light made equal first."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from microdrivers.core.errors import DataError
from microdrivers.estimators.vision.patch import BoolArray
from microdrivers.estimators.vision.template import ROUNDING_VARIANCE, Float32Array, FloatArray

_BLOCK_PX = 8
"""Side of the blocks over which grey levels are averaged."""

_SMOOTHING_PX = 1.0
"""Standard deviation of the blur before images are compared."""

_SIGMAS = 6.0
"""Standard deviations of the noise, after the blur, beyond which a pixel has changed."""

_CLOSING_PX = 7
"""Gaps in what changed that are closed."""

_MIN_REGION_PX = 20
"""Pixels of the smallest region that is no noise."""

_SURROUNDING_PX = 6
"""Beyond the region: what is looked for together with it."""

_LENGTH_RANGE = (0.5, 1.7)
"""Displacements that count, relative to the one expected."""


class EvenSeries(NamedTuple):
    """Images brought to the light of the last one, and the standard deviation of their noise, grey levels."""

    images: list[Float32Array]
    noise_levels: float


def even_light(images: Sequence[npt.NDArray[Any]]) -> EvenSeries:
    """Bring all images to the brightness of the last one, by the median over blocks of the ratio of grey levels.

    Raises:
        DataError: they differ in size.
    """
    if len({image.shape for image in images}) > 1:
        raise DataError("the frames differ in size", remedy="keep the camera's region and binning between the frames")
    last = images[-1].astype(np.float32)
    means = _blocks(last)
    even = []
    for image in images[:-1]:
        ratio = means / np.maximum(_blocks(image.astype(np.float32)), 1.0)
        even.append(image.astype(np.float32) * np.float32(np.median(ratio)))
    even.append(last)
    if len(even) > 1:
        variance = float(np.median([np.median(_blocks((b - a) ** 2)) for a, b in itertools.pairwise(even)]))
        noise_variance = variance / 2.0
    else:
        rough = last - cv2.GaussianBlur(last, (0, 0), _SMOOTHING_PX)
        noise_variance = float(np.median(_blocks(rough * rough)))
    return EvenSeries(even, math.sqrt(max(noise_variance, ROUNDING_VARIANCE)))


def changed_region(before: Float32Array, after: Float32Array, noise_levels: float) -> BoolArray | None:
    """The pixels of the one connected region that changed most, without holes; None if nothing changed."""
    difference = cv2.GaussianBlur(after - before, (0, 0), _SMOOTHING_PX)
    limit = _SIGMAS * noise_levels * math.sqrt(2.0) / (2.0 * math.sqrt(math.pi) * _SMOOTHING_PX)
    strength = np.abs(difference)
    # Single pixels beyond the limit are noise, however bright.
    opened = cv2.morphologyEx((strength > limit).astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_CLOSING_PX, _CLOSING_PX))
    count, labels = cv2.connectedComponents(cv2.morphologyEx(opened, cv2.MORPH_CLOSE, kernel))
    if count < 2:
        return None
    weights = np.bincount(labels.ravel(), weights=strength.ravel(), minlength=count)
    chosen = 1 + int(np.argmax(weights[1:]))
    region = (labels == chosen).astype(np.uint8)
    if int(region.sum()) < _MIN_REGION_PX:
        return None
    outlines, _ = cv2.findContours(region, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(region, outlines, -1, 1, thickness=cv2.FILLED)
    return np.asarray(region > 0)


def displacement_into(
    region: BoolArray, before: Float32Array, after: Float32Array, *, length_px: float
) -> tuple[FloatArray, float]:
    """How far (u, v) the content of `region` of the image `after` has come since `before`, and the correlation.

    Only displacements of about `length_px` count, so that what rests does not compete.
    """
    v, u = np.nonzero(region)
    reach = math.ceil(_LENGTH_RANGE[1] * length_px)
    low = np.maximum(np.array([u.min(), v.min()]) - _SURROUNDING_PX, 0)
    high = np.minimum(np.array([u.max(), v.max()]) + 1 + _SURROUNDING_PX, after.shape[::-1])
    chip = after[low[1] : high[1], low[0] : high[0]]
    # A probe reaches to the border of the image: beyond it, it goes on as it is there.
    padded = cv2.copyMakeBorder(before, reach, reach, reach, reach, cv2.BORDER_REPLICATE)
    area = padded[low[1] : high[1] + 2 * reach, low[0] : high[0] + 2 * reach]
    scores = cv2.matchTemplate(area, chip, cv2.TM_CCOEFF_NORMED)
    y, x = np.mgrid[0 : scores.shape[0], 0 : scores.shape[1]] - reach
    length = np.hypot(x, y)
    plausible = (length >= _LENGTH_RANGE[0] * length_px) & (length <= reach) & np.isfinite(scores)
    scores[~plausible] = -1.0
    row, column = np.unravel_index(int(np.argmax(scores)), scores.shape)
    return np.array([reach - float(column), reach - float(row)]), float(scores[row, column])


def _blocks(image: Float32Array) -> Float32Array:
    """Means over blocks of pixels."""
    rows, columns = (max(1, n // _BLOCK_PX) for n in image.shape)
    whole = image[: rows * _BLOCK_PX, : columns * _BLOCK_PX]
    return np.asarray(cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA), dtype=np.float32)
