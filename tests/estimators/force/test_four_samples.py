"""The four-sample form against eq. (25) on all stacked rows, its covariance, and singular input."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.errors import DataError, OutOfRange
from microdrivers.estimators.force.four_samples import STACK, FourSampleRecursion, Scales

Array = npt.NDArray[np.float64]


class Rows(NamedTuple):
    x: Array
    v: Array
    a: Array
    force: Array
    factors: Array
    restarts: npt.NDArray[np.bool_]


def random_rows(seed: int, count: int) -> Rows:
    rng = np.random.default_rng(seed)
    x, v, a = rng.uniform(0.0, 120.0, count), rng.uniform(-6.0, 6.0, count), rng.normal(0.0, 30.0, count)
    force = 4.5 * x + 1e-4 * x**3 + 27.0 * v + 0.3 * a + rng.standard_normal(count)
    factors = rng.choice([0.0, 0.3, 1.0, 0.99, 0.9], count, p=[0.03, 0.05, 0.3, 0.32, 0.3])
    return Rows(x, v, a, force, factors, rng.uniform(size=count) < 0.1)


def recursion_of(rows: Rows, **changes: Any) -> FourSampleRecursion:
    estimator = FourSampleRecursion(**changes)
    for x, v, a, force, factor, restart in zip(*(column.tolist() for column in rows), strict=True):
        if restart:
            estimator.restart_stack()
        estimator.update(x_um=x, v_um_s=v, a_um_s2=a, force_uN=force, forgetting=factor)
    return estimator


def batch(rows: Rows, *, with_mass: bool, ridge: float) -> tuple[Array, Array, Array, float, Array]:
    """R and θ of eq. (25) from the stacks of eq. (23); the sandwich in θ's own columns; weights."""
    scales = Scales()
    columns = [(rows.x / scales.x_um) ** 3, rows.x / scales.x_um, rows.v / scales.v_um_s]
    phi = np.column_stack([*columns, rows.a / scales.a_um_s2] if with_mass else columns)
    count, width = phi.shape
    weights, ridge_sum, begin = np.zeros(count), 0.0, 0
    R, f = np.zeros((width, width)), np.zeros(width)
    for k in range(count):
        begin = k if rows.restarts[k] else begin
        stack = slice(max(begin, k - STACK + 1), k + 1)
        R = rows.factors[k] * R + phi[stack].T @ phi[stack] + ridge * np.eye(width)
        f = rows.factors[k] * f + phi[stack].T @ rows.force[stack]
        ridge_sum = rows.factors[k] * ridge_sum + ridge
        weights *= rows.factors[k]
        weights[stack] += 1.0
    theta = np.linalg.solve(R, f)
    inverse = np.linalg.inv(R)
    S = phi.T @ (weights[:, None] ** 2 * phi)
    residual = rows.force - phi @ theta
    variance = float(np.sum(weights * residual**2) / (weights.sum() - np.trace(inverse @ S)))
    return R, theta, inverse @ S @ inverse, variance, weights


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1), st.integers(6, 60), st.booleans(), st.sampled_from([1e-9, 1e-3]))
def test_equals_the_batch_ridge_of_the_stacked_rows(seed: int, count: int, with_mass: bool, ridge: float) -> None:
    rows = random_rows(seed, count)
    estimator = recursion_of(rows, with_mass=with_mass, ridge=ridge)
    R, theta, _, _, _ = batch(rows, with_mass=with_mass, ridge=ridge)
    width = len(theta)
    assert np.allclose(estimator.information, R, rtol=0.0, atol=1e-12 * np.abs(R).max())
    # Rounding of the data alone moves θ by this much.
    tolerance = max(1e-9, 1e-14 * np.linalg.cond(R)) * np.linalg.norm(theta)
    assert np.abs(np.array(estimator.theta[:width]) - theta).max() <= tolerance
    k1, k2, b, m = estimator.parameters
    expected = theta / np.array([1e6, 1e2, 5.0, 50.0])[:width]
    assert np.allclose([k2, k1, b, m][:width], expected, rtol=1e-6, atol=1e-6 * np.abs(expected))
    assert math.isnan(m) != with_mass


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_covariance_is_the_sandwich_of_the_weights_with_which_samples_count(seed: int, with_mass: bool) -> None:
    rows = random_rows(seed, 80)
    rows.factors[-40:] = 0.97
    estimator = recursion_of(rows, with_mass=with_mass, ridge=1e-9)
    _, _, spread, variance, weights = batch(rows, with_mass=with_mass, ridge=1e-9)
    assert weights.max() > 3.0
    found = estimator.spread()
    scale = np.diag([1e-6, 1e-2, 0.2])
    order = [1, 0, 2]
    expected = (variance * scale @ spread[:3, :3] @ scale)[np.ix_(order, order)]
    assert found.determined
    assert np.allclose(np.array(found.covariance).reshape(3, 3), expected, rtol=1e-5, atol=0.0)
    assert found.noise_uN == pytest.approx(math.sqrt(variance), rel=1e-5)
    exact = math.sqrt(np.linalg.cond(estimator.information))
    assert exact <= found.condition * (1.0 + 1e-9) <= 2.0 * exact


def test_four_times_counted_samples_do_not_halve_the_covariance() -> None:
    rng = np.random.default_rng(5)
    errors, predicted = [], []
    for _ in range(100):
        rows = random_rows(int(rng.integers(2**32)), 60)
        rows = rows._replace(factors=np.ones(60), restarts=np.zeros(60, dtype=bool))
        estimator = recursion_of(rows._replace(force=rows.force - 0.3 * rows.a))
        errors.append(estimator.parameters[0] - 4.5)
        predicted.append(math.sqrt(estimator.spread().covariance[0]))
    assert np.sqrt(np.mean(np.square(errors))) / np.mean(predicted) == pytest.approx(1.0, abs=0.2)


def singular_kinds(rng: np.random.Generator, kind: str, count: int) -> Array:
    """Columns x, v, force that leave θ undetermined."""
    noise = rng.standard_normal((count, 2))
    if kind == "far beyond the scales":  # the ridge is lost in rounding
        return np.column_stack([np.full(count, 100.0 * 2**15), np.full(count, 5.0 * 2**15), 300.0 + noise[:, 0]])
    if kind == "at rest":
        return np.column_stack([np.full(count, 50.0), np.zeros(count), 300.0 + noise[:, 0]])
    if kind == "one depth":
        return np.column_stack([50.0 + 1e-7 * noise[:, 1], np.full(count, 5.0), 300.0 + noise[:, 0]])
    if kind == "never touching":
        return np.zeros((count, 3))
    return np.column_stack([100.0 * noise[:, 1], 5.0 * noise[:, 1], 1000.0 * noise[:, 1]])


def run_singular(kind: str, count: int, seed: int, forgetting: float, *, with_mass: bool = False) -> None:
    estimator = FourSampleRecursion(with_mass=with_mass)
    largest = 0.0
    for k, (x, v, force) in enumerate(singular_kinds(np.random.default_rng(seed), kind, count).tolist()):
        estimator.update(x_um=x, v_um_s=v, a_um_s2=x, force_uN=force, forgetting=forgetting)
        if k % 10 == 0:
            largest = max(largest, *map(abs, estimator.theta))
            assert math.isfinite(largest)
    assert largest < 1e7
    found = estimator.spread()
    assert kind == "one line" or not found.determined
    smallest, *_, greatest = np.linalg.eigvalsh(estimator.information)
    assert smallest >= -1e-12 * greatest


@settings(deadline=None, max_examples=8)
@given(
    st.sampled_from(["at rest", "one depth", "far beyond the scales", "never touching", "one line"]),
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.0, 0.5, 0.99, 1.0]),
    st.booleans(),
)
def test_stays_finite_on_singular_input(kind: str, seed: int, forgetting: float, with_mass: bool) -> None:
    run_singular(kind, 1500, seed, forgetting, with_mass=with_mass)


def test_stays_finite_for_a_hundred_thousand_singular_updates() -> None:
    run_singular("one depth", 100_000, 1, 0.99)


def test_ridge_that_is_lost_in_rounding_leaves_no_pivot_at_zero() -> None:
    run_singular("far beyond the scales", 50, 0, 1.0)


def test_what_cannot_be_used_is_refused_and_changes_nothing() -> None:
    estimator = recursion_of(random_rows(1, 20))
    before = estimator.theta
    for wrong in ({"x_um": math.nan}, {"force_uN": math.inf}, {"v_um_s": 1e200}):
        with pytest.raises(DataError, match="not finite"):
            estimator.update(**({"x_um": 1.0, "v_um_s": 1.0, "force_uN": 1.0, "forgetting": 1.0} | wrong))
    with pytest.raises(OutOfRange, match="forgetting"):
        estimator.update(x_um=1.0, v_um_s=1.0, force_uN=1.0, forgetting=1.1)
    assert estimator.theta == before
    for bad in ({"ridge": 0.0}, {"ridge": math.nan}, {"scales": Scales(x_um=0.0)}):
        with pytest.raises(OutOfRange, match="positive"):
            FourSampleRecursion(**bad)


def test_nothing_is_determined_before_enough_samples() -> None:
    estimator = FourSampleRecursion()
    assert estimator.spread().condition == math.inf
    for x, v in ((10.0, 5.0), (50.0, -5.0)):
        estimator.update(x_um=x, v_um_s=v, force_uN=1.0, forgetting=1.0)
        assert not estimator.spread().determined
    estimator.update(x_um=100.0, v_um_s=3.0, force_uN=1.0, forgetting=1.0)
    assert estimator.spread().determined
    assert estimator.spread().covariance == ()
