"""The pixels that carry the edges of a square: first levels from profiles, then the bands along the edges."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from microdrivers.estimators.vision.points import GreyImage
from microdrivers.estimators.vision.quadrilateral import FOLLOWING, FloatArray, intersect_lines

_ALONG = np.linspace(-0.7, 0.7, 11)
_SQUARE_OF_ALONG = float(np.mean(_ALONG**2))


class EdgeFrames(NamedTuple):
    """A straight line per edge: middle, unit tangent, inward unit normal (4×2 each), half-length (4)."""

    middle: FloatArray
    tangent: FloatArray
    normal: FloatArray
    half_length: FloatArray

    def lines(self, offsets: FloatArray, slopes: FloatArray) -> FloatArray:
        """Rows (n_u, n_v, c) of n·p = c for the edges moved inward by `offsets` + `slopes` · along, px."""
        lines = np.empty((4, 3))
        lines[:, :2] = self.normal - (slopes / self.half_length)[:, None] * self.tangent
        lines[:, 2] = offsets + (lines[:, :2] * self.middle).sum(axis=1)
        return lines


class Start(NamedTuple):
    """Where a fit begins: corners to a tenth of a pixel, grey levels and blur to some percent."""

    quad: FloatArray
    outside: float
    contrast: float
    blur_px: float


class Bands(NamedTuple):
    """Pixels near the four edges, ordered by edge, in the frame of their own edge.

    The rows of `pixels` (float32: half the time, and rounding stays below 1e-6 px) are the grey level; `across`,
    the distance from the starting line (px, inward positive); `along`, −1 … 1 between the corners; u and v from
    the centre, in sides. `cells` are their places in the box `box_shape` around the square, `parts` each edge's
    range of pixels, `counts` the lengths of these.
    """

    pixels: npt.NDArray[np.float32]
    cells: npt.NDArray[np.intp]
    box_shape: tuple[int, int]
    parts: tuple[slice, ...]
    counts: tuple[int, ...]

    def keep(self, wanted: npt.NDArray[np.bool_]) -> Bands:
        """Only the `wanted` pixels."""
        counts = tuple(int(np.count_nonzero(wanted[part])) for part in self.parts)
        return Bands(self.pixels[:, wanted], self.cells[wanted], self.box_shape, _parts(counts), counts)


def _parts(counts: tuple[int, ...]) -> tuple[slice, ...]:
    a, b, c, d = counts
    return slice(0, a), slice(a, a + b), slice(a + b, a + b + c), slice(a + b + c, a + b + c + d)


def edge_frames(quad: FloatArray) -> EdgeFrames:
    """The straight lines between adjacent corners; `quad` is clockwise as displayed."""
    step = quad[FOLLOWING] - quad
    half_length = 0.5 * np.hypot(step[:, 0], step[:, 1])
    tangent = step / (2.0 * half_length[:, None])
    normal = tangent[:, ::-1] * (-1.0, 1.0)
    return EdgeFrames(quad + 0.5 * step, tangent, normal, half_length)


def estimate_start(image: GreyImage, quad: FloatArray, *, reach_px: float) -> Start | None:
    """Improve a detected quadrilateral by profiles of ± `reach_px` across its edges.

    With y the profile normalised to 0 … 1, the mean of y tells where the edge lies, and the mean of y(1 − y) its
    blur. None if there is no contrast.
    """
    frames = edge_frames(quad)
    across = np.arange(-math.floor(reach_px), math.floor(reach_px) + 1.0)
    rows, columns = image.shape
    u, v = (
        (frames.middle[:, k, None] + (frames.half_length * frames.tangent[:, k])[:, None] * _ALONG)[:, :, None]
        + frames.normal[:, k, None, None] * across
        for k in (0, 1)
    )
    column = np.rint(u).astype(np.intp).clip(0, columns - 1)
    row = np.rint(v).astype(np.intp).clip(0, rows - 1)
    profile = image[row, column].astype(np.float64)
    tail = max(2, len(across) // 5)
    outside = _median(profile[:, :, :tail])
    contrast = _median(profile[:, :, -tail:]) - outside
    if contrast == 0.0:
        return None
    profile -= outside
    profile *= 1.0 / contrast
    length = float(len(across))
    area = length * float((profile * (1.0 - profile)).mean())
    position = length * (0.5 - profile.mean(axis=2))
    lines = frames.lines(position.mean(axis=1), (position @ _ALONG) / (len(_ALONG) * _SQUARE_OF_ALONG))
    moved = intersect_lines(lines)
    if not np.abs(moved - quad).max() < 0.5 * reach_px:
        moved = quad
    return Start(moved, outside, contrast, min(max(math.sqrt(math.pi) * area, 0.5), 0.4 * reach_px))


def _median(values: npt.NDArray[np.float64]) -> float:
    middle = values.size // 2
    return float(np.partition(values, middle, axis=None)[middle])


def select_bands(image: GreyImage, quad: FloatArray, *, half_width: float, corner_gap: float) -> Bands:
    """Collect the pixels within `half_width` of an edge and farther than `corner_gap` from its corners, px."""
    frames = edge_frames(quad)
    rows, columns = image.shape
    low = np.maximum(np.floor(quad.min(axis=0) - half_width - 2.0), 0).astype(int)
    high = np.minimum(np.ceil(quad.max(axis=0) + half_width + 3.0), (columns, rows)).astype(int)
    box = image[low[1] : high[1], low[0] : high[0]]
    box_shape = int(box.shape[0]), int(box.shape[1])

    edge_of = np.zeros(box_shape, dtype=np.uint8)
    outlines = _outlines(frames, half_width, corner_gap) - low
    for k, outline in enumerate(np.rint(outlines * 16).astype(np.int32)):
        cv2.fillConvexPoly(edge_of, outline, k + 1, lineType=cv2.LINE_8, shift=4)
    of_each = [np.flatnonzero(edge_of == k) for k in range(1, 5)]
    cells = np.concatenate(of_each)
    counts = tuple(len(own) for own in of_each)
    bands = Bands(np.empty((5, len(cells)), np.float32), cells, box_shape, _parts(counts), counts)

    grey, across, along, u, v = bands.pixels
    grey[:] = box.ravel()[cells]
    row = cells // box_shape[1]
    v[:] = row
    u[:] = cells - row * box_shape[1]
    centre = quad.mean(axis=0)
    u += low[0] - centre[0]
    v += low[1] - centre[1]
    middle = frames.middle - centre
    tangent = frames.tangent / frames.half_length[:, None]
    rest = (frames.normal * middle).sum(axis=1), (tangent * middle).sum(axis=1)
    for k, part in enumerate(bands.parts):
        across[part] = frames.normal[k, 0] * u[part] + frames.normal[k, 1] * v[part] - rest[0][k]
        along[part] = tangent[k, 0] * u[part] + tangent[k, 1] * v[part] - rest[1][k]
    bands.pixels[3:] *= 2.0 / frames.half_length.sum()
    return bands


def _outlines(frames: EdgeFrames, half_width: float, corner_gap: float) -> FloatArray:
    """The rectangle around each edge, 4 edges × 4 corners × 2."""
    reach = (frames.half_length - corner_gap)[:, None] * frames.tangent
    width = half_width * frames.normal
    middle = frames.middle
    return np.stack(
        [middle - reach - width, middle + reach - width, middle + reach + width, middle - reach + width], axis=1
    )
