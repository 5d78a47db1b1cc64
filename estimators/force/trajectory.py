"""Families of trajectories that a deformation may follow between reversals, linear in their coefficients.

The simplest is what a stage at constant speed makes of a sensor that yields: `s = p + v·t − c·F` on every branch, c the
compliance of the sensor, common to all. Where the stage does not keep its speed, cubic splines with closer and closer
knots take its place. None of them smears a reversal: each branch has its own coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.estimators.force.model import Array

RAMP = 0.0
"""Family of ramps with compliance."""

KNOT_SPACINGS_S = (RAMP, 3.0, 0.6, 0.2)
"""Families, from the stiffest to the most supple: spacing of the knots of cubic splines, or `RAMP`."""

_BLOCK_SAMPLES = 64
_FORCE_KNOTS = 12
_ROUGH = 4.0
"""Variance about the smoothed force, in those of its noise, that is more than noise."""

_FEWEST_PER_COEFFICIENT = 3
_DEGREE = 3
_LARGEST_YIELD = 0.3
"""Of the depth: what the sensor may yield; a weak prior on its compliance."""


class Trajectory(NamedTuple):
    """A family on given samples: `s = value @ η`, its derivatives `rate @ η` and `acceleration @ η`.

    Attributes:
        value: samples × coefficients. rate: per s. acceleration: per s².
        prior: for each coefficient the standard deviation of its prior about 0; infinite where there is none.
        start: (row, rate row) over η of the line that the first branch follows where no force bends it, at time
            `start_s`; None for splines.
        start_s: origin of `start`.
        compliance: index of the compliance in η; None for splines.
        blocks: (samples, coefficients), ranges outside of which `value`, `rate` and `acceleration` are 0.
    """

    value: Array
    rate: Array
    acceleration: Array
    prior: Array
    start: tuple[Array, Array] | None
    start_s: float
    compliance: int | None
    blocks: tuple[tuple[slice, slice], ...]


def trajectory(
    time_s: Array,
    force_uN: Array,
    branch: npt.NDArray[np.int64],
    *,
    spacing_s: float,
    depth_um: float,
    force_sigma_uN: float,
) -> Trajectory:
    """The family of a spacing on the given samples.

    Args:
        time_s: increasing.
        force_uN: without its baseline; bends the ramps.
        branch: number of the branch of each sample, not decreasing.
        spacing_s: one of `KNOT_SPACINGS_S`.
        depth_um: how far the deformation goes.
        force_sigma_uN: noise of the force.
    """
    numbers = sorted(set(branch.tolist()))
    parts = [np.flatnonzero(branch == number) for number in numbers]
    if spacing_s == RAMP:
        return _ramps(time_s, force_uN, parts, depth_um, force_sigma_uN)
    blocks = [spline(time_s[part], _knots(time_s[part], spacing_s)) for part in parts]
    value, rate, acceleration = (_stacked(parts, [block[k] for block in blocks]) for k in range(3))
    return Trajectory(value, rate, acceleration, np.full(value.shape[1], np.inf), None, 0.0, None, _blocks(value))


def _ramps(
    time_s: Array, force: Array, parts: Sequence[npt.NDArray[np.int64]], depth_um: float, sigma: float
) -> Trajectory:
    # Smoothed: the noise of a force must not explain itself by a yielding sensor.
    smooth, slope, bend = (np.zeros_like(force) for _ in range(3))
    for part in parts:
        basis = spline(time_s[part], _knots(time_s[part], float(np.ptp(time_s[part])) / _FORCE_KNOTS))
        coefficients = np.linalg.lstsq(basis[0], force[part], rcond=None)[0]
        for target, derivative in zip((smooth, slope, bend), basis, strict=True):
            target[part] = derivative @ coefficients
    if np.mean((force - smooth) ** 2) > _ROUGH * sigma**2:
        # It varies far beyond its noise, and the sensor yields to that too.
        smooth = force
    lines, speeds = [], []
    for part in parts:
        t = time_s[part] - time_s[part].mean()
        one, none = np.ones_like(t), np.zeros_like(t)
        lines.append(np.column_stack([one, t]))
        speeds.append(np.column_stack([none, one]))
    value = np.column_stack([_stacked(parts, lines), -smooth])
    rate = np.column_stack([_stacked(parts, speeds), -slope])
    acceleration = np.column_stack([np.zeros((len(time_s), 2 * len(parts))), -bend])
    prior = np.full(value.shape[1], np.inf)
    prior[-1] = _LARGEST_YIELD * depth_um / max(float(np.max(np.abs(force))), 1e-300)
    row, row_rate = np.zeros(value.shape[1]), np.zeros(value.shape[1])
    row[0], row_rate[1] = 1.0, 1.0
    start_s = float(time_s[parts[0]].mean())
    whole = ((slice(0, len(value)), slice(0, value.shape[1])),)
    return Trajectory(value, rate, acceleration, prior, (row, row_rate), start_s, value.shape[1] - 1, whole)


def _blocks(value: Array) -> tuple[tuple[slice, slice], ...]:
    """Ranges of samples with the coefficients that they depend on: splines reach over a few knots only."""
    blocks = []
    for start in range(0, len(value), _BLOCK_SAMPLES):
        rows = slice(start, min(start + _BLOCK_SAMPLES, len(value)))
        columns = np.flatnonzero(np.any(value[rows] != 0.0, axis=0))
        blocks.append((rows, slice(int(columns[0]), int(columns[-1]) + 1)))
    return tuple(blocks)


def _stacked(parts: Sequence[npt.NDArray[np.int64]], blocks: Sequence[Array]) -> Array:
    """Blocks side by side, each on the samples of its branch and 0 elsewhere."""
    stacked = np.zeros((sum(map(len, parts)), sum(block.shape[1] for block in blocks)))
    column = 0
    for part, block in zip(parts, blocks, strict=True):
        stacked[part, column : column + block.shape[1]] = block
        column += block.shape[1]
    return stacked


def _knots(time_s: Array, spacing_s: float) -> Array:
    """Knots at about the given spacing, no more than the samples bear; the ends included."""
    span = float(np.ptp(time_s))
    most = len(time_s) // _FEWEST_PER_COEFFICIENT - _DEGREE
    pieces = max(1, min(int(np.ceil(span / spacing_s)) if spacing_s > 0.0 else 1, most))
    knots: Array = np.linspace(time_s[0], time_s[-1], pieces + 1)
    return knots


def spline(time_s: Array, knots: Array) -> tuple[Array, Array, Array]:
    """B-splines and their first two derivatives, samples × coefficients; cubic, or a polynomial for very few samples.

    Args:
        time_s: between the first and the last knot.
        knots: increasing, at least two.
    """
    if len(time_s) < _FEWEST_PER_COEFFICIENT * (_DEGREE + 1) or knots[-1] <= knots[0]:
        degree = min(2, len(time_s) // 2)
        t = time_s - time_s.mean()
        powers = np.arange(degree + 1)
        value = t[:, None] ** powers
        rate = powers * t[:, None] ** np.maximum(powers - 1, 0)
        curve = powers * (powers - 1) * t[:, None] ** np.maximum(powers - 2, 0)
        return value, rate.astype(np.float64), curve.astype(np.float64)
    full = np.concatenate([np.repeat(knots[0], _DEGREE), knots, np.repeat(knots[-1], _DEGREE)])
    levels = [_indicators(time_s, full)]
    for degree in range(1, _DEGREE + 1):
        levels.append(_raised(time_s, full, levels[-1], degree))
    rate = _derived(full, levels[_DEGREE - 1], _DEGREE)
    curve = _derived(full, _derived(full, levels[_DEGREE - 2], _DEGREE - 1), _DEGREE)
    return levels[_DEGREE], rate, curve


def _indicators(t: Array, full: Array) -> Array:
    inner = len(full) - 1 - _DEGREE
    place = np.clip(np.searchsorted(full, t, side="right") - 1, _DEGREE, inner - 1)
    flat = np.zeros((len(t), len(full) - 1))
    flat[np.arange(len(t)), place] = 1.0
    return flat


def _raised(t: Array, full: Array, lower: Array, degree: int) -> Array:
    """Cox–de Boor: splines of `degree` from those of one less."""
    count = lower.shape[1] - 1
    i = np.arange(count)
    left, right = full[i + degree] - full[i], full[i + degree + 1] - full[i + 1]
    up = np.divide(t[:, None] - full[i], left, out=np.zeros((len(t), count)), where=left > 0.0)
    down = np.divide(full[i + degree + 1] - t[:, None], right, out=np.zeros((len(t), count)), where=right > 0.0)
    raised: Array = up * lower[:, :-1] + down * lower[:, 1:]
    return raised


def _derived(full: Array, lower: Array, degree: int) -> Array:
    """Derivative of splines of `degree` from the splines (or their derivatives) of one less."""
    i = np.arange(lower.shape[1] - 1)
    left, right = full[i + degree] - full[i], full[i + degree + 1] - full[i + 1]
    up = np.divide(degree, left, out=np.zeros(len(i)), where=left > 0.0)
    down = np.divide(degree, right, out=np.zeros(len(i)), where=right > 0.0)
    derived: Array = up * lower[:, :-1] - down * lower[:, 1:]
    return derived
