"""The recursion against eqs. (14)–(16) computed in batch, against eq. (17), and under bad conditions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.errors import DataError
from microdrivers.estimators.optics import ProjectionRecursion

CENTRE_UM = (5200.0, 7100.0)
SCALE_UM = 300.0
RIDGE = 1e-9
TRUTH = np.array([[0.17, 0.17, -2100.0], [0.17, -0.171, 330.0]])


def recursion(**changes: Any) -> ProjectionRecursion:
    return ProjectionRecursion(**{"centre_um": CENTRE_UM, "scale_um": SCALE_UM, "ridge": RIDGE} | changes)


def feed(estimator: ProjectionRecursion, frame: Sequence[float], forgetting: float) -> None:
    x, y, u, v = (float(value) for value in frame)
    estimator.update(x_um=x, y_um=y, u_px=u, v_px=v, forgetting=forgetting)


def scattered(rng: np.random.Generator, count: int, truth: np.ndarray = TRUTH, noise: float = 0.01) -> np.ndarray:
    """Frames (X, Y, u, v) spread over the travel."""
    xy = np.array(CENTRE_UM) + SCALE_UM * rng.uniform(-1, 1, (count, 2))
    uv = xy @ truth[:, :2].T + truth[:, 2] + noise * rng.standard_normal((count, 2))
    return np.hstack([xy, uv])


def normalised(frame: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """φᵀ (2 × 6) and y (2) of eq. (7) for one frame."""
    x, y = (frame[0] - CENTRE_UM[0]) / SCALE_UM, (frame[1] - CENTRE_UM[1]) / SCALE_UM
    return np.kron(np.eye(2), [x, y, 1.0]), np.array([frame[2], frame[3]])


def stacked(frames: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """φᵀ (6 × 6) and y (6) of eq. (8) at update k."""
    rows = [normalised(frames[j]) for j in range(max(0, k - 2), k + 1)]
    return np.vstack([row for row, _ in rows]), np.concatenate([y for _, y in rows])


def batch(frames: np.ndarray, forgetting: np.ndarray, priors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R and f of eqs. (15), (16) as sums over all updates."""
    R, f = np.zeros((6, 6)), np.zeros(6)
    for k in range(len(frames)):
        beta = np.prod(forgetting[k + 1 :])
        rows, y = stacked(frames, k)
        R += beta * (rows.T @ rows + RIDGE * np.eye(6))
        f += beta * (rows.T @ y + RIDGE * priors[k])
    return R, f


lambdas = st.one_of(st.just(0.0), st.just(1.0), st.floats(0.5, 1.0))


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.lists(lambdas, min_size=3, max_size=40), st.integers(0, 39))
def test_equals_batch_of_eq_14(seed: int, factors: list[float], switch_at: int) -> None:
    rng = np.random.default_rng(seed)
    frames = scattered(rng, len(factors))
    start = rng.normal(0, 50, 6)
    priors = np.tile(start, (len(factors), 1))
    estimator = recursion(prior=tuple(start))
    for k, factor in enumerate(factors):
        if k == switch_at:
            estimator.switch_prior()
            priors[k:] = estimator.theta
        feed(estimator, frames[k], factor)
    R, f = batch(frames, np.array(factors), priors)
    assert np.allclose(estimator.information, R[:3, :3], rtol=0, atol=1e-13 * np.abs(R).max())
    expected = np.linalg.solve(R, f)
    # Three random poses may nearly lie on a line: there no two ways of computing agree to the last digits.
    tolerance = max(1e-12, 4e-16 * np.linalg.cond(R))
    assert np.linalg.norm(np.array(estimator.theta) - expected) <= tolerance * np.linalg.norm(expected)


def test_equals_batch_to_1e_12_on_the_circle() -> None:
    rng = np.random.default_rng(1)
    turn = np.radians(4.0 * np.arange(90))
    xy = np.array(CENTRE_UM) + 300.0 * np.column_stack([np.cos(turn), np.sin(turn)])
    frames = np.hstack([xy, xy @ TRUTH[:, :2].T + TRUTH[:, 2] + 0.0095 * rng.standard_normal((90, 2))])
    factors = np.full(90, 0.99)
    factors[40:48] = 0.0
    estimator = recursion()
    for k in range(90):
        feed(estimator, frames[k], factors[k])
    expected = np.linalg.solve(*batch(frames, factors, np.zeros((90, 6))))
    assert np.linalg.norm(np.array(estimator.theta) - expected) <= 1e-12 * np.linalg.norm(expected)


def test_equals_the_corrected_innovation_form_of_eq_17_and_not_the_printed_one() -> None:
    rng = np.random.default_rng(2)
    frames = scattered(rng, 200)
    prior = rng.normal(0, 50, 6)
    estimator = recursion(prior=tuple(prior))
    R, f = np.zeros((6, 6)), np.zeros(6)
    theta = prior.copy()
    printed = prior.copy()
    for k, frame in enumerate(frames):
        factor = 0.97
        feed(estimator, frame, factor)
        rows, y = stacked(frames, k)
        R = factor * R + rows.T @ rows + RIDGE * np.eye(6)
        f = factor * f + rows.T @ y + RIDGE * prior
        theta = theta + np.linalg.solve(R, rows.T @ (y - rows @ theta) + RIDGE * (prior - theta))
        printed = printed + np.linalg.solve(R, f)
        if k > 20:
            assert np.linalg.norm(np.array(estimator.theta) - theta) <= 1e-12 * np.linalg.norm(theta)
    assert np.linalg.norm(printed) > 100.0 * np.linalg.norm(theta)


def test_three_updates_without_memory_leave_exactly_the_newest_three_frames() -> None:
    rng = np.random.default_rng(3)
    garbage = scattered(rng, 50, truth=-3.0 * TRUTH, noise=50.0)
    clean = np.array([[0.9, 0.1], [-0.4, 0.8], [-0.3, -0.9]]) * SCALE_UM + CENTRE_UM
    clean = np.hstack([clean, clean @ TRUTH[:, :2].T + TRUTH[:, 2]])
    fresh, used = recursion(), recursion()
    for frame in garbage:
        feed(used, frame, 1.0)
    for k, frame in enumerate(clean):
        assert not fresh.is_determined
        feed(used, frame, 0.0)
        feed(fresh, frame, 0.0)
        if k < 2:
            assert not np.allclose(used.projection, TRUTH.ravel(), rtol=0.05)
    assert used.theta == pytest.approx(fresh.theta, rel=1e-13)
    exact = np.linalg.solve(*stacked(clean, 2))
    assert np.allclose(used.theta, exact, rtol=0, atol=1e-7)
    assert np.allclose(used.projection[:2], TRUTH[0, :2], atol=1e-9)
    assert used.frames_used == 3
    assert used.is_determined


def test_frames_used_and_determined() -> None:
    frames = scattered(np.random.default_rng(4), 12)
    estimator = recursion()
    assert estimator.condition == math.inf
    counts = []
    for k, frame in enumerate(frames):
        feed(estimator, frame, 0.0 if k in (5, 6) else 0.99)
        counts.append(estimator.frames_used)
        assert estimator.is_determined == (k >= 2)
    assert counts == [1, 2, 3, 4, 5, 3, 3, 4, 5, 6, 7, 8]
    assert 1.0 <= estimator.condition < 1e3


def test_a_straight_path_does_not_determine_the_projection() -> None:
    estimator = recursion()
    rng = np.random.default_rng(5)
    for k in range(300):
        xy = np.array(CENTRE_UM) + [k - 150.0, 0.5 * (k - 150.0)] + 0.0175 * rng.standard_normal(2)
        feed(estimator, [*xy, *(TRUTH[:, :2] @ xy + TRUTH[:, 2])], 0.99)
    assert not estimator.is_determined
    assert estimator.condition > 1e6
    assert estimator.uncertainty() is None


def test_a_ridge_below_rounding_still_gives_finite_numbers() -> None:
    estimator = recursion(ridge=1e-30)
    rng = np.random.default_rng(9)
    for x in rng.uniform(-1, 1, 300).tolist():
        pose = (CENTRE_UM[0] + SCALE_UM * x, CENTRE_UM[1] + SCALE_UM * x)
        for _ in range(3):
            feed(estimator, [*pose, 70.0 * x, 30.0 * x], 0.9)
            assert all(map(math.isfinite, estimator.theta))
    assert not estimator.is_determined
    assert estimator.uncertainty() is None


def test_three_neighbouring_poses_of_the_headline_circle_determine_it() -> None:
    estimator = recursion()
    for k in range(3):
        turn = math.radians(30.0 + 4.0 * k)
        xy = np.array(CENTRE_UM) + 300.0 * np.array([math.cos(turn), math.sin(turn)])
        feed(estimator, [*xy, *(TRUTH[:, :2] @ xy + TRUTH[:, 2])], 0.0)
    assert estimator.is_determined
    assert np.allclose(estimator.projection[:2], TRUTH[0, :2], rtol=2e-3)


def test_stays_bounded_over_many_near_singular_updates() -> None:
    """Two regressors collinear to 1e-6, with steps in between that swing the weights."""
    estimator = recursion()
    rng = np.random.default_rng(6)
    positions = rng.uniform(-1, 1, 20_000)
    off_line = 1e-6 * rng.standard_normal(20_000)
    worst = 0.0
    for k, (x, off) in enumerate(zip(positions.tolist(), off_line.tolist(), strict=True)):
        estimator.update(
            x_um=CENTRE_UM[0] + SCALE_UM * x,
            y_um=CENTRE_UM[1] + SCALE_UM * (x + off),
            u_px=70.0 * x,
            v_px=-50.0 * x,
            forgetting=0.98 if k % 997 else 0.0,
        )
        worst = max(worst, *map(abs, estimator.theta))
        assert worst < 1e3
    assert estimator.theta[0] + estimator.theta[1] == pytest.approx(70.0, abs=1e-4)


def test_projection_and_prediction_are_in_stage_coordinates() -> None:
    estimator = recursion()
    for frame in scattered(np.random.default_rng(7), 30, noise=0.0):
        feed(estimator, frame, 0.99)
    assert np.allclose(np.array(estimator.projection).reshape(2, 3), TRUTH, rtol=1e-9)
    pose = np.array([5000.0, 7300.0])
    assert np.allclose(estimator.predict(*pose), TRUTH[:, :2] @ pose + TRUTH[:, 2], atol=1e-6)


def test_before_any_frame_the_estimate_is_the_prior_and_one_frame_keeps_close_to_it() -> None:
    prior = (73.0, 1.0, 5.0, 2.0, -73.0, 6.0)
    estimator = recursion(prior=prior)
    assert estimator.theta == prior
    assert estimator.predict(*CENTRE_UM) == (5.0, 6.0)
    estimator.update(x_um=CENTRE_UM[0], y_um=CENTRE_UM[1], u_px=8.0, v_px=9.0, forgetting=1.0)
    assert estimator.theta == pytest.approx((73.0, 1.0, 8.0, 2.0, -73.0, 9.0), abs=1e-6)


@pytest.mark.parametrize("forgetting", [-1e-9, 1.0 + 1e-9, math.nan, math.inf])
def test_refuses_a_forgetting_factor_outside_its_range(forgetting: float) -> None:
    with pytest.raises(ValueError, match="forgetting"):
        recursion().update(x_um=0.0, y_um=0.0, u_px=0.0, v_px=0.0, forgetting=forgetting)


@pytest.mark.parametrize("name", ["x_um", "y_um", "u_px", "v_px", "vx_um_s", "vy_um_s", "sigma_time_s"])
@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e300])
def test_refuses_bad_numbers_and_stays_as_it_was(name: str, bad: float) -> None:
    estimator, untouched = recursion(), recursion()
    for frame in scattered(np.random.default_rng(8), 10):
        feed(estimator, frame, 0.99)
        feed(untouched, frame, 0.99)
    good = {"x_um": 5000.0, "y_um": 7000.0, "u_px": 1.0, "v_px": 2.0, "vx_um_s": 1.0, "vy_um_s": 1.0}
    with pytest.raises(DataError, match="not finite"):
        estimator.update(**{**good, "sigma_time_s": 1.0, name: bad}, forgetting=0.99)
    for one in (estimator, untouched):
        feed(one, [5000.0, 7000.0, 3.0, 4.0], 0.99)
    assert estimator.theta == untouched.theta
    assert estimator.frames_used == untouched.frames_used


@pytest.mark.parametrize(
    "wrong",
    [
        {"scale_um": 0.0},
        {"scale_um": math.inf},
        {"ridge": 0.0},
        {"ridge": math.nan},
        {"centre_um": (math.nan, 0.0)},
        {"prior": (0.0,) * 5},
    ],
)
def test_refuses_a_meaningless_set_up(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        recursion(**wrong)
