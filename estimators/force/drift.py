"""A zero of the force that drifts along a straight line, as the record shows it out of contact at both ends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from microdrivers.estimators.force.model import Array
from microdrivers.estimators.force.record import CLEAR

SHORTEST_BASELINE = 15
"""Samples out of contact at either end that a drift takes to be seen."""

CLEAR_SLOPE = 4.0
"""Standard deviations of a slope that are no noise."""

_FEWEST = 6
"""Samples that tell a line."""

_PARTLY = 2
"""Samples before a break that may have felt a part of it."""

_SEEN = 2.0
"""Standard deviations of the slope that the ends have by themselves; one that is less passes for no contact anyway."""

_GROWS = 1.2
_BROKEN = 25.0
"""Sum of squares, in variances, by which two lines must explain a stretch better than one: five standard deviations."""

_LIKELY, _ONE_LINE = 9.0, 16.0
"""The same, by which a break may be worse than the best one, and by which one line may be worse than one at each end:
three and four standard deviations."""


class Baseline(NamedTuple):
    """The force out of contact: `level_uN` at `middle_s`, and a slope; their errors are not correlated.

    Attributes:
        middle_s: mean instant of the samples that tell it.
        level_uN, slope_uN_s: each followed by its standard deviation; that of a slope that was not estimated is 0.
        stepped_uN: how much higher the force stands after the press, if it has not come there along a line.
    """

    middle_s: float
    level_uN: float
    sigma_level_uN: float
    slope_uN_s: float
    sigma_slope_uN_s: float
    stepped_uN: float = 0.0

    @property
    def is_clear(self) -> bool:
        """Whether noise does not explain the slope."""
        return abs(self.slope_uN_s) > CLEAR_SLOPE * self.sigma_slope_uN_s

    def at(self, time_s: Array) -> Array:
        """The line, µN."""
        return self.level_uN + self.slope_uN_s * (time_s - self.middle_s)


def line_through(time_s: Array, force_uN: Array, sigma_uN: float) -> Baseline:
    """The straight line through samples with noise of this standard deviation."""
    middle, level = float(time_s.mean()), float(force_uN.mean())
    t = time_s - middle
    square = float(t @ t)
    sigma_level, sigma_slope = (sigma_uN / float(np.sqrt(weight)) for weight in (len(t), square))
    return Baseline(middle, level, sigma_level, float(t @ force_uN) / square, sigma_slope)


def is_step(parts: Sequence[tuple[Array, Array]], line: Baseline, sigma_uN: float) -> bool:
    """Whether levels of their own explain the parts of a force out of contact better than one line, beyond noise.

    Args:
        parts: time_s and force_uN of each.
        line: through all of them.
        sigma_uN: standard deviation of the noise.
    """
    worse = sum(
        float(np.sum((force - line.at(time_s)) ** 2) - np.sum((force - np.mean(force)) ** 2)) for time_s, force in parts
    )
    return worse > _LIKELY * sigma_uN**2


def straight_drift(time_s: Array, force_uN: Array, sigma_uN: float) -> Baseline | None:
    """The line on which both ends of a record lie; None if they lie on none, or do not show its slope themselves.

    A force that is felt at one end or both would lie on one straight line with the other end only by chance. So this
    needs no knowledge of how fast a drift may be, nor of where contact begins and ends.

    Args:
        time_s: increasing.
        force_uN: of the whole record.
        sigma_uN: standard deviation of its noise.
    """
    head = _straight(time_s, force_uN, sigma_uN)
    tail = _straight(-time_s[::-1], force_uN[::-1], sigma_uN)
    n = len(time_s)
    if min(head.likely, tail.likely) < SHORTEST_BASELINE or min(head.sure, tail.sure) < _FEWEST or head.sure == n:
        return None
    ends = (slice(head.sure), slice(n - tail.sure, n))
    t, force = (np.concatenate([values[end] for end in ends]) for values in (time_s, force_uN))
    line = line_through(t, force, sigma_uN)
    apart = sum(float(_misfits(time_s[end], force_uN[end])[-1]) for end in ends)
    on_one_line = _misfits(t, force)[-1] - apart < _ONE_LINE * sigma_uN**2
    likely = (slice(head.likely), slice(n - tail.likely, n))
    own = [line_through(time_s[end], force_uN[end], sigma_uN) for end in likely]
    pressed_uN = np.max((force_uN - line.at(time_s))[head.likely : n - tail.likely], initial=0.0)
    known = on_one_line and line.is_clear and _slope_alike(own, line) and pressed_uN > CLEAR * sigma_uN
    return line if known else None


def _slope_alike(ends: Sequence[Baseline], line: Baseline) -> bool:
    """Whether the ends slope by themselves as the line through both does: on some line any two levels lie."""
    weights = [end.sigma_slope_uN_s**-2 for end in ends]
    own = sum(weight * end.slope_uN_s for weight, end in zip(weights, ends, strict=True)) / sum(weights)
    least = max(abs(line.slope_uN_s) / 2.0, _SEEN / math.sqrt(sum(weights)))
    return own * math.copysign(1.0, line.slope_uN_s) > least


class _Straight(NamedTuple):
    """How many samples at an end of a record lie on a straight line for sure, and how many most likely."""

    sure: int
    likely: int


def _straight(time_s: Array, force: Array, sigma: float) -> _Straight:
    """Of the beginning."""
    length = 2.0 * _FEWEST
    while length < len(force):
        length = min(length * _GROWS, len(force))
        t, values = time_s[: int(length)], force[: int(length)]
        before, after = _misfits(t, values), _misfits(t[::-1], values[::-1])[::-1]
        misfit = before[_FEWEST:-_FEWEST] + after[_FEWEST:-_FEWEST]
        if before[-1] - misfit.min() > _BROKEN * sigma**2:
            first = int(np.flatnonzero(misfit < misfit.min() + _LIKELY * sigma**2)[0])
            return _Straight(_FEWEST + first - _PARTLY, _FEWEST + int(misfit.argmin()) - _PARTLY)
    return _Straight(len(force), len(force))


def _misfits(time_s: Array, values: Array) -> Array:
    """Sum of the squares that a straight line leaves of the first 0, 1, 2, … of a series."""
    t, y = time_s - time_s.mean(), values - values.mean()
    sums = np.cumsum(np.stack([np.ones_like(t), t, y, t * t, t * y, y * y]), axis=1)
    n, t, y, tt, ty, yy = sums[:, 2:]
    left: Array = yy - y * y / n - (ty - t * y / n) ** 2 / (tt - t * t / n)
    return np.concatenate([np.zeros(3), left])
