"""What is laid over a picture: very many blobs, and rods that come in from its border; analytic, as all of it."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.fakes.world.normal import normal_cdf

Array = npt.NDArray[np.float64]
Levels = npt.NDArray[np.float32]

_TILE_PX = 32
_REACH_SIGMAS = 4.0
_EDGE_SIGMAS = 6.0
_BATCH = 96
"""So few blobs at once that BLAS stays in one thread, whatever the computer: sums keep their order."""

_LEAST_EXPONENT = np.float32(-16.0)
"""No grey level can be told from it; products of smaller numbers would be denormal, and thirty times as slow."""


class Rod(NamedTuple):
    """A straight rod with a square end, which leaves the picture.

    Attributes:
        end_px: middle of its end.
        along: unit vector from the end into the rod.
        depth_levels: how much darker than what lies behind.
        smear_px: how far the end moves during the exposure, along the rod.
    """

    end_px: tuple[float, float]
    along: tuple[float, float]
    half_width_px: float
    depth_levels: float
    smear_px: float = 0.0


class Overlay(NamedTuple):
    """Things to lay over a picture: `blobs_px` are rows of u, v, radius (px) and depth (grey levels)."""

    blobs_px: Array
    rods: tuple[Rod, ...] = ()

    def shifted(self, by_px: Array) -> Overlay:
        """The same, elsewhere in the picture."""
        blobs = self.blobs_px.copy()
        blobs[:, :2] += by_px
        rods = (rod._replace(end_px=(rod.end_px[0] + by_px[0], rod.end_px[1] + by_px[1])) for rod in self.rods)
        return Overlay(blobs, tuple(rods))

    def paint(self, image: Levels, *, blur_px: float) -> None:
        """Subtract it from an image; pixel (0, 0) is the centre of the top-left one."""
        _paint_blobs(image, self.blobs_px, blur_px)
        for rod in self.rods:
            _paint_rod(image, rod, blur_px)


def _paint_blobs(image: Levels, blobs: Array, blur_px: float) -> None:
    """Sums of separable Gaussians, tile by tile: each tile is one product of two matrices."""
    if not len(blobs):
        return
    height, width = image.shape
    sigmas = np.hypot(blobs[:, 2], blur_px)
    margin = math.ceil(_REACH_SIGMAS * sigmas.max())
    tile = max(_TILE_PX, margin)
    upper = np.array([width, height]) + margin
    near = np.flatnonzero(np.all((blobs[:, :2] > -margin) & (blobs[:, :2] < upper), axis=1))
    places = np.floor(blobs[near, :2] / tile).astype(np.int64)
    keys = places[:, 1] * (width + 4 * margin) + places[:, 0]
    order = np.argsort(keys, kind="stable")
    places, near, keys = places[order], near[order], keys[order]
    # Relative to the tile: single precision is then good to 1e-5 px.
    relative = blobs[near, :2] - places * tile + margin
    across, down = (_bells(relative[:, axis], sigmas[near], tile + 2 * margin) for axis in (0, 1))
    down *= blobs[near, 3].astype(np.float32)[:, None]
    bounds = [0, *(np.flatnonzero(np.diff(keys)) + 1).tolist(), len(keys)] if len(keys) else []
    for begin, end in itertools.pairwise(bounds):
        left, top = (places[begin] * tile - margin).tolist()
        columns, own_columns = _overlap(left, tile + 2 * margin, width)
        rows, own_rows = _overlap(top, tile + 2 * margin, height)
        for first in range(begin, end, _BATCH):
            batch = slice(first, min(first + _BATCH, end))
            image[rows, columns] -= down[batch, own_rows].T @ across[batch, own_columns]


def _overlap(start: int, length: int, size: int) -> tuple[slice, slice]:
    """Where a stretch of pixels meets an image axis: in the image, and in the stretch."""
    low, high = max(start, 0), max(min(start + length, size), 0)
    return slice(low, high), slice(low - start, max(high - start, low - start))


def _bells(centres: Array, sigmas: Array, length: int) -> Levels:
    """Gaussians along a line of pixels, one a row."""
    narrow = (1.0 / sigmas).astype(np.float32)[:, None]
    distances = np.arange(length, dtype=np.float32)[None, :] * narrow
    distances -= (centres / sigmas).astype(np.float32)[:, None]
    distances *= distances
    distances *= np.float32(-0.5)
    np.maximum(distances, _LEAST_EXPONENT, out=distances)
    return np.asarray(np.exp(distances, out=distances))


def _paint_rod(image: Levels, rod: Rod, blur_px: float) -> None:
    """Blurred edges along both sides and across the end."""
    (end_u, end_v), (along_u, along_v) = rod.end_px, rod.along
    if abs(along_v) < abs(along_u):
        image, end_u, end_v, along_u, along_v = image.T, end_v, end_u, along_v, along_u
    # Now the rod crosses rows: in each of them a few columns are near it.
    height, width = image.shape
    end_sigma = math.sqrt(blur_px**2 + rod.smear_px**2 / 12.0)
    reach = (rod.half_width_px + _EDGE_SIGMAS * blur_px) / abs(along_v)
    behind = _EDGE_SIGMAS * end_sigma + reach
    rows = _rows(end_v, along_v, behind, height)
    middles = end_u + (rows - end_v) * (along_u / along_v)
    columns = np.floor(middles - reach).astype(np.int64)[:, None] + np.arange(math.ceil(2.0 * reach) + 2)
    u, v = columns - end_u, rows[:, None] - end_v
    inside = (columns >= 0) & (columns < width) & (u * along_u + v * along_v > -behind)
    row = np.nonzero(inside)[0]
    u, v, row = u[inside], v[row, 0], rows[row]
    sideways, inwards = v * along_u - u * along_v, u * along_u + v * along_v
    covered = normal_cdf((sideways + rod.half_width_px) / blur_px)
    covered -= normal_cdf((sideways - rod.half_width_px) / blur_px)
    covered *= normal_cdf(inwards / end_sigma)
    image[row, columns[inside]] -= (rod.depth_levels * covered).astype(np.float32)


def _rows(end: float, along: float, behind: float, height: int) -> npt.NDArray[np.int64]:
    """The rows that a rod can touch."""
    if along > 0.0:
        return np.arange(max(0, math.floor(end - behind)), height)
    return np.arange(0, min(height, math.ceil(end + behind) + 1))
