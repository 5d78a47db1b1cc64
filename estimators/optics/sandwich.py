"""Uncertainty of a projection that was estimated with overlapping stacks and forgetting.

Equation (8) of Bilen et al. counts each measurement up to three times and eq. (18) lets its weight decay, so
σ² R⁻¹ is not the covariance (near λ = 1 its standard deviations are √3 too small). With x the regressor (xn,
yn, 1), y = (u, v) and w_j = Σ_{k=j}^{min(j+2, t)} β(t, k) the total weight of measurement j at time t, eqs.
(15), (16) read `R = Σ w_j x_j x_jᵀ + ridge` and `f = Σ w_j x_j y_j + ridge`: θ is linear in the y_j, so for
noise that is independent from measurement to measurement its covariance is the sandwich `Σ_y ⊗ R⁻¹ (Σ w_j²
x_j x_jᵀ) R⁻¹`.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.estimators.optics.intervals import student_factor

FloatArray = npt.NDArray[np.float64]

STACK = 3
"""Measurements that one update stacks (eq. (8))."""

BLOCK = 256
"""Measurements that are kept one by one before those with a settled weight are summed up."""

# λ, xn, yn, 1, σ_time·vX, σ_time·vY, t, u, v. Packing costs a quarter of an assignment to an array's row.
_RECORD = struct.Struct("9d")
_COLUMNS = 9
_OFFSET, _TIME, _RESIDUALS = slice(3, 5), 5, slice(6, 8)
"""Places in z, see `WeightedTotals`."""
_WIDTH = 8

_IDENTITY = np.eye(2)
_SMALLEST_RESIDUAL_SHARE = 1e-9


class WeightedTotals(NamedTuple):
    """Weighted sums over measurements, with z = (xn, yn, 1, σ_time·vX, σ_time·vY, t, e_u, e_v), e the residuals.

    Attributes:
        first: Σ w z zᵀ, 8 × 8.
        second: Σ w² x xᵀ, 3 × 3.
        third: Σ w³ x xᵀ, 3 × 3.
    """

    first: FloatArray
    second: FloatArray
    third: FloatArray


class WeightedFrames:
    """Keeps the sums of `WeightedTotals` exactly while weights grow for three updates and then decay.

    The newest three measurements are still gaining weight, so they are carried one by one with the weight
    that they have so far; all earlier weights only shrink by the common factor λ, hence w², w³ by λ², λ³, and
    are summed up. Summing up happens at every `BLOCK`-th measurement whether or not totals are read, so that
    reading never changes a later digit. Residuals are kept about the estimate of the last summing up and
    moved to the present one by a congruence: u² ~ 1e5 px² and e² ~ 1e-4 px² never meet in one subtraction.
    """

    def __init__(self) -> None:
        self._records = bytearray(BLOCK * _RECORD.size)
        self._count = 0
        self._carried_weights: FloatArray = np.zeros(0)
        self._settled = WeightedTotals(np.zeros((_WIDTH, _WIDTH)), np.zeros((3, 3)), np.zeros((3, 3)))
        self._reference: FloatArray = np.zeros((3, 2))

    def append(
        self,
        forgetting: float,
        xn: float,
        yn: float,
        offset_x_um: float,
        offset_y_um: float,
        t_s: float,
        u_px: float,
        v_px: float,
        theta: Sequence[float],
    ) -> None:
        """Take one measurement.

        Args:
            forgetting: λ of its update.
            xn: normalised X.
            yn: normalised Y.
            offset_x_um: σ_time·vX, µm.
            offset_y_um: σ_time·vY, µm.
            t_s: when it was taken, s from some common instant.
            u_px: image coordinate, px.
            v_px: image coordinate, px.
            theta: the estimate that includes this measurement, as in `ProjectionRecursion.theta`.
        """
        place = self._count * _RECORD.size
        _RECORD.pack_into(self._records, place, forgetting, xn, yn, 1.0, offset_x_um, offset_y_um, t_s, u_px, v_px)
        self._count += 1
        if self._count == BLOCK:
            self._sum_up(theta)

    def totals(self, theta: Sequence[float]) -> WeightedTotals:
        """The sums over all measurements, residuals about `theta`."""
        coefficients = _as_columns(theta)
        weights, decay = self._weights()
        settled = _decayed(_moved(self._settled, coefficients - self._reference), decay)
        return _added(settled, _sums(self._table()[:, 1:], weights, coefficients))

    def _sum_up(self, theta: Sequence[float]) -> None:
        coefficients = _as_columns(theta)
        weights, decay = self._weights()
        table = self._table()
        settled = _decayed(_moved(self._settled, coefficients - self._reference), decay)
        self._settled = _added(settled, _sums(table[:-STACK, 1:], weights[:-STACK], coefficients))
        self._reference = coefficients
        self._carried_weights = weights[-STACK:]
        table[:STACK] = table[-STACK:]
        self._count = STACK

    def _table(self) -> FloatArray:
        """The recorded measurements, one a row; a view of the records."""
        return np.frombuffer(self._records, dtype=np.float64).reshape(BLOCK, _COLUMNS)[: self._count]

    def _weights(self) -> tuple[FloatArray, float]:
        """Weights of the recorded measurements, and the factor by which all earlier ones have shrunk."""
        carried = len(self._carried_weights)
        from_here_on = np.cumprod(self._table()[carried:, 0][::-1])[::-1]
        # beta[k] = Π_{i>k} λ_i since the last summing up, 0 elsewhere: the shifted sum below is w.
        beta = np.zeros(self._count + STACK - 1)
        decay = 1.0
        if len(from_here_on):
            beta[carried : self._count - 1] = from_here_on[1:]
            beta[self._count - 1] = 1.0
            decay = float(from_here_on[0])
        weights = beta[: self._count] + beta[1 : self._count + 1] + beta[2 : self._count + 2]
        weights[:carried] += decay * self._carried_weights
        return weights, decay


class ProjectionUncertainty(NamedTuple):
    """How well a projection is known.

    Attributes:
        covariance: 6 × 6, of (p11 p12 p13 p21 p22 p23) for stage coordinates: (px/µm)², px²/µm and px².
            Multiply standard deviations by `interval_factor()` for a 95 % interval.
        noise_covariance_px2: 2 × 2 covariance of one measured (u, v) about the model, px²; noise of the stage
            encoder is in it, as seen in the image.
        degrees_of_freedom: of the noise estimate per image axis, after Satterthwaite; not whole in general.
    """

    covariance: FloatArray
    noise_covariance_px2: FloatArray
    degrees_of_freedom: float

    def interval_factor(self, confidence: float = 0.95) -> float:
        """Half-width of the two-sided interval of any parameter in standard deviations (Student's t)."""
        return student_factor(self.degrees_of_freedom, confidence)


def projection_uncertainty(
    totals: WeightedTotals,
    *,
    information: FloatArray,
    theta: Sequence[float],
    centre_um: tuple[float, float],
    scale_um: float,
    now_s: float = 0.0,
    sigma_drift_um_s: float = 0.0,
) -> ProjectionUncertainty | None:
    """Sandwich covariance of P, plus what a time offset of the poses and a drift of the sample can do to it.

    With H the hat matrix, the weighted residual sum of squares is a quadratic form in the noise with matrix
    `(I − H)ᵀ W (I − H)`. Its trace is `Σw − 2 tr(R⁻¹S) + tr(R⁻¹ R₀ R⁻¹ S)`, which makes Σ_y unbiased, and
    trace² over the trace of its square is the number of degrees of freedom (Satterthwaite, 1946).

    A time offset τ common to all poses shifts each image point by A V τ, hence θ by `τ R⁻¹ Σ w x (A V)ᵀ`. On
    a circle at constant speed that is the same as a rotation, so no residual shows it: it is added as a
    rank-one term.

    A sample that drifts against the stage with velocity d shifts the image point of a measurement of age a by −A d a,
    which on one turn of a circle is mostly a rotation and a change of scale: with d unknown, of standard deviation
    `sigma_drift_um_s` in either direction, it adds `σ² (A Aᵀ) ⊗ g gᵀ`, g = R⁻¹ Σ w x a.

    Args:
        totals: sums over the measurements, with residuals about `theta`.
        information: 3 × 3, R with its ridge, normalised coordinates.
        theta: the estimate, normalised coordinates.
        centre_um: centre of the normalised coordinates, µm.
        scale_um: their scale, µm.
        now_s: the instant for which P is wanted, on the scale of the measurements' times.
        sigma_drift_um_s: standard deviation of the sample's drift along X and along Y, µm/s.

    Returns:
        None when the residuals leave nothing to judge the noise by.
    """
    inverse = np.linalg.inv(information)
    inverse = (inverse + inverse.T) / 2.0
    bare, second = totals.first[:3, :3], totals.second
    bread_second = inverse @ second
    spread = bread_second @ inverse
    weight_sum = bare[2, 2]
    trace = weight_sum - 2.0 * _trace(inverse, second) + _trace(bare, spread)
    trace_of_square = second[2, 2] - 2.0 * _trace(inverse, totals.third) + _trace(bread_second, bread_second)
    if not (trace > _SMALLEST_RESIDUAL_SHARE * weight_sum and trace_of_square > 0.0):
        return None
    noise = totals.first[_RESIDUALS, _RESIDUALS] / trace
    covariance = _kron(noise, spread)

    coefficients = _as_columns(theta)
    linear_part = coefficients[:2].T / scale_um
    shift = (inverse @ totals.first[:3, _OFFSET] @ linear_part.T).T.ravel()
    covariance += shift[:, None] * shift
    age = inverse @ (totals.first[:3, _TIME] - now_s * bare[:, 2])
    covariance += sigma_drift_um_s**2 * _kron(linear_part @ linear_part.T, age[:, None] * age)

    to_stage = np.array(
        [
            [1.0 / scale_um, 0.0, 0.0],
            [0.0, 1.0 / scale_um, 0.0],
            [-centre_um[0] / scale_um, -centre_um[1] / scale_um, 1.0],
        ]
    )
    both_axes = _kron(_IDENTITY, to_stage)
    covariance = both_axes @ covariance @ both_axes.T
    return ProjectionUncertainty(
        covariance=(covariance + covariance.T) / 2.0,
        noise_covariance_px2=noise,
        degrees_of_freedom=float(trace * trace / trace_of_square),
    )


def _kron(one: FloatArray, other: FloatArray) -> FloatArray:
    """Kronecker product of a 2 × 2 and a 3 × 3 matrix; numpy's takes seven times as long."""
    return (one[:, None, :, None] * other[None, :, None, :]).reshape(6, 6)


def _trace(one: FloatArray, other: FloatArray) -> float:
    """Trace of the product; numpy's own takes four times as long."""
    return float(np.vdot(one, other.T))


def _as_columns(theta: Sequence[float]) -> FloatArray:
    """θ as 3 × 2: one column for u, one for v."""
    return np.array(theta, dtype=np.float64).reshape(2, 3).T


def _sums(measurements: FloatArray, weights: FloatArray, coefficients: FloatArray) -> WeightedTotals:
    regressors = measurements[:, :3]
    z = measurements.copy()
    z[:, _RESIDUALS] -= regressors @ coefficients
    once = weights[:, None] * z
    twice = weights[:, None] * once[:, :3]
    thrice = weights[:, None] * twice
    return WeightedTotals(once.T @ z, twice.T @ regressors, thrice.T @ regressors)


def _moved(totals: WeightedTotals, change: FloatArray) -> WeightedTotals:
    """Residuals about a reference that has moved by `change` (3 × 2)."""
    transform = np.eye(_WIDTH)
    transform[_RESIDUALS, :3] = -change.T
    return totals._replace(first=transform @ totals.first @ transform.T)


def _decayed(totals: WeightedTotals, factor: float) -> WeightedTotals:
    return WeightedTotals(factor * totals.first, factor**2 * totals.second, factor**3 * totals.third)


def _added(one: WeightedTotals, other: WeightedTotals) -> WeightedTotals:
    return WeightedTotals(one.first + other.first, one.second + other.second, one.third + other.third)
