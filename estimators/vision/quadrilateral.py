"""Find square-like blobs in an image: flatten, threshold, components, contour, four fitted sides.

Works on a reduced image and is good to about half a pixel, or to some at a glance; `edge_fit` takes over from there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from microdrivers.estimators.vision.points import GreyImage

FloatArray = npt.NDArray[np.float64]
Line = tuple[float, float, float]
"""(n_u, n_v, c) of n·p = c."""

MIN_SIDE_RATIO = 0.8
MAX_ANGLE_ERROR_DEG = 15.0
BORDER_MARGIN_PX = 4.0
"""A corner nearer than this to the image border counts as not in view."""

ORDER = np.array([[0, 1, 2, 3], [1, 2, 3, 0], [2, 3, 0, 1], [3, 0, 1, 2]])
"""Row k: the corners in cyclic order, beginning with corner k."""
PRECEDING = ORDER[3]

_GLANCE_ROWS = 120
_GLANCE_AREA = 200
"""Squares at a glance have at least so many pixels, 57 × 57 px in 640 × 480."""
_RIVAL_AREA = 0.3
_EVEN_LIGHT = 0.25
_COARSE_ROWS = 240
_MAX_REDUCTION = 4
_CELL = 12
_RIDGE = 1e-6 * np.eye(6)
_MAX_CANDIDATES = 6


class Detection(NamedTuple):
    """Square-like quadrilaterals wholly in view, largest first.

    Attributes:
        quads: 4×2 corner arrays, px from the top-left pixel centre, clockwise as displayed (u right, v down).
        partly_in_view: a large compact blob reaches the border of the image.
    """

    quads: list[FloatArray]
    partly_in_view: bool


class _Blob(NamedTuple):
    contour: npt.NDArray[Any]
    area: float
    at_border: bool


def glance(image: GreyImage, *, min_side_px: float) -> FloatArray | None:
    """Corners of the one large square in even light, clear of the border, good to some pixels; None if in doubt.

    Where this finds a square, `find_quadrilaterals` finds the same one and no rival, in eight times the time.

    Args:
        image: grey image, rows × columns.
        min_side_px: smaller squares are ignored.
    """
    if min(image.shape) < _GLANCE_ROWS:
        return None
    coarse: npt.NDArray[Any] = image
    pitch = 1
    while min(coarse.shape) >= 2 * _GLANCE_ROWS:
        rows, columns = (size // 2 for size in coarse.shape)
        coarse = cv2.resize(coarse[: 2 * rows, : 2 * columns], (columns, rows), interpolation=cv2.INTER_AREA)
        pitch *= 2
    border = np.concatenate((coarse[0], coarse[-1], coarse[:, 0], coarse[:, -1]))
    darkest, brightest = float(border.min()), float(border.max())
    flat = coarse.astype(np.float32)
    flat -= 0.5 * (darkest + brightest)
    low, high, _, _ = cv2.minMaxLoc(flat)
    if brightest - darkest > _EVEN_LIGHT * max(high, -low):
        return None
    contours, _ = cv2.findContours(_foreground(flat), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    areas = [cv2.contourArea(contour) for contour in contours]
    largest = max(areas, default=0.0)
    if largest < _GLANCE_AREA or sum(area > _RIVAL_AREA * largest for area in areas) > 1:
        return None
    centre, (width, height), angle_deg = cv2.minAreaRect(contours[areas.index(largest)])
    if largest < 0.9 * width * height:
        return None
    # Some of the outermost pixels nearly reach the boundary.
    corners = cv2.boxPoints((centre, (width + 0.3, height + 0.3), angle_deg))
    quad = (corners.astype(np.float64) + 0.5) * pitch - 0.5
    seen = is_square_like(quad, min_side_px=min_side_px) and is_inside(quad, image.shape, margin_px=3.0 * pitch)
    return quad if seen else None


def find_quadrilaterals(image: GreyImage, *, min_side_px: float) -> Detection:
    """Detect the square-like blobs of `image`, brighter or darker than their surroundings.

    Args:
        image: grey image, rows × columns.
        min_side_px: smaller squares are ignored.
    """
    rows, columns = image.shape
    if min(rows, columns) < min_side_px:
        return Detection([], partly_in_view=False)
    reduction = int(min(_MAX_REDUCTION, max(1, min(rows, columns) // _COARSE_ROWS)))
    size = (max(1, columns // reduction), max(1, rows // reduction))
    pitch = np.array([columns / size[0], rows / size[1]])
    coarse = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if reduction > 1 else image
    flat = _flatten(cv2.GaussianBlur(coarse, (5, 5), 1.0))
    min_side = min_side_px / float(pitch.mean())

    quads: list[FloatArray] = []
    partly_in_view = False
    for blob in _large_blobs(_foreground(flat), min_side=min_side):
        if blob.at_border:
            partly_in_view = partly_in_view or _is_compact(blob, min_side=min_side)
            continue
        corners = _quadrilateral(blob)
        if corners is None:
            continue
        quad = (corners + 0.5) * pitch - 0.5
        if not is_square_like(quad, min_side_px=min_side_px):
            continue
        if is_inside(quad, (rows, columns), margin_px=BORDER_MARGIN_PX):
            quads.append(quad)
        else:
            partly_in_view = True
    return Detection(quads, partly_in_view)


def side_lengths(quad: FloatArray) -> list[float]:
    """Lengths of the four sides; side i joins corner i to corner i + 1."""
    # Plain floats, here and below: several times as fast as arrays of four.
    corners = quad.tolist()
    return [math.dist(start, end) for start, end in zip(corners, corners[1:] + corners[:1], strict=True)]


def mean_side(quad: FloatArray) -> float:
    """Mean length of the four sides."""
    return sum(side_lengths(quad)) / 4.0


def is_square_like(quad: FloatArray, *, min_side_px: float) -> bool:
    """Whether sides and angles are those of a square seen under slight perspective."""
    corners = quad.tolist()
    steps = [(u1 - u0, v1 - v0) for (u0, v0), (u1, v1) in zip(corners, corners[1:] + corners[:1], strict=True)]
    sides = [math.hypot(du, dv) for du, dv in steps]
    if min(sides) < min_side_px or min(sides) < MIN_SIDE_RATIO * max(sides):
        return False
    along = [(du / side, dv / side) for (du, dv), side in zip(steps, sides, strict=True)]
    largest_cosine = math.sin(math.radians(MAX_ANGLE_ERROR_DEG))
    return all(
        u0 * v1 - v0 * u1 > 0 and abs(u0 * u1 + v0 * v1) < largest_cosine
        for (u0, v0), (u1, v1) in zip(along, along[1:] + along[:1], strict=True)
    )


def is_inside(quad: FloatArray, shape: tuple[int, ...], *, margin_px: float) -> bool:
    """Whether all corners keep `margin_px` from the border of an image of `shape` (rows, columns)."""
    last_v, last_u = (size - 1.0 - margin_px for size in shape)
    return all(margin_px <= u <= last_u and margin_px <= v <= last_v for u, v in quad.tolist())


@cache
def _surface_basis(rows: int, columns: int) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Quadratic basis over a grid of cells, cells × 6, and which cells lie outermost."""
    v, u = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, columns), indexing="ij")
    basis = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1).reshape(-1, 6)
    return basis, (np.maximum(np.abs(u), np.abs(v)) > 0.85).ravel()


def _flatten(image: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Subtract a quadratic surface fitted to the surroundings of whatever stands out."""
    grid = (max(4, image.shape[1] // _CELL), max(4, image.shape[0] // _CELL))
    cells = cv2.resize(image, grid, interpolation=cv2.INTER_LINEAR).astype(np.float64)
    basis, outermost = _surface_basis(*cells.shape)
    levels = cells.ravel()
    # A square wholly in view leaves the outermost cells free: start there, then let in whatever agrees.
    chosen = outermost
    surface = np.full_like(levels, _median(levels[chosen]))
    for _ in range(2):
        deviation = np.abs(levels - surface)
        agreeing = deviation <= 4.5 * _median(deviation[chosen]) + 1e-6
        if np.count_nonzero(agreeing) < 12:
            break
        chosen = agreeing
        a = basis[agreeing]
        # The ridge matters only where the agreeing cells do not determine the surface.
        surface = basis @ np.linalg.solve(a.T @ a + _RIDGE, a.T @ levels[agreeing])
    background = cv2.resize(
        surface.reshape(cells.shape).astype(np.float32),
        (image.shape[1], image.shape[0]),
        interpolation=cv2.INTER_LINEAR,
    )
    return np.asarray(cv2.subtract(image, background, dtype=cv2.CV_32F), dtype=np.float32)


def _median(values: FloatArray) -> float:
    middle = values.size // 2
    return float(np.partition(values, middle)[middle])


def _foreground(flat: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """Mask (0, 1) of what stands out on the side of zero where Otsu's threshold falls."""
    low, high, _, _ = cv2.minMaxLoc(flat)
    if high - low < 1e-3:
        return np.zeros(flat.shape, dtype=np.uint8)
    scale = 255.0 / (high - low)
    scaled = cv2.convertScaleAbs(flat, alpha=scale, beta=-low * scale)
    level, mask = cv2.threshold(scaled, 0, 1, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    if low + (level + 0.5) / scale < 0:
        mask = cv2.bitwise_xor(mask, np.ones_like(mask))
    return np.asarray(mask, dtype=np.uint8)


def _large_blobs(mask: npt.NDArray[np.uint8], *, min_side: float) -> list[_Blob]:
    """Connected regions at least as large as the smallest square, largest first; specks are opened away."""
    opened = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), dtype=np.uint8))
    contours, hierarchy = cv2.findContours(opened, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    blobs = []
    for i, contour in enumerate(contours):
        is_hole = hierarchy[0, i, 3] >= 0
        if is_hole or len(contour) < 2.0 * min_side:
            continue
        area = cv2.contourArea(contour)
        if area < 0.7 * min_side**2:
            continue
        x, y, width, height = cv2.boundingRect(contour)
        inside = x >= 2 and y >= 2 and x + width <= mask.shape[1] - 2 and y + height <= mask.shape[0] - 2
        blobs.append(_Blob(contour, area, not inside))
    return sorted(blobs, key=lambda blob: -blob.area)[:_MAX_CANDIDATES]


def _is_compact(blob: _Blob, *, min_side: float) -> bool:
    """Whether a blob at the border may be a part of a square: filled, convex and not a thin sliver."""
    _, _, width, height = cv2.boundingRect(blob.contour)
    return min(width, height) > 0.5 * min_side and blob.area > 0.85 * _hull_area(blob)


def _hull_area(blob: _Blob) -> float:
    return cv2.contourArea(cv2.convexHull(blob.contour))


def _quadrilateral(blob: _Blob) -> FloatArray | None:
    """Corners of a blob with four straight sides, clockwise as displayed, or None."""
    if blob.area < 0.85 * _hull_area(blob):
        return None
    hull = cv2.convexHull(blob.contour)
    rough = cv2.approxPolyDP(hull, 0.04 * cv2.arcLength(hull, True), True)
    if len(rough) != 4:
        return None
    corners = rough.reshape(4, 2).astype(np.float64)
    if cv2.contourArea(rough, oriented=True) < 0:
        corners = corners[::-1]
    points = blob.contour.reshape(-1, 2).astype(np.float32)
    lines = []
    for i, start in enumerate(corners):
        line = _fit_side(points, start, corners[(i + 1) % 4])
        if line is None:
            return None
        lines.append(line)
    return intersect_lines(lines)


def _fit_side(points: npt.NDArray[np.float32], start: FloatArray, end: FloatArray) -> Line | None:
    """Line n·p = c (n inward) through the boundary pixels between two rough corners, or None if not straight."""
    (u0, v0), (u1, v1) = start.tolist(), end.tolist()
    length = math.hypot(u1 - u0, v1 - v0)
    du, dv = (u1 - u0) / length, (v1 - v0) / length
    u, v = points[:, 0] - 0.5 * (u0 + u1), points[:, 1] - 0.5 * (v0 + v1)
    chosen = (np.abs(u * du + v * dv) < 0.35 * length) & (np.abs(v * du - u * dv) < 0.1 * length + 2.0)
    side = points[chosen]
    if len(side) < 5:
        return None
    fitted = cv2.fitLine(side, cv2.DIST_HUBER, 0, 0.01, 0.01).ravel().tolist()
    turn = math.copysign(1.0, fitted[0] * du + fitted[1] * dv)
    du, dv, u0, v0 = turn * fitted[0], turn * fitted[1], fitted[2], fitted[3]
    off_line = np.abs((side[:, 1] - v0) * du - (side[:, 0] - u0) * dv)
    if np.count_nonzero(off_line < 0.03 * length + 1.0) < 0.7 * len(side):
        return None
    # The boundary pixels lie half a pixel inside the boundary.
    return -dv, du, v0 * du - u0 * dv - 0.5


def intersect_lines(lines: Sequence[Line]) -> FloatArray:
    """Corners between adjacent lines: corner i is where lines i − 1 and i meet.

    Not finite where the two are parallel.
    """
    corners = []
    before = lines[-1]
    for line in lines:
        (m_u, m_v, d), (n_u, n_v, c) = before, line
        determinant = m_u * n_v - m_v * n_u
        inverse = 1.0 / determinant if determinant else math.nan
        corners.append(((d * n_v - c * m_v) * inverse, (c * m_u - d * n_u) * inverse))
        before = line
    return np.array(corners)
