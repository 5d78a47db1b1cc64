"""Symmetric 3 × 3 matrices over the columns x³, x and v, as the six scalars of a triangle: cc cx cv xx xv vv.

A fourth column, the mass's, is eliminated beforehand; `of_mass` is its row of the matrix: ca xa va aa.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

Six = tuple[float, float, float, float, float, float]


def sandwich(bread: Six, filling: Six) -> Six:
    """The product bread · filling · bread."""
    cc, cx, cv, xx, xv, vv = bread
    s_cc, s_cx, s_cv, s_xx, s_xv, s_vv = filling
    c1, c2, c3 = cc * s_cc + cx * s_cx + cv * s_cv, cc * s_cx + cx * s_xx + cv * s_xv, cc * s_cv + cx * s_xv + cv * s_vv
    x1, x2, x3 = cx * s_cc + xx * s_cx + xv * s_cv, cx * s_cx + xx * s_xx + xv * s_xv, cx * s_cv + xx * s_xv + xv * s_vv
    v1, v2, v3 = cv * s_cc + xv * s_cx + vv * s_cv, cv * s_cx + xv * s_xx + vv * s_xv, cv * s_cv + xv * s_xv + vv * s_vv
    return (
        c1 * cc + c2 * cx + c3 * cv,
        c1 * cx + c2 * xx + c3 * xv,
        c1 * cv + c2 * xv + c3 * vv,
        x1 * cx + x2 * xx + x3 * xv,
        x1 * cv + x2 * xv + x3 * vv,
        v1 * cv + v2 * xv + v3 * vv,
    )


def norm(triangle: Sequence[float]) -> float:
    """Frobenius norm of a symmetric 3 × 3 matrix."""
    cc, cx, cv, xx, xv, vv = triangle[:6]
    return math.sqrt(cc * cc + xx * xx + vv * vv + 2.0 * (cx * cx + cv * cv + xv * xv))


def norm_with_mass(inverse: Six, of_mass: Sequence[float]) -> float:
    """Frobenius norm of the inverse of R, from the inverse's block without the mass and R's column of it."""
    cc, cx, cv, xx, xv, vv = inverse
    ca, xa, va, aa = of_mass
    c, x, v = ca / aa, xa / aa, va / aa
    i_ca, i_xa, i_va = cc * c + cx * x + cv * v, cx * c + xx * x + xv * v, cv * c + xv * x + vv * v
    i_aa = 1.0 / aa + c * i_ca + x * i_xa + v * i_va
    return math.hypot(norm(inverse), math.sqrt(2.0) * math.hypot(i_ca, i_xa, i_va), i_aa)


def without_mass(of_mass: Sequence[float], squared: Six, mass_squared: Sequence[float]) -> tuple[Six, float]:
    """Σ w² φ φᵀ of the columns from which the mass's has been taken out as in R, and the mass's part in tr(R⁻¹ S)."""
    ca, xa, va, aa = of_mass
    c, x, v = ca / aa, xa / aa, va / aa
    s_cc, s_cx, s_cv, s_xx, s_xv, s_vv = squared
    s_ca, s_xa, s_va, s_aa = mass_squared
    reduced = (
        s_cc - 2.0 * c * s_ca + c * c * s_aa,
        s_cx - c * s_xa - x * s_ca + c * x * s_aa,
        s_cv - c * s_va - v * s_ca + c * v * s_aa,
        s_xx - 2.0 * x * s_xa + x * x * s_aa,
        s_xv - x * s_va - v * s_xa + x * v * s_aa,
        s_vv - 2.0 * v * s_va + v * v * s_aa,
    )
    return reduced, s_aa / aa
