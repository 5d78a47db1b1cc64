"""Half-widths of confidence intervals when the noise itself is estimated from few measurements."""

from __future__ import annotations

import math
from statistics import NormalDist


def student_factor(degrees_of_freedom: float, confidence: float = 0.95) -> float:
    """Two-sided quantile of Student's t.

    Asymptotic expansion of Abramowitz & Stegun, 26.7.5: for 95 % within 1 % at 2 degrees of freedom, 0.2 % at
    3, 2e-4 from 5 on.

    Args:
        degrees_of_freedom: > 0, not necessarily whole; `math.inf` gives the normal quantile.
        confidence: probability inside the interval, in (0, 1).

    Returns:
        The factor, dimensionless; infinite below 2 degrees of freedom, where t has no variance.
    """
    z = NormalDist().inv_cdf(0.5 + confidence / 2.0)
    if degrees_of_freedom < 2.0:
        return math.inf
    n = degrees_of_freedom
    g1 = (z**3 + z) / 4.0
    g2 = (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / 96.0
    g3 = (3.0 * z**7 + 19.0 * z**5 + 17.0 * z**3 - 15.0 * z) / 384.0
    g4 = (79.0 * z**9 + 776.0 * z**7 + 1482.0 * z**5 - 1920.0 * z**3 - 945.0 * z) / 92160.0
    return z + g1 / n + g2 / n**2 + g3 / n**3 + g4 / n**4


def ellipse_factor(degrees_of_freedom: float, confidence: float = 0.95) -> float:
    """Radius, in standard deviations, of the confidence ellipse of a two-dimensional vector (Hotelling's T).

    Args:
        degrees_of_freedom: > 0, of the estimated covariance; `math.inf` gives the χ² radius.
        confidence: probability inside the ellipse, in (0, 1).

    Returns:
        The radius, dimensionless; infinite below 2 degrees of freedom.
    """
    if degrees_of_freedom < 2.0:
        return math.inf
    outside = 1.0 - confidence
    if math.isinf(degrees_of_freedom):
        return math.sqrt(-2.0 * math.log(outside))
    # The F quantile for (2, n − 1) degrees of freedom has a closed form, and T² = 2 n / (n − 1) · F.
    n = degrees_of_freedom
    return math.sqrt(n * math.expm1(-2.0 / (n - 1.0) * math.log(outside)))
