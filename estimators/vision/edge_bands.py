"""The pixels that carry the edges of a square: first levels from profiles, then the bands along the edges."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.estimators.vision.edge_crossings import cross, edges_of, pixels_across
from microdrivers.estimators.vision.points import GreyImage
from microdrivers.estimators.vision.quadrilateral import FloatArray, intersect_lines

_PROFILES = 16
"""So many profiles, or fewer, on either side of the middle of an edge."""
_PROFILES_WITHIN = 0.8
"""They keep to this share of their edge: beyond, they would meet the next one."""


class Start(NamedTuple):
    """Where a fit begins: corners to some hundredths of a pixel, grey levels and blur to some percent."""

    quad: FloatArray
    outside: float
    contrast: float
    blur_px: float


class Bands(NamedTuple):
    """Pixels near the four edges in the frame of their own edge: 4 edges × pixels of a line across × lines.

    The rows of `pixels` (float32: half the time, and rounding stays below 1e-6 px) are the grey level; 1; u and v
    from the centre, in sides; `across`, the distance from the starting line (px, inward positive); `along`, −1 … 1
    between the corners. The first four are 0 for pixels that are left out, among them all of the first and the last
    line of each edge. `counts` tells how many pixels of each edge are not.
    """

    pixels: npt.NDArray[np.float32]
    counts: list[int]

    def without(self, unwanted: npt.NDArray[np.bool_]) -> Bands:
        """The bands with the `unwanted` pixels left out."""
        pixels = self.pixels.copy()
        pixels[:4] *= ~unwanted
        return Bands(pixels, _counts(pixels))


def _counts(pixels: npt.NDArray[np.float32]) -> list[int]:
    return [int(np.count_nonzero(ones)) for ones in pixels[1]]


def estimate_start(image: GreyImage, quad: FloatArray, *, reach_px: float) -> Start | None:
    """Improve a detected quadrilateral by profiles of ± `reach_px` across its edges.

    With y the profile normalised to 0 … 1, the mean of y tells where the edge lies, and the mean of y(1 − y) its
    blur. None if there is no contrast.
    """
    edges = edges_of(quad)
    reach = pixels_across(edges, reach_px)
    span = min(edge.span(_PROFILES_WITHIN * edge.half_length, -reach) for edge in edges)
    stride = math.ceil(span / _PROFILES)
    crossings = cross(edges, image.shape, lines=max(1, int(span // stride)), stride=stride, reach=reach)
    profiles = image.take(crossings.cells).astype(np.float64)
    length = profiles.shape[1]
    tail = max(2, length // 5)
    outside = _levels(profiles[:, :tail])
    contrast = _levels(profiles[:, -tail:]) - outside
    if not contrast.all():
        return None
    profiles -= outside[:, None, None]
    inside = profiles.sum(axis=1) / contrast[:, None]
    to_edge = 0.5 * length - inside
    points = np.ones((4, 3, to_edge.shape[1]))
    points[:, 1:] = crossings.middles[:, 2:] + crossings.steps[:, 2:, None] * to_edge[:, None]
    products = (points @ points.transpose(0, 2, 1)).tolist()
    moved = intersect_lines([edge.line(*_straight(own)) for edge, own in zip(edges, products, strict=True)])
    if not np.abs(moved - quad).max() < 0.5 * reach_px:
        moved = quad
    squares = np.einsum("eij,eij->e", profiles, profiles) / contrast**2
    area = float((inside.sum(axis=1) - squares) @ crossings.steps[:, 2]) / to_edge.size
    blur_px = min(max(math.sqrt(math.pi) * area, 0.5), 0.4 * reach_px)
    return Start(moved, sum(outside.tolist()) / 4.0, sum(contrast.tolist()) / 4.0, blur_px)


def _levels(pixels: FloatArray) -> FloatArray:
    """Mean grey level of each edge's pixels, the brightest and the darkest quarter left out."""
    in_order = np.sort(pixels.reshape(4, -1), axis=1)
    quarter = in_order.shape[1] // 4
    middle = in_order[:, quarter:-quarter]
    return np.asarray(middle.sum(axis=1) / middle.shape[1])


def _straight(products: list[list[float]]) -> tuple[float, float]:
    """Offset and slope of the line through points, from the sums of products of 1, across and along."""
    (count, across, along), (_, _, across_along), (_, _, along_along) = products
    slope = (count * across_along - along * across) / (count * along_along - along * along)
    return (across - slope * along) / count, slope


def select_bands(image: GreyImage, quad: FloatArray, *, half_width: float, corner_gap: float) -> Bands:
    """Collect the pixels within `half_width` of an edge and farther than `corner_gap` from its corners, px."""
    edges = edges_of(quad)
    reach = pixels_across(edges, half_width)
    span = max(edge.span(edge.half_length - corner_gap, reach) for edge in edges)
    crossings = cross(edges, image.shape, lines=math.ceil(span + 0.5), stride=1, reach=reach)
    pixels = np.empty((6, *crossings.cells.shape), dtype=np.float32)
    pixels[0] = image.take(crossings.cells)
    middles, steps = crossings.middles, crossings.steps
    per_side = 2.0 / sum(edge.half_length for edge in edges)
    middles[:, 0] -= sum(edge.u for edge in edges) / 4.0
    middles[:, 1] -= sum(edge.v for edge in edges) / 4.0
    middles[:, :2] *= per_side
    steps[:, :2] *= per_side
    growth = steps[:, :, None] * crossings.places
    np.add(
        middles.astype(np.float32).transpose(1, 0, 2)[:, :, None, :],
        growth.astype(np.float32).transpose(1, 0, 2)[:, :, :, None],
        out=pixels[2:],
    )
    ends = np.array([1.0 - corner_gap / edge.half_length for edge in edges], dtype=np.float32)
    wanted = np.abs(pixels[5]) <= ends[:, None, None]
    if crossings.in_view is not None:
        wanted &= crossings.in_view
    pixels[1] = wanted
    pixels[0] *= pixels[1]
    pixels[2:4] *= pixels[1]
    return Bands(pixels, _counts(pixels))
