"""Recursive ridge least squares with forgetting for the projection matrix P (Bilen et al., eqs. (7)–(19)).

The regressor of eq. (8) has the same 1 × 3 block for u and for v, so eqs. (15) and (18) reduce to one
symmetric 3 × 3 matrix. Its triangle is kept as plain scalars, which can neither lose its symmetry nor, at
this size, be beaten by array code.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from microdrivers.core.errors import DataError
from microdrivers.estimators.optics.sandwich import (
    FloatArray,
    ProjectionUncertainty,
    WeightedFrames,
    projection_uncertainty,
)

Six = tuple[float, float, float, float, float, float]
_Twelve = tuple[
    float, float, float, float, float, float, float, float, float, float, float, float
]  # fmt: skip

_NO_ROW: _Twelve = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

DETERMINED_RIDGES = 100.0
"""A direction of θ counts as measured when the data weigh this many times more in it than the ridge."""

_ROUNDING = 1e-12


class ProjectionRecursion:
    """Estimates `[u v]ᵀ = P [X Y 1]ᵀ` on line; an update stacks the newest three measurements (eq. (8)).

    It carries eqs. (18) and (19), `R ← λ R + φ φᵀ + δ I` and `f ← λ f + φ y + δ θ⁰` from R = 0, f = 0, and
    solves eq. (14), `θ = R⁻¹ f`, at every update. Equation (17) as printed contradicts eq. (14); its correct
    innovation form is `θ_t = θ_{t−1} + R⁻¹ [φ (y − φᵀ θ_{t−1}) + δ (θ⁰ − θ_{t−1})]` and equals what is
    computed here.

    θ lives in the fixed coordinates `xn = (X − cx) / scale`, `yn = (Y − cy) / scale`: state them with a
    result, since the ridge is meant in them. Before three measurements exist, the stack holds those that do.

    A forgetting factor of 0 drops everything but the stack, so three updates with 0 leave exactly the newest
    three measurements. Which measurements belong to one setting of the optics is known to the caller alone:
    while the optics change *and for three measurements after*, use 0, and do not trust the estimate before
    the third.

    Args:
        centre_um: (cx, cy), stage coordinates of the middle of the travel in use, µm.
        scale_um: half-width of the travel in use, µm, > 0.
        ridge: δ of eq. (12), > 0; at most about 1e-9, or it biases P where three neighbouring poses decide.
        prior: θ⁰, (p11 p12 p13 p21 p22 p23) in px for the normalised coordinates.
        sigma_drift_um_s: standard deviation of the sample's drift against the stage; only the uncertainty uses it.

    Raises:
        ValueError: `scale_um` or `ridge` is not positive and finite, or a centre or prior is not finite.
    """

    def __init__(
        self,
        *,
        centre_um: tuple[float, float],
        scale_um: float,
        ridge: float = 1e-9,
        prior: Sequence[float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        sigma_drift_um_s: float = 0.0,
    ) -> None:
        if not (math.isfinite(scale_um) and scale_um > 0.0):
            raise ValueError(f"scale_um is {scale_um}: it must be positive and finite")
        if not (math.isfinite(ridge) and ridge > 0.0):
            raise ValueError(f"ridge is {ridge}: it must be positive and finite")
        if len(centre_um) != 2 or len(prior) != 6 or not all(map(math.isfinite, (*centre_um, *prior))):
            raise ValueError("centre_um needs two finite numbers and prior six")
        self.centre_um = centre_um
        self.scale_um = scale_um
        self.ridge = ridge
        self.sigma_drift_um_s = sigma_drift_um_s
        self._now_s = 0.0
        self._cx, self._cy = centre_um
        p11, p12, p13, p21, p22, p23 = prior
        self._theta: Six = (p11, p12, p13, p21, p22, p23)
        self.switch_prior()
        self._ridge_sum = 0.0
        self._normal = _NO_ROW
        self._newest = _NO_ROW
        self._second = _NO_ROW
        self._frames_used = 0
        self._is_determined: bool | None = None
        self._frames = WeightedFrames()

    def update(
        self,
        *,
        x_um: float,
        y_um: float,
        u_px: float,
        v_px: float,
        forgetting: float,
        vx_um_s: float = 0.0,
        vy_um_s: float = 0.0,
        sigma_time_s: float = 0.0,
        t_s: float = 0.0,
    ) -> None:
        """Take one measurement, a stage pose and where the feature was seen (eqs. (14), (18), (19)).

        Args:
            x_um: stage X at the instant of the image, µm.
            y_um: stage Y at that instant, µm.
            u_px: image coordinate u, px from the principal point.
            v_px: image coordinate v, px from the principal point, downwards.
            forgetting: λ in [0, 1]; 1 keeps all of the past, 0 only the stack.
            vx_um_s: stage velocity along X, µm/s; only the uncertainty uses the velocity.
            vy_um_s: stage velocity along Y, µm/s.
            sigma_time_s: standard deviation of the time offset between poses and images, s; the offset is
                taken as unknown and common to all measurements.
            t_s: the instant of the image, s from any instant common to all; only the uncertainty uses it.

        Raises:
            ValueError: `forgetting` is outside [0, 1].
            DataError: a number is not finite, or too large to be squared. The estimate is then unchanged.
        """
        if not 0.0 <= forgetting <= 1.0:
            raise ValueError(f"forgetting is {forgetting}: it must lie in [0, 1]")
        x = (x_um - self._cx) / self.scale_um
        y = (y_um - self._cy) / self.scale_um
        xx = x * x
        yy = y * y
        offset_x = sigma_time_s * vx_um_s
        offset_y = sigma_time_s * vy_um_s
        if not math.isfinite(xx + yy + u_px * u_px + v_px * v_px + offset_x * offset_x + offset_y * offset_y + t_s):
            raise DataError(
                f"a measurement is not finite: X {x_um}, Y {y_um} µm, u {u_px}, v {v_px} px, "
                f"velocity {vx_um_s}, {vy_um_s} µm/s, σ_time {sigma_time_s} s, time {t_s} s",
                remedy="leave out frames in which the target was not found or the stage gave no position",
            )
        row = (xx, x * y, x, yy, y, 1.0, x * u_px, y * u_px, u_px, x * v_px, y * v_px, v_px)
        self._accumulate(row, forgetting)
        self._frames.append(forgetting, x, y, offset_x, offset_y, t_s, u_px, v_px, self._theta)
        self._now_s = t_s
        self._is_determined = None
        if forgetting == 0.0 and self._frames_used > 2:
            self._frames_used = 2
        self._frames_used += 1

    def _accumulate(self, row: _Twelve, k: float) -> None:
        """Eqs. (18), (19) with λ = `k`, then eq. (14) by LDLᵀ, the constant regressor eliminated first."""
        r11, r12, r13, r22, r23, r33, f1, f2, f3, g1, g2, g3 = self._normal
        a11, a12, a13, a22, a23, a33, b1, b2, b3, c1, c2, c3 = row
        d11, d12, d13, d22, d23, d33, e1, e2, e3, h1, h2, h3 = self._newest
        i11, i12, i13, i22, i23, i33, j1, j2, j3, m1, m2, m3 = self._second
        q1, q2, q3, s1, s2, s3 = self._ridge_prior
        ridge = self.ridge
        ridge_sum = self._ridge_sum = k * self._ridge_sum + ridge
        r11 = k * r11 + (a11 + d11 + i11 + ridge)
        r12 = k * r12 + (a12 + d12 + i12)
        r13 = k * r13 + (a13 + d13 + i13)
        r22 = k * r22 + (a22 + d22 + i22 + ridge)
        r23 = k * r23 + (a23 + d23 + i23)
        r33 = k * r33 + (a33 + d33 + i33 + ridge)
        f1 = k * f1 + (b1 + e1 + j1 + q1)
        f2 = k * f2 + (b2 + e2 + j2 + q2)
        f3 = k * f3 + (b3 + e3 + j3 + q3)
        g1 = k * g1 + (c1 + h1 + m1 + s1)
        g2 = k * g2 + (c2 + h2 + m2 + s2)
        g3 = k * g3 + (c3 + h3 + m3 + s3)
        self._normal = (r11, r12, r13, r22, r23, r33, f1, f2, f3, g1, g2, g3)
        self._second = self._newest
        self._newest = row

        # R ≥ (accumulated ridge)·I, so no exact pivot is smaller; only rounding can make one so.
        l1 = r13 / r33
        l2 = r23 / r33
        pivot1 = r11 - l1 * r13
        if pivot1 < ridge_sum:
            pivot1 = ridge_sum
        cross = r12 - l1 * r23
        l3 = cross / pivot1
        pivot2 = r22 - l2 * r23 - l3 * cross
        if pivot2 < ridge_sum:
            pivot2 = ridge_sum
        f1 -= l1 * f3
        g1 -= l1 * g3
        p2 = (f2 - l2 * f3 - l3 * f1) / pivot2
        t2 = (g2 - l2 * g3 - l3 * g1) / pivot2
        p1 = f1 / pivot1 - l3 * p2
        t1 = g1 / pivot1 - l3 * t2
        self._theta = (p1, p2, f3 / r33 - l1 * p1 - l2 * p2, t1, t2, g3 / r33 - l1 * t1 - l2 * t2)

    def switch_prior(self) -> None:
        """From now on pull towards the present estimate: θ⁰ of eq. (12) becomes θ."""
        p11, p12, p13, p21, p22, p23 = self._theta
        d = self.ridge
        self._ridge_prior: Six = (d * p11, d * p12, d * p13, d * p21, d * p22, d * p23)

    @property
    def theta(self) -> Six:
        """θ = (p11 p12 p13 p21 p22 p23) in normalised coordinates, px; at first the prior."""
        return self._theta

    @property
    def projection(self) -> Six:
        """(p11 p12 p13 p21 p22 p23) of eq. (6) in stage coordinates: px/µm, and px for p13, p23."""
        t1, t2, t3, t4, t5, t6 = self._theta
        p11, p12 = t1 / self.scale_um, t2 / self.scale_um
        p21, p22 = t4 / self.scale_um, t5 / self.scale_um
        p13 = t3 - p11 * self._cx - p12 * self._cy
        return (p11, p12, p13, p21, p22, t6 - p21 * self._cx - p22 * self._cy)

    def predict(self, x_um: float, y_um: float) -> tuple[float, float]:
        """Where the feature should be seen, (u, v) in px, for a stage pose in µm (eq. (9)).

        Called before `update` with the same pose it gives the a-priori prediction, after it the a-posteriori
        one.
        """
        t1, t2, t3, t4, t5, t6 = self._theta
        x = (x_um - self._cx) / self.scale_um
        y = (y_um - self._cy) / self.scale_um
        return (t1 * x + t2 * y + t3, t4 * x + t5 * y + t6)

    @property
    def frames_used(self) -> int:
        """Measurements with a weight: the stack of the last update with λ = 0, and all after it."""
        return self._frames_used

    @property
    def information(self) -> FloatArray:
        """The 3 × 3 block of R (eq. (18)) that u and v share, ridge included, in normalised coordinates."""
        r11, r12, r13, r22, r23, r33 = self._normal[:6]
        return np.array([[r11, r12, r13], [r12, r22, r23], [r13, r23, r33]])

    @property
    def condition(self) -> float:
        """Condition number of `information` in the 2-norm, ≥ 1; infinite before any measurement."""
        smallest, _, largest = np.linalg.eigvalsh(self.information)
        return float(largest / smallest) if smallest > 0.0 else math.inf

    @property
    def is_determined(self) -> bool:
        """Whether the measurements alone fix θ.

        True when at least three have a weight and the weakest direction of R is well above rounding and at
        least `DETERMINED_RIDGES` times the accumulated ridge, i.e. the prior pulls any combination of θ by
        less than 1 %. It says nothing about noise (see `uncertainty`), nor whether the measurements belong
        to one setting of the optics.
        """
        if self._is_determined is None:
            smallest, _, largest = np.linalg.eigvalsh(self.information)
            enough = smallest >= max(DETERMINED_RIDGES * self._ridge_sum, _ROUNDING * largest)
            self._is_determined = self._frames_used >= 3 and bool(enough)
        return self._is_determined

    def uncertainty(self) -> ProjectionUncertainty | None:
        """Covariance of `projection` and what it rests on; None while the measurements do not tell.

        They must determine θ (else the ridge alone would make the covariance small) and number at least
        four, so that residuals exist. It is computed when asked for (about 0.3 ms), depends on the
        measurements only, and leaves the state alone.
        """
        if self._frames_used < 4 or not self.is_determined:
            return None
        return projection_uncertainty(
            self._frames.totals(self._theta),
            information=self.information,
            theta=self._theta,
            centre_um=self.centre_um,
            scale_um=self.scale_um,
            now_s=self._now_s,
            sigma_drift_um_s=self.sigma_drift_um_s,
        )
