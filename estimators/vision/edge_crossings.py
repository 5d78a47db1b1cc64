"""Lines of pixels across the edges of a square.

Edges are crossed along rows or columns of the image, whichever is nearer to their normal: so every pixel is met once
and none is interpolated, and where it lies to the edge is known exactly.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.estimators.vision.quadrilateral import FloatArray, Line


class Edge(NamedTuple):
    """The straight line between two corners: middle, unit tangent, half-length; inside is right of the tangent."""

    u: float
    v: float
    tangent_u: float
    tangent_v: float
    half_length: float

    def line(self, offset: float, slope: float) -> Line:
        """The edge moved inward by `offset` + `slope` · along, px."""
        turn = slope / self.half_length
        n_u, n_v = -self.tangent_v - turn * self.tangent_u, self.tangent_u - turn * self.tangent_v
        return n_u, n_v, offset + n_u * self.u + n_v * self.v

    def along(self, u: float, v: float) -> float:
        """Where a point lies along the edge, −1 … 1 between the corners."""
        return ((u - self.u) * self.tangent_u + (v - self.v) * self.tangent_v) / self.half_length

    def span(self, within_px: float, reach: int) -> float:
        """How far from the middle lines have pixels within `within_px` of it along the edge, px on the image's axis.

        With −`reach`: how far lines have no others.
        """
        oblique, aligned = sorted((abs(self.tangent_u), abs(self.tangent_v)))
        return (within_px + reach * oblique) * aligned


class Crossings(NamedTuple):
    """Lines of pixels across the four edges, from the outside to the inside.

    Attributes:
        cells: places in the flat image, 4 edges × pixels of a line × lines; beyond the image, those at its border.
        in_view: which pixels are in the image; None if all are.
        middles: u, v, across (px, inward positive) and along of the middle pixel of each line, 4 edges × 4 × lines.
        steps: how these grow from one pixel of a line to the next, 4 edges × 4.
        places: of the pixels of a line, counted from its middle.
    """

    cells: npt.NDArray[np.intp]
    in_view: npt.NDArray[np.bool_] | None
    middles: FloatArray
    steps: FloatArray
    places: npt.NDArray[np.intp]


def edges_of(quad: FloatArray) -> list[Edge]:
    """The edges between adjacent corners; `quad` is clockwise as displayed."""
    # Plain floats: several times as fast as arrays of four.
    corners = quad.tolist()
    edges = []
    for (u0, v0), (u1, v1) in zip(corners, corners[1:] + corners[:1], strict=True):
        length = math.hypot(u1 - u0, v1 - v0)
        edges.append(Edge(0.5 * (u0 + u1), 0.5 * (v0 + v1), (u1 - u0) / length, (v1 - v0) / length, 0.5 * length))
    return edges


def pixels_across(edges: list[Edge], reach_px: float) -> int:
    """How many pixels of a line reach `reach_px` across the edges."""
    return max(1, round(reach_px / min(max(abs(edge.tangent_u), abs(edge.tangent_v)) for edge in edges)))


def cross(edges: list[Edge], shape: tuple[int, ...], *, lines: int, stride: int, reach: int) -> Crossings:
    """Cross each edge at its middle and `lines` times on either side of it, `stride` px apart, by ± `reach` pixels.

    `shape` is that of the image, rows and columns.
    """
    columns = shape[1]
    growths = [_growth(edge, shape, lines, stride, reach) for edge in edges]
    table = np.array([rows for rows, _ in growths])
    numbers, places = np.arange(2 * lines + 1), np.arange(-reach, reach + 1)
    crossed = table[:, 4, :1] + table[:, 4, 1:2] * numbers
    causes = np.ones((4, 3, len(numbers)))
    causes[:, 1] = numbers
    np.subtract(np.rint(crossed), crossed, out=causes[:, 2])
    middles, steps = table[:, :4, :3] @ causes, table[:, :4, 3]
    if all(in_view for _, in_view in growths):
        middle_cells = np.rint(middles[:, 1] * columns + middles[:, 0]).astype(np.intp)
        cell_steps = (steps[:, 1] * columns + steps[:, 0]).astype(np.intp)
        cells = middle_cells[:, None] + (cell_steps[:, None] * places)[:, :, None]
        return Crossings(cells, None, middles, steps, places)
    u, v = (np.rint(middles[:, k, None] + steps[:, k, None, None] * places[:, None]) for k in (0, 1))
    nearest_u, nearest_v = np.clip(u, 0, columns - 1), np.clip(v, 0, shape[0] - 1)
    cells = (nearest_v * columns + nearest_u).astype(np.intp)
    return Crossings(cells, (u == nearest_u) & (v == nearest_v), middles, steps, places)


def _growth(
    edge: Edge, shape: tuple[int, ...], lines: int, stride: int, reach: int
) -> tuple[tuple[tuple[float, ...], ...], bool]:
    """How u, v, across, along and the edge's place on the crossed axis grow, and whether all pixels are in the image.

    They grow with 1; with the number of the line; with what its middle pixel is off the edge, in pixels; and with the
    place in the line.
    """
    u, v, tangent_u, tangent_v, half_length = edge
    # Lines follow each other along the major axis and lead along the minor one. The normal is (−tangent_v, tangent_u).
    u_is_major = abs(tangent_u) >= abs(tangent_v)
    if u_is_major:
        major, minor, t_major, t_minor, inward = u, v, tangent_u, tangent_v, math.copysign(1.0, tangent_u)
        minor_size, major_size = shape
    else:
        major, minor, t_major, t_minor, inward = v, u, tangent_v, tangent_u, math.copysign(1.0, -tangent_v)
        major_size, minor_size = shape
    slope = t_minor / t_major
    first = round(major) - lines * stride
    last = first + 2 * lines * stride
    low, high = sorted((minor + slope * (first - major), minor + slope * (last - major)))
    in_view = first >= 0 and last < major_size and reach <= round(low) and round(high) < minor_size - reach
    on_major = (first, stride, 0.0, 0.0)
    on_minor = (minor + slope * (first - major), slope * stride, 1.0, inward)
    across = (0.0, 0.0, abs(t_major) * inward, abs(t_major))
    per_px = 1.0 / (t_major * half_length)
    along = ((first - major) * per_px, stride * per_px, t_minor / half_length, t_minor * inward / half_length)
    on_axes = (on_major, on_minor) if u_is_major else (on_minor, on_major)
    return (*on_axes, across, along, on_minor), in_view
