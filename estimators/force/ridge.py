"""Ridge regression with scaled columns, Bilen et al., eqs. (22), (24) and (25)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from microdrivers.core.errors import DataError, IllConditioned, OutOfRange
from microdrivers.estimators.force.model import Array
from microdrivers.estimators.force.real_arrays import real_array

DEFAULT_RIDGE = 1e-9
"""δ, relative to the number of samples: columns have a mean square of 1."""


class RidgeFit(NamedTuple):
    """Solution of eq. (25).

    Attributes:
        theta: one value a column, in the columns' own units.
        covariance: of theta, from the residual's variance; white noise in the force only is assumed. NaN where no
            degree of freedom is left to tell that variance by.
        condition_number: of the scaled columns; 1 is best.
        residual_uN: force minus what theta says, one a sample.
        degrees_of_freedom: samples minus columns.
    """

    theta: Array
    covariance: Array
    condition_number: float
    residual_uN: Array
    degrees_of_freedom: int


def ridge_fit(columns: Array, force_uN: Array, *, ridge: float = DEFAULT_RIDGE) -> RidgeFit:
    """`θ̂ = (φφᵀ + δI)⁻¹ φF`, Bilen et al., eq. (25), θ⁰ = 0, in columns scaled to a mean square of 1.

    The columns ẍ, ẋ, x, x³ differ by six decades: with one δ for all the unscaled ridge would suppress the one and not
    touch the other.

    Args:
        columns: regressors, samples × parameters, φᵀ of eq. (22).
        force_uN: one a sample.
        ridge: δ for scaled columns, relative to the number of samples; ≥ 0.

    Raises:
        DataError: shapes do not match, no columns, fewer samples than columns, or a value is not real and finite.
        OutOfRange: `ridge` is negative or not finite.
        IllConditioned: `ridge` is 0 and the columns do not determine the parameters.
    """
    if not 0.0 <= ridge < np.inf:
        raise OutOfRange(f"the ridge is {ridge}", remedy="give a finite number of 0 or more")
    columns, force_uN = real_array(columns, what="the table of regressors"), real_array(force_uN, what="force_uN")
    if columns.ndim != 2 or force_uN.shape != columns.shape[:1] or not 0 < columns.shape[1] <= len(columns):
        raise DataError(
            f"{columns.shape} regressors and {force_uN.shape} forces do not determine the parameters",
            remedy="give one row of regressors a force, and at least one column and as many rows as columns",
        )
    if not (np.isfinite(columns).all() and np.isfinite(force_uN).all()):
        raise DataError("a regressor or a force is not finite", remedy="leave out samples that were not measured")
    n, p = columns.shape
    scale = np.sqrt(np.mean(columns**2, axis=0))
    # A column of zeros (acceleration at constant speed) says nothing: the ridge puts its parameter at 0.
    scale[scale == 0.0] = 1.0
    left, singular, right = np.linalg.svd(columns / scale, full_matrices=False)
    delta = ridge * n
    if delta == 0.0 and singular[-1] <= singular[0] * n * np.finfo(np.float64).eps:
        raise IllConditioned("the regressors are linearly dependent", remedy="use a ridge above 0, or fewer columns")
    gain = singular / (singular**2 + delta)
    theta = right.T @ (gain * (left.T @ force_uN)) / scale
    residual = force_uN - columns @ theta
    variance = float(residual @ residual) / (n - p) if n > p else np.nan
    spread = (right.T * gain**2) @ right * variance
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0.0 else float("inf")
    return RidgeFit(theta, spread / np.outer(scale, scale), condition, residual, n - p)
