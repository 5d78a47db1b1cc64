"""Where a tip ends ahead: its front, from the region that moved."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from microdrivers.estimators.vision.patch import BoolArray
from microdrivers.estimators.vision.template import Float32Array, FloatArray

FLANK_PX = (4, 10)
"""From here to there behind and ahead of the front, the image is evenly that of the tip, or of what is ahead."""

_BODY_PX = 15.0


class TipFront(NamedTuple):
    """Where the moving region ends ahead, on an image of it.

    Attributes:
        point: middle of the front, (u, v) px.
        width_px: of the tip near its front.
        profile: 0 on the tip … 1 ahead of it, at the whole pixels −FLANK_PX[1] … FLANK_PX[1] along the direction.
    """

    point: FloatArray
    width_px: float
    profile: FloatArray

    def along(self, direction: FloatArray, shape: tuple[int, ...]) -> FloatArray:
        """How far ahead of the front each pixel of an image is, px."""
        v, u = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float64)
        return np.asarray((u - self.point[0]) * direction[0] + (v - self.point[1]) * direction[1])

    def ahead(self, direction: FloatArray, shape: tuple[int, ...]) -> FloatArray:
        """What another brightness ahead of the tip adds to its image: when it arrives, the specimen is there."""
        steps = np.arange(-FLANK_PX[1], FLANK_PX[1] + 1.0)
        return np.asarray(np.interp(self.along(direction, shape), steps, self.profile))


def find_front(image: Float32Array, region: BoolArray, direction: FloatArray) -> TipFront:
    """The front of the moving region: half-way between the levels on the tip and ahead of it."""
    v, u = np.nonzero(region)
    across_axis = np.array([-direction[1], direction[0]])
    along, across = np.stack([u, v], axis=1) @ direction, np.stack([u, v], axis=1) @ across_axis
    rough = float(np.percentile(along, 99.0))
    body = (along > rough - _BODY_PX) & (along < rough - 2.0)
    chosen = across[body] if int(body.sum()) > 4 else across
    low, high = np.percentile(chosen, [3.0, 97.0])
    middle, width = 0.5 * float(low + high), float(high - low)
    reach = FLANK_PX[1]
    for _ in range(2):
        steps = np.arange(-reach, reach + 1.0)
        levels = _mean_levels(
            image, steps + rough, direction, np.linspace(-0.25, 0.25, 9) * width + middle, across_axis
        )
        tip, ahead = float(levels[: reach - FLANK_PX[0]].mean()), float(levels[reach + FLANK_PX[0] :].mean())
        profile = _share(levels, tip, ahead)
        rough += reach + 0.5 - float(profile.sum())
        steps = np.arange(-math.ceil(0.5 * width) - 6.0, math.ceil(0.5 * width) + 7.0)
        levels = _mean_levels(image, steps + middle, across_axis, np.arange(-10.0, -3.0) + rough, direction)
        cover = 1.0 - _share(levels, tip, 0.5 * float(levels[0] + levels[-1]))
        if cover.sum() > 1.0:
            middle, width = middle + float((steps * cover).sum() / cover.sum()), float(cover.sum())
    return TipFront(rough * direction + middle * across_axis, width, profile)


def _mean_levels(
    image: Float32Array, along: FloatArray, along_axis: FloatArray, across: FloatArray, across_axis: FloatArray
) -> FloatArray:
    """Grey levels at the places `along` a unit vector, each the mean over the places `across` it."""
    places = along[None, :, None] * along_axis + across[:, None, None] * across_axis
    maps = (places[..., 0].astype(np.float32), places[..., 1].astype(np.float32))
    levels = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(levels.mean(axis=0), dtype=np.float64)


def _share(levels: FloatArray, low: float, high: float) -> FloatArray:
    """0 where the level is `low`, 1 where it is `high`."""
    contrast = high - low if abs(high - low) > 1.0 else math.copysign(1.0, high - low)
    return np.asarray(np.clip((levels - low) / contrast, 0.0, 1.0))
