"""Straight and parabolic fits to a few positions, and how much better a broken line would explain them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple


class Point(NamedTuple):
    """A position at an instant."""

    t_s: float
    x_um: float


class LineFit(NamedTuple):
    """A line, or parabola, in polynomials that are orthogonal over its points.

    `norm0` … `norm2` are their squared lengths, `left_um2` is the sum of the squares that the fit leaves over.
    """

    middle_s: float
    level_um: float
    slope: float
    bend: float
    skew: float
    spread: float
    norm0: float
    norm1: float
    norm2: float
    left_um2: float

    def bow(self, u: float) -> float:
        """The polynomial of second degree, `u` seconds from the middle."""
        return (u - self.skew) * u - self.spread

    def position_um(self, t_s: float) -> float:
        """Where the fit is at an instant."""
        u = t_s - self.middle_s
        return self.level_um + self.slope * u + self.bend * self.bow(u)

    def velocity_um_s(self, t_s: float) -> float:
        """Its slope there."""
        if self.bend == 0.0:
            return self.slope
        return self.slope + self.bend * (2.0 * (t_s - self.middle_s) - self.skew)

    def velocity_spread_per_s(self, t_s: float) -> float:
        """Standard deviation of that slope over the positions'; infinite where they do not tell it."""
        if self.norm1 <= 0.0:
            return math.inf
        if self.norm2 <= 0.0:
            return 1.0 / math.sqrt(self.norm1)
        grow = 2.0 * (t_s - self.middle_s) - self.skew
        return math.sqrt(1.0 / self.norm1 + grow * grow / self.norm2)


def fit(points: Sequence[Point], *, parabola: bool = False) -> LineFit:
    """Least squares; fewer than three instants make no parabola and fewer than two no slope."""
    # Sums about the newest point, so that no digits are lost.
    zero_s, zero_um = points[-1]
    norm0 = float(len(points))
    first = level = second = rise = square = 0.0
    for t, x in points:
        u, y = t - zero_s, x - zero_um
        first += u
        level += y
        second += u * u
        rise += u * y
        square += y * y
    middle = first / norm0
    level /= norm0
    norm1 = second - middle * first
    rise -= middle * level * norm0
    slope = rise / norm1 if norm1 > 0.0 else 0.0
    left = square - level * level * norm0 - slope * rise
    zero_s += middle
    zero_um += level
    if not parabola or len(points) < 4:
        return LineFit(zero_s, zero_um, slope, 0.0, 0.0, 0.0, norm0, norm1, 0.0, left)
    third = fourth = curve = 0.0
    for t, x in points:
        u = t - zero_s
        squared = u * u
        third += squared * u
        fourth += squared * squared
        curve += squared * (x - zero_um)
    skew, spread = third / norm1, norm1 / norm0
    norm2 = fourth - skew * third - spread * norm1
    curve -= skew * rise
    return LineFit(
        zero_s, zero_um, slope, curve / norm2, skew, spread, norm0, norm1, norm2, left - curve * curve / norm2
    )


def broken_line_gains(points: Sequence[Point], line: LineFit, *, newest: int, oldest: int) -> list[float]:
    """By how much the sum of squares falls if the line may change its slope at `points[j]`, j from newest to oldest."""
    gains = []
    middle, norm0, norm1, norm2 = line.middle_s, line.norm0, line.norm1, line.norm2
    # Sums over the points beyond j: residual, 1 and bow, each plain and times u (1 also times u²).
    r0 = r1 = w0 = w1 = w2 = b0 = b1 = 0.0
    for j in range(len(points) - 1, oldest - 1, -1):
        t, x = points[j]
        u = t - middle
        if j <= newest:
            explained = r1 - u * r0
            on0, on1 = w1 - u * w0, w2 - u * w1
            own = w2 - 2.0 * u * w1 + u * u * w0 - on0 * on0 / norm0 - on1 * on1 / norm1
            if norm2 > 0.0:
                on2 = b1 - u * b0
                own -= on2 * on2 / norm2
            gains.append(explained * explained / own if own > 0.0 else 0.0)
        residual = x - line.position_um(t)
        r0 += residual
        r1 += residual * u
        w0 += 1.0
        w1 += u
        w2 += u * u
        if norm2 > 0.0:
            bow = line.bow(u)
            b0 += bow
            b1 += bow * u
    return gains


def shape_gain(points: Sequence[Point], line: LineFit, shape: Sequence[float]) -> float:
    """By how much the sum of squares falls if a multiple of `shape`, one value a point, is added to the fit."""
    explained = on0 = on1 = on2 = own = 0.0
    for (t, x), value in zip(points, shape, strict=True):
        if value:
            u = t - line.middle_s
            explained += value * (x - line.position_um(t))
            on0 += value
            on1 += value * u
            on2 += value * line.bow(u)
            own += value * value
    own -= on0 * on0 / line.norm0 + on1 * on1 / line.norm1 + (on2 * on2 / line.norm2 if line.norm2 > 0.0 else 0.0)
    return explained * explained / own if own > 0.0 else 0.0
