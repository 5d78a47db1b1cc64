"""Recursive ridge least squares with forgetting over the newest four samples (Bilen et al., eqs. (22)–(25)).

Three columns, or four with the mass, make a small symmetric matrix. Its triangle is kept as plain scalars, which can
neither lose its symmetry nor, at this size, be beaten by array code. The mass is eliminated first: what is left is the
same three columns x³, x and v with and without it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.core.errors import DataError, OutOfRange
from microdrivers.estimators.force.triangles import Six, norm, norm_with_mass, sandwich, without_mass

Array = npt.NDArray[np.float64]

STACK = 4
"""Samples that one update stacks (eq. (23))."""

DETERMINED_RIDGES = 100.0
"""A direction of θ counts as measured when the data weigh this many times more in it than the ridge."""

_ROUNDING = 1e-12
_SMALLEST_RESIDUAL_SHARE = 1e-6

# φ φᵀ for φ = (x³, x, v) as cc cx cv xx xv vv, φ F as fc fx fv, F²; and what a mass adds: ca xa va aa fa.
_Row = tuple[float, float, float, float, float, float, float, float, float, float]
_MassRow = tuple[float, float, float, float, float]
_Four = tuple[float, float, float, float]
_Nine = tuple[float, float, float, float, float, float, float, float, float]


class Scales(NamedTuple):
    """What the columns of eq. (22) are divided by before the ridge: state them with a result."""

    x_um: float = 100.0
    v_um_s: float = 5.0
    a_um_s2: float = 50.0


class Spread(NamedTuple):
    """How well the samples so far tell θ.

    Attributes:
        condition: condition number of the scaled regressor φ: the root of R's in the Frobenius norm, which is at most
            √3 times that in the 2-norm (2 times with a mass); infinite before the first sample.
        determined: the samples alone fix θ: the ridge pulls any combination of it by less than 1 %.
        covariance: of (k1, k2, b), row-major, in µN, µm and s; empty while not known.
        noise_uN: standard deviation of the residuals that it rests on; NaN while not known.
    """

    condition: float
    determined: bool
    covariance: tuple[float, ...]
    noise_uN: float


_NO_ROW: _Row = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_NO_MASS: _MassRow = (0.0, 0.0, 0.0, 0.0, 0.0)

UNDETERMINED = Spread(math.inf, False, (), math.nan)


class FourSampleRecursion:
    """Estimates `F = k2 x³ + k1 x + b v (+ m a)` on line; an update stacks the newest four samples (eq. (23)).

    It carries `R ← λ R + φ φᵀ + δ I` and `f ← λ f + φ F` from R = 0 and f = 0, and solves eq. (25), `θ = R⁻¹ f`, at
    every update by LDLᵀ. Columns are divided by fixed scales. Before four samples exist, the stack holds those that
    do. Each sample is thus counted up to four times, and its weight decays: the covariance is the sandwich
    `σ² R⁻¹ (Σ w² φ φᵀ) R⁻¹`, with w the total weight of each sample and σ from the weighted residuals.

    Args:
        scales: of the columns.
        ridge: δ of eq. (24), on scaled columns, > 0.
        with_mass: estimate m too; without it, the acceleration is not looked at.

    Raises:
        OutOfRange: a scale or the ridge is not positive and finite.
    """

    def __init__(self, *, scales: Scales | None = None, ridge: float = 1e-11, with_mass: bool = False) -> None:
        self.scales = scales or Scales()
        if not all(math.isfinite(value) and value > 0.0 for value in (ridge, *self.scales)):
            raise OutOfRange(
                f"the ridge is {ridge}, the scales are {self.scales}", remedy="give positive, finite numbers"
            )
        self.ridge = ridge
        self.with_mass = with_mass
        self.samples_used = 0
        self._normal = _NO_ROW
        self._squared: Six = _NO_ROW[:6]
        self._mass_normal = _NO_MASS
        self._mass_squared: _Four = _NO_MASS[:4]
        self._weight_sum = 0.0
        self._ridge_sum = 0.0
        self._theta = (0.0, 0.0, 0.0, 0.0)
        self._inverse: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self._spread: Spread | None = UNDETERMINED
        self.restart_stack()

    def restart_stack(self) -> None:
        """Let no later stack hold an earlier sample, as at a change of branch; what was summed up stays."""
        self._stack = (_NO_ROW, _NO_ROW, _NO_ROW)
        self._mass_stack = (_NO_MASS, _NO_MASS, _NO_MASS)
        self._weights = (0.0, 0.0, 0.0)
        self._in_stack = 0

    def update(self, *, x_um: float, v_um_s: float, force_uN: float, forgetting: float, a_um_s2: float = 0.0) -> None:
        """Take one sample: compression, its velocity and acceleration, and the force.

        Args:
            x_um: compression from the undeformed surface.
            v_um_s: its rate.
            force_uN: measured force.
            forgetting: λ in [0, 1]; 1 keeps all of the past, 0 only the stack.
            a_um_s2: the rate of `v_um_s`.

        Raises:
            OutOfRange: `forgetting` is outside [0, 1].
            DataError: a number is not finite, or too large to be squared. The estimate is then unchanged.
        """
        if not 0.0 <= forgetting <= 1.0:
            raise OutOfRange(f"forgetting is {forgetting}", remedy="give a number from 0 to 1")
        x_scale, v_scale, a_scale = self.scales
        x = x_um / x_scale
        c = x * x * x
        v = v_um_s / v_scale
        a = a_um_s2 / a_scale if self.with_mass else 0.0
        y = force_uN
        if not math.isfinite(c * c + v * v + a * a + y * y):
            raise DataError(
                f"a sample is not finite: {x_um} µm, {v_um_s} µm/s, {a_um_s2} µm/s², {force_uN} µN",
                remedy="leave out samples in which the contact point was lost or the sensor gave no force",
            )
        if self.with_mass:
            self._accumulate_mass((c * a, x * a, v * a, a * a, a * y), forgetting)
        self._accumulate((c * c, c * x, c * v, x * x, x * v, v * v, c * y, x * y, v * y, y * y), forgetting)
        self._solve()
        self._spread = None
        self.samples_used += 1

    def _accumulate(self, row: _Row, k: float) -> None:
        """R, f and Σ w F² with λ = `k`, and the weights of the samples."""
        d = self.ridge
        one, two, three = self._stack
        cc, cx, cv, xx, xv, vv, fc, fx, fv, ff = row
        cc1, cx1, cv1, xx1, xv1, vv1, fc1, fx1, fv1, ff1 = one
        cc2, cx2, cv2, xx2, xv2, vv2, fc2, fx2, fv2, ff2 = two
        cc3, cx3, cv3, xx3, xv3, vv3, fc3, fx3, fv3, ff3 = three
        old_cc, old_cx, old_cv, old_xx, old_xv, old_vv, old_fc, old_fx, old_fv, old_ff = self._normal
        self._normal = (
            k * old_cc + (cc + cc1 + cc2 + cc3 + d),
            k * old_cx + (cx + cx1 + cx2 + cx3),
            k * old_cv + (cv + cv1 + cv2 + cv3),
            k * old_xx + (xx + xx1 + xx2 + xx3 + d),
            k * old_xv + (xv + xv1 + xv2 + xv3),
            k * old_vv + (vv + vv1 + vv2 + vv3 + d),
            k * old_fc + (fc + fc1 + fc2 + fc3),
            k * old_fx + (fx + fx1 + fx2 + fx3),
            k * old_fv + (fv + fv1 + fv2 + fv3),
            k * old_ff + (ff + ff1 + ff2 + ff3),
        )
        self._ridge_sum = k * self._ridge_sum + d
        w1, w2, w3 = self._weights
        g1, g2, g3 = _growth(w1, w2, w3, k)
        kk = k * k
        old_cc, old_cx, old_cv, old_xx, old_xv, old_vv = self._squared
        self._squared = (
            kk * old_cc + (cc + g1 * cc1 + g2 * cc2 + g3 * cc3),
            kk * old_cx + (cx + g1 * cx1 + g2 * cx2 + g3 * cx3),
            kk * old_cv + (cv + g1 * cv1 + g2 * cv2 + g3 * cv3),
            kk * old_xx + (xx + g1 * xx1 + g2 * xx2 + g3 * xx3),
            kk * old_xv + (xv + g1 * xv1 + g2 * xv2 + g3 * xv3),
            kk * old_vv + (vv + g1 * vv1 + g2 * vv2 + g3 * vv3),
        )
        self._in_stack = min(self._in_stack + 1, STACK)
        self._weight_sum = k * self._weight_sum + self._in_stack
        self._stack = (row, one, two)
        self._weights = (1.0, k * w1 + 1.0, k * w2 + 1.0)

    def _accumulate_mass(self, row: _MassRow, k: float) -> None:
        """The same for the mass's column; before `_accumulate`, which moves the weights on."""
        one, two, three = self._mass_stack
        ca, xa, va, aa, fa = row
        ca1, xa1, va1, aa1, fa1 = one
        ca2, xa2, va2, aa2, fa2 = two
        ca3, xa3, va3, aa3, fa3 = three
        old_ca, old_xa, old_va, old_aa, old_fa = self._mass_normal
        self._mass_normal = (
            k * old_ca + (ca + ca1 + ca2 + ca3),
            k * old_xa + (xa + xa1 + xa2 + xa3),
            k * old_va + (va + va1 + va2 + va3),
            k * old_aa + (aa + aa1 + aa2 + aa3 + self.ridge),
            k * old_fa + (fa + fa1 + fa2 + fa3),
        )
        g1, g2, g3 = _growth(*self._weights, k)
        kk = k * k
        old_ca, old_xa, old_va, old_aa = self._mass_squared
        self._mass_squared = (
            kk * old_ca + (ca + g1 * ca1 + g2 * ca2 + g3 * ca3),
            kk * old_xa + (xa + g1 * xa1 + g2 * xa2 + g3 * xa3),
            kk * old_va + (va + g1 * va1 + g2 * va2 + g3 * va3),
            kk * old_aa + (aa + g1 * aa1 + g2 * aa2 + g3 * aa3),
        )
        self._mass_stack = (row, one, two)

    def _solve(self) -> None:
        """Eq. (25) by LDLᵀ, the velocity eliminated first, and the inverse of R's block of x³, x, v."""
        cc, cx, cv, xx, xv, vv, fc, fx, fv = self._reduced() if self.with_mass else self._normal[:9]
        # R ≥ (accumulated ridge)·I, so no exact pivot is smaller; only rounding can make one so.
        least = self._ridge_sum
        if vv < least:
            vv = least
        l2, l3 = xv / vv, cv / vv
        pivot2 = xx - l2 * xv
        if pivot2 < least:
            pivot2 = least
        cross = cx - l3 * xv
        l1 = cross / pivot2
        pivot1 = cc - l3 * cv - l1 * cross
        if pivot1 < least:
            pivot1 = least
        z2 = fx - l2 * fv
        c = (fc - l3 * fv - l1 * z2) / pivot1
        x = z2 / pivot2 - l1 * c
        v = fv / vv - l2 * x - l3 * c
        self._theta = (c, x, v, self._mass(c, x, v) if self.with_mass else 0.0)
        i_cc = 1.0 / pivot1
        i_cx = -l1 * i_cc
        i_cv = -l3 * i_cc - l2 * i_cx
        i_xx = 1.0 / pivot2 - l1 * i_cx
        i_xv = -l3 * i_cx - l2 * i_xx
        self._inverse = (i_cc, i_cx, i_cv, i_xx, i_xv, 1.0 / vv - l3 * i_cv - l2 * i_xv)

    def _reduced(self) -> _Nine:
        """The normal equations with the mass eliminated."""
        cc, cx, cv, xx, xv, vv, fc, fx, fv, _ = self._normal
        ca, xa, va, aa, fa = self._mass_normal
        c, x, v = ca / aa, xa / aa, va / aa
        return (
            cc - c * ca, cx - c * xa, cv - c * va, xx - x * xa, xv - x * va, vv - v * va,
            fc - c * fa, fx - x * fa, fv - v * fa,
        )  # fmt: skip

    def _mass(self, c: float, x: float, v: float) -> float:
        """θ of the acceleration, given the others."""
        ca, xa, va, aa, fa = self._mass_normal
        return (fa - c * ca - x * xa - v * va) / aa

    # ------------------------------------------------------------------ reading

    @property
    def theta(self) -> tuple[float, float, float, float]:
        """θ of the scaled columns x³, x, v, a, µN; the last is 0 without a mass."""
        return self._theta

    @property
    def parameters(self) -> tuple[float, float, float, float]:
        """(k1 µN/µm, k2 µN/µm³, b µN·s/µm, m kg); m is NaN where it is not estimated."""
        k2, k1, b, m = self._theta
        x, v, a = self.scales
        return (k1 / x, k2 / (x * x * x), b / v, m / a if self.with_mass else math.nan)

    def predict_uN(self, *, x_um: float, v_um_s: float, a_um_s2: float = 0.0) -> float:
        """The force of eq. (22) by the present estimate; called before `update`, the a-priori prediction."""
        k2, k1, b, m = self._theta
        x_scale, v_scale, a_scale = self.scales
        x = x_um / x_scale
        return (k1 + k2 * x * x) * x + b * v_um_s / v_scale + m * a_um_s2 / a_scale

    @property
    def information(self) -> Array:
        """R of the scaled columns, ridge included: 3 × 3 for x³, x, v, or 4 × 4 with a."""
        cc, cx, cv, xx, xv, vv = self._normal[:6]
        if not self.with_mass:
            return np.array([[cc, cx, cv], [cx, xx, xv], [cv, xv, vv]])
        ca, xa, va, aa, _ = self._mass_normal
        return np.array([[cc, cx, cv, ca], [cx, xx, xv, xa], [cv, xv, vv, va], [ca, xa, va, aa]])

    def spread(self) -> Spread:
        """How well the samples tell θ; computed when asked for, once an update."""
        if self._spread is None:
            self._spread = self._computed_spread()
        return self._spread

    def _computed_spread(self) -> Spread:
        if self.with_mass:
            ca, xa, va, aa, _ = self._mass_normal
            squared, of_mass = without_mass((ca, xa, va, aa), self._squared, self._mass_squared)
            largest = math.hypot(norm(self._normal), math.sqrt(2.0) * math.hypot(ca, xa, va), aa)
            weakest = 1.0 / norm_with_mass(self._inverse, (ca, xa, va, aa))
        else:
            squared, of_mass = self._squared, 0.0
            largest, weakest = norm(self._normal), 1.0 / norm(self._inverse)
        condition = math.sqrt(largest / weakest)
        enough = self.samples_used >= (4 if self.with_mass else 3)
        if not enough or weakest < max(DETERMINED_RIDGES * self._ridge_sum, _ROUNDING * largest):
            return Spread(condition, False, (), math.nan)
        variance = self._noise_variance(squared, of_mass)
        if variance is None:
            return Spread(condition, True, (), math.nan)
        return Spread(condition, True, self._covariance(squared, variance), math.sqrt(variance))

    def _noise_variance(self, squared: Six, of_mass: float) -> float | None:
        """Variance of one sample's residual; None where the residuals leave nothing to judge it by."""
        k2, k1, b, m = self._theta
        fc, fx, fv, ff = self._normal[6:]
        fitted = k2 * fc + k1 * fx + b * fv + m * self._mass_normal[4]
        residual = ff - fitted - self._ridge_sum * (k2 * k2 + k1 * k1 + b * b + m * m)
        cc, cx, cv, xx, xv, vv = self._inverse
        s_cc, s_cx, s_cv, s_xx, s_xv, s_vv = squared
        lost = cc * s_cc + xx * s_xx + vv * s_vv + 2.0 * (cx * s_cx + cv * s_cv + xv * s_xv) + of_mass
        freedom = self._weight_sum - lost
        if freedom <= _SMALLEST_RESIDUAL_SHARE * self._weight_sum:
            return None
        return max(residual, 0.0) / freedom

    def _covariance(self, squared: Six, variance: float) -> tuple[float, ...]:
        """σ² R⁻¹ (Σ w² φ φᵀ) R⁻¹ of (k1, k2, b), row-major 3 × 3, in µN, µm and s."""
        cc, cx, cv, xx, xv, vv = sandwich(self._inverse, squared)
        x_scale, v_scale, _ = self.scales
        k, h, b = 1.0 / x_scale, 1.0 / (x_scale * x_scale * x_scale), 1.0 / v_scale
        kh, kb, hb = variance * k * h * cx, variance * k * b * xv, variance * h * b * cv
        return (variance * k * k * xx, kh, kb, kh, variance * h * h * cc, hb, kb, hb, variance * b * b * vv)


def _growth(w1: float, w2: float, w3: float, k: float) -> tuple[float, float, float]:
    """A weight that goes from k·w to k·w + 1 adds 2·k·w + 1 to its square."""
    return 2.0 * k * w1 + 1.0, 2.0 * k * w2 + 1.0, 2.0 * k * w3 + 1.0
