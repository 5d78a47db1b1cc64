"""Whether what a tool's tip sweeps meets a box: a straight way, or all that three axes may reach in between."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

Point = tuple[float, float, float]

_TOUCH = 1e-9
_DEGENERATE_UM = 1e-12


class Entry(NamedTuple):
    """Where a way enters a box: at which share of it, through which face (`+z`, or empty if it begins inside)."""

    share: float
    face: str
    point_um: Point


def distance_um(point: Point, low: Point, high: Point) -> float:
    """The largest distance along one axis between a point and a box; 0 inside and on its surface."""
    return max(0.0, *(max(a - p, p - b) for p, a, b in zip(point, low, high, strict=True)))


def ways_to_faces_um(point: Point, low: Point, high: Point) -> Mapping[str, float]:
    """How far it is from a point inside a box to each of its faces, straight through it, by the face's name."""
    ways: dict[str, float] = {}
    for axis, p, a, b in zip("xyz", point, low, high, strict=True):
        ways |= {f"-{axis}": p - a, f"+{axis}": b - p}
    return ways


def depth_um(point: Point, low: Point, high: Point) -> float:
    """How far it is from a point inside a box to its nearest face; negative outside."""
    return min(ways_to_faces_um(point, low, high).values())


def deepens(start: Point, end: Point, low: Point, high: Point) -> bool:
    """Whether the straight way from inside a box gets deeper into it than it begins.

    The depth is the least of linear functions and so concave along the way: if it does not rise at first, it never
    does.
    """
    before, after = ways_to_faces_um(start, low, high), ways_to_faces_um(end, low, high)
    depth = min(before.values())
    return min(after[face] - way for face, way in before.items() if way <= depth + _TOUCH) > _TOUCH


def entry_of(start: Point, end: Point, low: Point, high: Point) -> Entry | None:
    """Where the straight way from start to end enters the inside of a box; None if it does not.

    A way along the surface does not enter.
    """
    first, last, face = 0.0, 1.0, ""
    for i, axis in enumerate("xyz"):
        way = end[i] - start[i]
        if abs(way) < _DEGENERATE_UM:
            if not low[i] < start[i] < high[i]:
                return None
            continue
        near, far = sorted(((low[i] - start[i]) / way, (high[i] - start[i]) / way))
        if near >= first:
            first, face = near, f"{'-' if way > 0 else '+'}{axis}"
        last = min(last, far)
    if first >= last - _TOUCH and not (first == 0.0 and _inside(start, low, high)):
        return None
    x, y, z = (a + first * (b - a) for a, b in zip(start, end, strict=True))
    return Entry(first, face, (x, y, z))


def sweep_meets(corner: Point, edges: Sequence[Point], low: Point, high: Point) -> bool:
    """Whether the parallelepiped from a corner along three edges meets the inside of a box.

    Separating axes (Gottschalk, Lin and Manocha 1996): two convex bodies are apart if they are in a projection on a
    normal of a face of one of them, or on a product of an edge of each.
    """
    unit = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    normals = [*unit, *(_cross(a, b) for a, b in itertools.combinations(edges, 2))]
    normals += [_cross(edge, axis) for edge in edges for axis in unit]
    for normal in normals:
        length = _dot(normal, normal) ** 0.5
        if length < _DEGENERATE_UM:
            continue
        slack = _TOUCH * length
        ways = [_dot(normal, edge) for edge in edges]
        base = _dot(normal, corner)
        least, most = base + sum(min(0.0, way) for way in ways), base + sum(max(0.0, way) for way in ways)
        box_least = sum(min(n * a, n * b) for n, a, b in zip(normal, low, high, strict=True))
        box_most = sum(max(n * a, n * b) for n, a, b in zip(normal, low, high, strict=True))
        if most <= box_least + slack or least >= box_most - slack:
            return False
    return True


def _inside(point: Point, low: Point, high: Point) -> bool:
    return all(a < p < b for p, a, b in zip(point, low, high, strict=True))


def _dot(a: Point, b: Point) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Point, b: Point) -> Point:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
