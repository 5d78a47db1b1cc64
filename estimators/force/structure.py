"""Is what a fit leaves over noise, or an effect that the model does not have?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.estimators.force.model import Array

FoundBy = Literal["order", "size"]

LAGS = 20
"""Samples over which residuals are correlated with each other."""

SIGNIFICANT_P, _LEAST_P = 0.01, 1e-9
"""Structure is found below the first; below the second the figure says no more."""

_BLOCK = 15
_EXCESS = 4.0
"""Of the noise's variance: so much left over is no noise, however it is ordered."""

_MATERIAL = 0.5
"""Structure smaller than this share of the noise harms nobody, however significant."""


class StructureTest(NamedTuple):
    """Ljung and Box's test on the residuals (Biometrika 65, 1978), and how much it is about.

    Attributes:
        statistic: Q, over `LAGS` lags of the residuals of deformation and of force; χ² with 2·`LAGS` degrees of freedom
            if both are white.
        p_value: probability of such a Q by noise alone.
        structured_uN: RMS of the slow part of the force residual, noise taken off.
        noise_uN: RMS that noise alone gives a single force residual.
        found: the residual has structure, and not a negligible one: a model misfit.
        found_by: what told: "order", Ljung and Box's test, p < `SIGNIFICANT_P`; or "size" alone, far more than noise
            can leave, where the record is too short for its order to tell. None if nothing was found.
        text: the verdict in a sentence.
    """

    statistic: float
    p_value: float
    structured_uN: float
    noise_uN: float
    found: bool
    found_by: FoundBy | None
    text: str


def structure_test(
    residuals: Sequence[Array], place: npt.NDArray[np.int64], left_over_uN: Array, noise_uN: Array
) -> StructureTest:
    """Test residuals for structure.

    Args:
        residuals: series that are white if the model holds, one value a sample each; any scale.
        place: index of each sample in its record: samples that are not neighbours there are not correlated.
        left_over_uN: force minus what the model reads from the camera; as many values, at places of the same spacing.
        noise_uN: standard deviation that noise alone gives each of these.
    """
    statistic = sum(_ljung_box(series, place) for series in residuals)
    p_value = chi_square_tail(statistic, LAGS * len(residuals))
    blocks = len(left_over_uN) // _BLOCK
    noise = float(np.sqrt(np.mean(noise_uN**2)))
    structured = 0.0
    if blocks:
        means = left_over_uN[: blocks * _BLOCK].reshape(blocks, _BLOCK).mean(axis=1)
        structured = math.sqrt(max(float(np.mean(means**2)) - noise**2 / _BLOCK, 0.0))
    excess = float(np.mean(left_over_uN**2)) > _EXCESS * noise**2
    significant = p_value < SIGNIFICANT_P or excess
    found = significant and structured > _MATERIAL * noise
    # A short record in disorder may look white: then it is its size that tells.
    found_by: FoundBy | None = None
    if found:
        found_by = "order" if p_value < SIGNIFICANT_P else "size"
    how = [f"p < {_LEAST_P:g}" if p_value < _LEAST_P else f"p = {p_value:.1g}"]
    if excess:
        # What its size has shown to be no noise, an order that looks like noise does not take back.
        how = [f"{float(np.sqrt(np.mean(left_over_uN**2))) / noise:.3g} times what noise leaves"] + [
            f"{each} of its order" for each in how if p_value < SIGNIFICANT_P
        ]
    slow = f"{structured:.2g} µN RMS of slow residual" if structured else "nothing slow"
    figures = ", ".join([f"{slow} beside {noise:.2g} µN of noise", *how])
    if found:
        text = f"misfit: the residual has structure that this model does not have ({figures})"
    elif excess:
        text = f"the residual is more than noise, but little of it is slow ({figures})"
    elif significant:
        text = f"the residual has some structure, less than the noise ({figures})"
    else:
        text = f"the residual looks like noise ({figures})"
    return StructureTest(statistic, p_value, structured, noise, found, found_by, text)


def _ljung_box(series: Array, place: npt.NDArray[np.int64]) -> float:
    n = len(series)
    values = series - series.mean()
    power = float(values @ values)
    if n <= LAGS or power == 0.0:
        return 0.0
    gridded = np.zeros(int(place[-1] - place[0]) + 1)
    gridded[place - place[0]] = values
    statistic = 0.0
    for lag in range(1, LAGS + 1):
        correlation = float(gridded[lag:] @ gridded[:-lag]) / power
        statistic += correlation**2 / (n - lag)
    return n * (n + 2) * statistic


def chi_square_tail(value: float, degrees_of_freedom: int) -> float:
    """Probability that χ² with an even number of degrees of freedom exceeds a value."""
    half, term, total = value / 2.0, 1.0, 1.0
    for k in range(1, degrees_of_freedom // 2):
        term *= half / k
        total += term
    if not math.isfinite(total):
        return 0.0
    return math.exp(min(math.log(total) - half, 0.0)) if total > 0.0 else 1.0
