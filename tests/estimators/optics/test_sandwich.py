"""The recursive covariance against brute force, and its 95 % intervals against many simulated runs."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.estimators.optics import ProjectionRecursion, ProjectionUncertainty
from microdrivers.estimators.optics.sandwich import BLOCK, WeightedFrames

CENTRE_UM = (5200.0, 7100.0)
SCALE_UM = 300.0
RIDGE = 1e-9
TRUTH = np.array([[0.17, 0.17, -2100.0], [0.17, -0.171, 330.0]])


class Run(NamedTuple):
    estimator: ProjectionRecursion
    xy_um: np.ndarray
    uv_px: np.ndarray
    drift_um: np.ndarray
    forgetting: np.ndarray


def random_run(seed: int, factors: list[float], *, read_every: int = 0) -> Run:
    rng = np.random.default_rng(seed)
    count = len(factors)
    xy = np.array(CENTRE_UM) + SCALE_UM * rng.uniform(-1, 1, (count, 2))
    uv = xy @ TRUTH[:, :2].T + TRUTH[:, 2] + rng.standard_normal((count, 2)) @ [[0.01, 0.0], [0.004, 0.02]]
    velocity = rng.normal(0, 600, (count, 2))
    sigma = rng.uniform(0, 2e-4, count)
    estimator = ProjectionRecursion(centre_um=CENTRE_UM, scale_um=SCALE_UM, ridge=RIDGE)
    for k in range(count):
        estimator.update(
            x_um=float(xy[k, 0]),
            y_um=float(xy[k, 1]),
            u_px=float(uv[k, 0]),
            v_px=float(uv[k, 1]),
            forgetting=factors[k],
            vx_um_s=float(velocity[k, 0]),
            vy_um_s=float(velocity[k, 1]),
            sigma_time_s=float(sigma[k]),
        )
        if read_every and k % read_every == 0:
            estimator.uncertainty()
    return Run(estimator, xy, uv, velocity * sigma[:, None], np.array(factors))


def brute_force(run: Run) -> ProjectionUncertainty:
    """Noise, covariance and degrees of freedom from n × n matrices, measurement by measurement."""
    count = len(run.forgetting)
    weights = np.zeros(count)
    for k in range(count):
        weights[max(0, k - 2) : k + 1] += np.prod(run.forgetting[k + 1 :])
    X = np.column_stack([(run.xy_um - CENTRE_UM) / SCALE_UM, np.ones(count)])
    ridge_sum = RIDGE * sum(np.prod(run.forgetting[k + 1 :]) for k in range(count))
    inverse = np.linalg.inv(X.T @ (weights[:, None] * X) + ridge_sum * np.eye(3))
    gain = inverse @ X.T * weights
    theta = np.array(run.estimator.theta).reshape(2, 3).T
    residuals = run.uv_px - X @ theta
    annihilator = np.eye(count) - X @ gain
    form = annihilator.T @ np.diag(weights) @ annihilator
    noise = residuals.T @ (weights[:, None] * residuals) / np.trace(form)
    covariance = np.kron(noise, gain @ gain.T)
    projection = np.array(run.estimator.projection).reshape(2, 3)
    shift = (gain @ run.drift_um @ projection[:, :2].T).T.ravel()
    covariance += np.outer(shift, shift)
    T = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-CENTRE_UM[0], -CENTRE_UM[1], SCALE_UM]]) / SCALE_UM
    T6 = np.kron(np.eye(2), T)
    return ProjectionUncertainty(T6 @ covariance @ T6.T, noise, np.trace(form) ** 2 / np.trace(form @ form))


def assert_same(run: Run, tolerance: float) -> None:
    found, expected = run.estimator.uncertainty(), brute_force(run)
    assert found is not None
    sigma = np.sqrt(np.diag(expected.covariance))
    worst = np.abs((found.covariance - expected.covariance) / np.outer(sigma, sigma)).max()
    assert worst <= tolerance
    noise = np.abs(found.noise_covariance_px2 - expected.noise_covariance_px2).max()
    assert noise <= tolerance * np.trace(expected.noise_covariance_px2)
    assert found.degrees_of_freedom == pytest.approx(expected.degrees_of_freedom, rel=max(tolerance, 1e-7))


@settings(deadline=None, max_examples=60)
@given(
    st.integers(0, 2**32 - 1),
    st.lists(st.one_of(st.just(0.0), st.just(1.0), st.floats(0.6, 1.0)), min_size=5, max_size=40),
)
def test_covariance_equals_brute_force(seed: int, start: list[float]) -> None:
    # The last factors are not 0, so that residuals exist.
    assert_same(random_run(seed, [*start, 0.95, 0.8, 1.0, 0.9, 0.97]), 1e-8)


def test_covariance_equals_brute_force_to_1e_10() -> None:
    rng = np.random.default_rng(11)
    for seed in range(20):
        factors = rng.choice([0.0, 1.0, *rng.uniform(0.7, 1.0, 18)], 60).tolist()
        assert_same(random_run(seed, [*factors, *rng.uniform(0.8, 1.0, 12).tolist()]), 1e-10)


@pytest.mark.parametrize("count", [BLOCK - 1, BLOCK, BLOCK + 1, BLOCK + 2, BLOCK + 3, 2 * BLOCK - 3, 2 * BLOCK + 50])
@pytest.mark.parametrize("factor", [1.0, 0.99])
def test_summing_up_old_measurements_changes_nothing(count: int, factor: float) -> None:
    assert_same(random_run(7, [factor] * count), 1e-10)


def test_a_flush_just_before_and_after_summing_up() -> None:
    for last_zero in range(BLOCK - 6, BLOCK + 4):
        factors = [0.99] * (last_zero - 3) + [0.0] * 3 + [0.98] * 8
        assert_same(random_run(9, factors), 1e-10)


def test_reading_the_uncertainty_changes_no_digit() -> None:
    factors = [0.99] * 300
    read, unread = random_run(3, factors, read_every=1), random_run(3, factors)
    one, other = read.estimator.uncertainty(), unread.estimator.uncertainty()
    assert one is not None
    assert other is not None
    assert np.array_equal(one.covariance, other.covariance)
    assert one.degrees_of_freedom == other.degrees_of_freedom


def test_weights_by_hand() -> None:
    frames = WeightedFrames()
    for k, factor in enumerate([0.3, 0.5, 0.25, 0.5]):
        frames.append(factor, float(k), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, (0.0,) * 6)
    # Oldest first: (1·.5 + 1)·.25 + 1 = 1.375, halved; (1·.25 + 1)·.5 + 1; .5 + 1; 1.
    weights = np.array([0.6875, 1.625, 1.5, 1.0])
    totals = frames.totals((0.0,) * 6)
    assert totals.first[2, 2] == pytest.approx(weights.sum())
    assert totals.second[2, 2] == pytest.approx((weights**2).sum())
    assert totals.third[0, 2] == pytest.approx(weights**3 @ np.arange(4))


def test_nothing_is_claimed_before_residuals_exist() -> None:
    for count in range(4):
        assert random_run(1, [1.0] * count).estimator.uncertainty() is None
    assert random_run(1, [1.0] * 20 + [0.0]).estimator.uncertainty() is None
    # A fourth measurement with next to no weight leaves no residual to judge by.
    assert random_run(1, [1.0] * 20 + [0.0, 1e-12]).estimator.uncertainty() is None
    found = random_run(1, [1.0] * 4).estimator.uncertainty()
    assert found is not None
    assert found.degrees_of_freedom == pytest.approx(1.0, abs=1e-6)
    assert found.interval_factor() == math.inf


def test_degrees_of_freedom_count_frames_once_their_weights_are_equal() -> None:
    found = random_run(2, [1.0] * 3000).estimator.uncertainty()
    assert found is not None
    assert found.degrees_of_freedom == pytest.approx(3000 - 3, rel=2e-3)
    assert found.noise_covariance_px2[0, 0] == pytest.approx(0.01**2 + 0.004**2, rel=0.1)
    assert found.noise_covariance_px2[1, 1] == pytest.approx(0.02**2, rel=0.1)


def semicircle_run(rng: np.random.Generator, *, sigma_time_s: float, frames: int = 43) -> ProjectionRecursion:
    """Flush of three frames, then λ = 0.99, on a circle of 300 µm at 4° a frame and 30 Hz."""
    estimator = ProjectionRecursion(centre_um=CENTRE_UM, scale_um=SCALE_UM)
    offset = sigma_time_s * rng.standard_normal()
    turn = rng.uniform(0, 2 * math.pi) + np.radians(4.0) * np.arange(frames)
    speed = np.radians(4.0) * 30.0
    at = turn + speed * offset
    true_xy = np.array(CENTRE_UM) + 300.0 * np.column_stack([np.cos(at), np.sin(at)])
    read_xy = np.array(CENTRE_UM) + 300.0 * np.column_stack([np.cos(turn), np.sin(turn)])
    read_xy += 0.0175 * rng.standard_normal((frames, 2))
    uv = true_xy @ TRUTH[:, :2].T + TRUTH[:, 2] + 0.0095 * rng.standard_normal((frames, 2))
    for k in range(frames):
        estimator.update(
            x_um=float(read_xy[k, 0]),
            y_um=float(read_xy[k, 1]),
            u_px=float(uv[k, 0]),
            v_px=float(uv[k, 1]),
            forgetting=0.0 if k < 3 else 0.99,
            vx_um_s=-300.0 * speed * math.sin(turn[k]),
            vy_um_s=300.0 * speed * math.cos(turn[k]),
            sigma_time_s=sigma_time_s,
        )
    return estimator


@pytest.mark.parametrize("sigma_time_s", [0.0, 2e-4])
def test_95_percent_intervals_cover(sigma_time_s: float) -> None:
    rng = np.random.default_rng(20)
    inside = np.zeros(6)
    for _ in range(200):
        estimator = semicircle_run(rng, sigma_time_s=sigma_time_s)
        found = estimator.uncertainty()
        assert found is not None
        half_width = found.interval_factor() * np.sqrt(np.diag(found.covariance))
        inside += np.abs(np.array(estimator.projection) - TRUTH.ravel()) <= half_width
    assert np.all(inside >= 0.90 * 200), inside
    assert np.all(inside <= 0.99 * 200), inside


def test_the_time_offset_dominates_what_the_residuals_can_tell() -> None:
    """0.2 ms at 2.1 rad/s is a rotation by 0.024°, as in the linear part of the covariance."""
    still = semicircle_run(np.random.default_rng(21), sigma_time_s=0.0).uncertainty()
    offset = semicircle_run(np.random.default_rng(21), sigma_time_s=2e-4).uncertainty()
    assert still is not None
    assert offset is not None
    rotated = np.array([[0.0, -1.0], [1.0, 0.0]])
    change = TRUTH[:, :2] @ rotated * np.radians(4.0) * 30.0 * 2e-4
    pick = np.ix_([0, 1, 3, 4], [0, 1, 3, 4])
    added = (offset.covariance - still.covariance)[pick]
    assert np.allclose(added, np.outer(change.ravel(), change.ravel()), atol=0.05 * np.abs(added).max())
    assert offset.covariance[0, 0] > 4.0 * still.covariance[0, 0]


def drifting_circle(drift_um_s: tuple[float, float], *, sigma_drift_um_s: float, noise_px: float, seed: int):
    """One turn of 300 µm radius in 30 s over a sample that drifts; returns the true error and its covariance."""
    rng = np.random.default_rng(seed)
    truth = np.array([[0.2, 0.1, 5.0], [-0.1, 0.2, -7.0]])
    recursion = ProjectionRecursion(centre_um=(0.0, 0.0), scale_um=100.0, sigma_drift_um_s=sigma_drift_um_s)
    times_s = np.linspace(0.0, 30.0, 100)
    for t_s in times_s:
        turn = 2.0 * np.pi * t_s / 30.0
        x, y = 300.0 * np.cos(turn), 300.0 * np.sin(turn)
        age_s = times_s[-1] - t_s
        u, v = truth @ (x - drift_um_s[0] * age_s, y - drift_um_s[1] * age_s, 1.0) + rng.normal(0.0, noise_px, 2)
        recursion.update(x_um=x, y_um=y, u_px=u, v_px=v, forgetting=1.0, t_s=t_s)
    found = recursion.uncertainty()
    assert found is not None
    return np.array(recursion.projection) - truth.ravel(), found.covariance


def test_a_drift_without_noise_is_wholly_within_its_own_term() -> None:
    """Of a drift of 1 σ along X, the error lies in the direction and has the size that the covariance says."""
    sigma = 0.005
    error, covariance = drifting_circle((sigma, 0.0), sigma_drift_um_s=sigma, noise_px=1e-6, seed=1)
    _, without = drifting_circle((sigma, 0.0), sigma_drift_um_s=0.0, noise_px=1e-6, seed=1)
    drift_part = covariance - without
    assert np.linalg.matrix_rank(drift_part, tol=1e-9 * np.linalg.norm(drift_part)) == 2
    assert error @ np.linalg.pinv(drift_part, rcond=1e-9) @ error == pytest.approx(1.0, rel=1e-3)


def test_intervals_cover_the_truth_under_drift() -> None:
    """Without the drift's term, 95 % intervals of the linear part would cover far less."""
    rng = np.random.default_rng(5)
    covered = {0.005: 0, 0.0: 0}
    runs = 100
    for seed in range(runs):
        drift = tuple(rng.normal(0.0, 0.005, 2))
        for sigma in covered:
            error, covariance = drifting_circle(drift, sigma_drift_um_s=sigma, noise_px=0.01, seed=seed)
            covered[sigma] += abs(error[1]) <= 1.985 * np.sqrt(covariance[1, 1])
    assert 0.89 * runs <= covered[0.005] <= runs
    assert covered[0.0] < 0.8 * runs
