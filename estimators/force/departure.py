"""Where a force leaves its baseline: at a sample if it leaves it steeply, else somewhere between two samples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from microdrivers.estimators.force.model import Array
from microdrivers.estimators.force.record import CLEAR

_FEWEST = 8
_BASELINE = 30
"""Samples before a force that tell whether it has left the baseline; more, where it leaves that slowly."""

_LONGER = (60, 120, 240, 480)
_STEEP = 3
"""Samples on either side of a departure: if it stands out between their means, it is where it was noticed."""

_DRIFTS = 4
"""So many straight pieces may a baseline have, less one."""

_FEWEST_RISING = 6
_LIKELY = 9.0
"""Sum of squares, in variances, by which a place may be worse than the best one: three standard deviations."""


class Departure(NamedTuple):
    """The first sample with a force is one of those from `early` to `late`."""

    early: int
    late: int


def find_departure(force_uN: Array, sigma_uN: float) -> Departure | None:
    """Where a force leaves its baseline for good, to either side; None if it does not, or not after `_FEWEST` samples.

    Args:
        force_uN: in order, or in reverse to find where it has come back.
        sigma_uN: standard deviation of its noise.
    """
    force = np.array(force_uN, dtype=np.float64)
    for _ in range(_DRIFTS):
        found = _rise(force, sigma_uN, _BASELINE)
        # A force that rises slowly drags a short baseline along.
        longer = [_rise(force, sigma_uN, length) for length in _LONGER if length < len(force)]
        noticed = [first for first, _ in filter(None, [found, *longer])]
        if not noticed:
            return None
        steep = found if found is not None and _is_steep(force, found[0], sigma_uN) else None
        seen = _until_clear(force, sigma_uN, min(noticed))
        if steep is not None:
            # What has risen slowly until then is no baseline: it turns steep at the reversal, too.
            seen = slice(seen.start, min(seen.stop, steep[0] - 1))
        likely = _most_likely(force[seen], sigma_uN) if min(noticed) < seen.stop else None
        if likely is not None:
            return Departure(seen.start + likely.early, seen.start + likely.late)
        if steep is not None:
            first, base = steep
            # The sample before may have felt a part of its exposure: it belongs to the contact then.
            first -= int(force[first - 1] > base + CLEAR * sigma_uN)
            return Departure(first, first)
        # A drift: what leaves its line comes later.
        force -= np.polynomial.Polynomial.fit(np.arange(seen.start, seen.stop), force[seen], 1)(np.arange(len(force)))
    return None


def _rise(force: Array, sigma: float, length: int) -> tuple[int, float] | None:
    """First index at which a force is clearly off the mean of the `length` samples before it; and this mean."""
    total = np.concatenate([[0.0], np.cumsum(force)])
    i = np.arange(_FEWEST, len(force) - 2)
    before = np.maximum(i - length, 0)
    base = (total[i] - total[before]) / (i - before)
    beyond = np.minimum.reduce([np.abs(force[i + k] - base) for k in range(3)]) > CLEAR * sigma
    risen = np.flatnonzero(beyond)
    return (int(i[risen[0]]), float(base[risen[0]])) if len(risen) else None


def _is_steep(force: Array, first: int, sigma: float) -> bool:
    step = np.mean(force[first : first + _STEEP]) - np.mean(force[first - _STEEP : first])
    return bool(abs(step) > CLEAR * sigma)


def _until_clear(force: Array, sigma: float, noticed: int) -> slice:
    """The samples about a departure, until the force has gone twice as far as it takes to notice it."""
    start = max(noticed - _LONGER[-1], 0)
    rest = float(np.median(force[start : start + max((noticed - start) // 4, _FEWEST)]))
    far = np.flatnonzero(np.abs(force[noticed:] - rest) > 2.0 * CLEAR * sigma)
    return slice(start, min(noticed + (int(far[0]) if len(far) else 0) + _FEWEST_RISING, len(force)))


def _most_likely(force: Array, sigma: float) -> Departure | None:
    """Where a constant and, from there on, a straight line of any height explain a force about as well as anywhere.

    None if one straight line explains it as well, or there are too few samples to tell.
    """
    values = force - force.mean()
    splits = np.arange(_FEWEST, len(values) - _FEWEST_RISING + 1)
    if not len(splits):
        return None
    to_line = _line_misfits(values)
    misfit = _constant_misfits(values)[splits] + to_line[splits]
    as_well = misfit.min() + _LIKELY * max(sigma**2, misfit.min() / len(values))
    if to_line[0] < as_well:
        return None
    likely = splits[misfit < as_well]
    return Departure(int(likely[0]), int(likely[-1]))


def _constant_misfits(values: Array) -> Array:
    """Sum of squares about their mean, of the first 0, 1, … values; of none and of one 0."""
    n = np.arange(len(values) + 1)
    total, squares = (np.concatenate([[0.0], np.cumsum(column)]) for column in (values, values**2))
    return np.asarray(squares - total**2 / np.maximum(n, 1))


def _line_misfits(values: Array) -> Array:
    """Sum of squares about their straight line, of the values from the first, the second, … on; of fewer than two 0."""
    length = len(values)
    n = length - np.arange(length)
    t = np.arange(length, dtype=np.float64)
    total, squares, moment = (np.cumsum(column[::-1])[::-1] for column in (values, values**2, t * values))
    slant = moment - (t + (n - 1) / 2.0) * total
    return np.asarray(squares - total**2 / n - slant**2 / np.maximum(n * (n**2 - 1.0) / 12.0, 1.0))
