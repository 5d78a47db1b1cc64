"""Quantiles against tables."""

from __future__ import annotations

import math

import pytest

from microdrivers.estimators.optics.intervals import ellipse_factor, student_factor


@pytest.mark.parametrize(
    ("degrees_of_freedom", "confidence", "expected", "relative"),
    [
        (2, 0.95, 4.30265, 1e-2),
        (3, 0.95, 3.18245, 2e-3),
        (5, 0.95, 2.57058, 2e-4),
        (10, 0.95, 2.22814, 1e-5),
        (35, 0.95, 2.03011, 1e-5),
        (math.inf, 0.95, 1.95996, 1e-5),
        (10, 0.99, 3.16927, 1e-4),
        (10, 0.5, 0.69981, 1e-4),
    ],
)
def test_student(degrees_of_freedom: float, confidence: float, expected: float, relative: float) -> None:
    assert student_factor(degrees_of_freedom, confidence) == pytest.approx(expected, rel=relative)


@pytest.mark.parametrize(
    # T² = 2 n / (n − 1) · F(2, n − 1), F from tables: 4.2565 for (2, 9), 3.0718 for (2, 120).
    ("degrees_of_freedom", "squared"),
    [(10, 2 * 10 / 9 * 4.2565), (121, 2 * 121 / 120 * 3.0718), (math.inf, 5.99146), (1e9, 5.99146)],
)
def test_ellipse(degrees_of_freedom: float, squared: float) -> None:
    assert ellipse_factor(degrees_of_freedom) ** 2 == pytest.approx(squared, rel=1e-4)


@pytest.mark.parametrize("degrees_of_freedom", [0.0, 1.0, 1.9])
def test_too_few_degrees_of_freedom_give_no_interval(degrees_of_freedom: float) -> None:
    assert student_factor(degrees_of_freedom) == math.inf
    assert ellipse_factor(degrees_of_freedom) == math.inf
