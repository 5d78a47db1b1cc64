"""Velocities on line: right on either side of a corner, deaf to spikes, and the same however they are asked for."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.errors import OutOfRange
from microdrivers.estimators.force.line_fit import Point, broken_line_gains, fit, shape_gain
from microdrivers.estimators.force.local_motion import InstantMotion, LocalMotion, MotionSettings

Array = npt.NDArray[np.float64]

RATE_HZ = 30.0
SHORT = MotionSettings(lag=5, window=20)


def told(motion: LocalMotion, t_s: Array, x_um: Array, *, sigma_um: float = 0.06) -> list[InstantMotion]:
    found = []
    for t, x in zip(t_s.tolist(), x_um.tolist(), strict=True):
        found += motion.update(round(1e9 * t), x, sigma_um)
    return found


def legs(times_s: Sequence[float], speeds_um_s: Sequence[float], end_s: float) -> tuple[Array, Array, Array]:
    """Instants, positions and velocities of a motion that changes its speed at `times_s`."""
    t = np.arange(0.0, end_s, 1.0 / RATE_HZ)
    knots = np.array([0.0, *times_s, 1e6])
    along = np.concatenate([[0.0], np.cumsum(np.diff(knots) * speeds_um_s)])
    return t, np.interp(t, knots, along), np.array(speeds_um_s)[np.searchsorted(times_s, t, side="right")]


@pytest.mark.parametrize("chosen", [MotionSettings(), SHORT])
def test_there_is_one_motion_for_each_position_in_order_and_after_the_lag(chosen: MotionSettings) -> None:
    motion = LocalMotion(chosen)
    found = []
    for k in range(100):
        new = motion.update(k * 33_000_000, 5.0 * 0.033 * k, 0.06)
        assert len(new) == (1 if k >= chosen.lag else 0)
        found += new
    found += motion.tell_now()
    assert [m.t_ns for m in found] == [k * 33_000_000 for k in range(100)]
    assert all(m.velocity_um_s == pytest.approx(5.0, rel=1e-9) for m in found)
    assert motion.tell_now() == []


@settings(deadline=None, max_examples=12)
@given(st.integers(0, 2**32 - 1), st.floats(5.0, 15.0), st.floats(0.0, 1.0), st.sampled_from([MotionSettings(), SHORT]))
def test_reversal_and_stop_are_not_smeared(seed: int, speed: float, phase: float, chosen: MotionSettings) -> None:
    rng = np.random.default_rng(seed)
    corners = (2.0 + phase / RATE_HZ, 4.0 + phase / RATE_HZ, 6.0 + phase / RATE_HZ)
    t, x, v = legs(corners, (0.0, speed, -speed, 0.0), 8.0)
    found = told(LocalMotion(chosen), t, x + 0.06 * rng.standard_normal(len(t)))
    error = np.array([m.velocity_um_s for m in found]) - v[: len(found)]
    # A position at the corner itself may be put on the wrong side of it.
    from_corner_s = np.abs(np.subtract.outer(t[: len(found)], corners)).min(axis=1)
    away, far = from_corner_s > 2.5 / RATE_HZ, from_corner_s > 9.5 / RATE_HZ
    sigmas = np.array([m.velocity_sigma_um_s for m in found])
    assert np.all(np.abs(error[away]) <= 6.0 * sigmas[away] + 0.15 * speed)
    assert np.sum(np.abs(error) > 0.5 * speed) <= 4
    assert np.all(np.abs(error[far]) <= 6.0 * sigmas[far])


def test_sigma_of_the_velocity_is_honest() -> None:
    rng = np.random.default_rng(3)
    scaled = []
    for _ in range(15):
        t, x, v = legs((2.0,), (0.0, 5.0), 5.0)
        found = told(LocalMotion(), t, x + 0.06 * rng.standard_normal(len(t)), sigma_um=0.05)[20:]
        scaled += [
            (m.velocity_um_s - v[20 + k]) / m.velocity_sigma_um_s for k, m in enumerate(found) if m.clearance > 3
        ]
    assert np.sqrt(np.mean(np.square(scaled))) == pytest.approx(1.0, abs=0.15)


def test_instant_of_a_start_is_found_within_a_frame() -> None:
    rng = np.random.default_rng(6)
    errors = []
    for _ in range(20):
        start_s = 2.0 + rng.uniform(0.0, 1.0 / RATE_HZ)
        t, x, _ = legs((start_s,), (0.0, 5.0), 3.5)
        found = told(LocalMotion(SHORT), t, x + 0.06 * rng.standard_normal(len(t)))
        assert found[-1].after_corner
        errors.append(found[-1].begin_ns / 1e9 - start_s)
    assert np.sqrt(np.mean(np.square(errors))) < 0.8 / RATE_HZ


def test_noise_alone_makes_no_corner() -> None:
    rng = np.random.default_rng(2)
    t = np.arange(4000) / RATE_HZ
    found = told(LocalMotion(SHORT), t, 0.06 * rng.standard_normal(4000))
    assert sum(m.after_corner for m in found) == 0


def test_motion_that_gathers_speed_has_no_corners_however_quiet() -> None:
    t = np.arange(200) / RATE_HZ
    found = told(LocalMotion(), t, 3.0 * t + 0.5 * t * t, sigma_um=0.001)
    assert not any(m.after_corner for m in found)
    # Once the window is full, the velocity is that of its own instant.
    assert all(m.velocity_um_s == pytest.approx(3.0 + m.t_ns / 1e9, rel=1e-6) for m in found[9:])


def test_positions_of_unknown_noise_tell_velocities_once_it_is_seen() -> None:
    rng = np.random.default_rng(5)
    t, x, v = legs((2.0,), (5.0, -5.0), 4.0)
    found = told(LocalMotion(), t, x + 0.02 * rng.standard_normal(len(t)), sigma_um=math.nan)
    assert all(math.isnan(m.velocity_sigma_um_s) == (k < 9) for k, m in enumerate(found))
    assert all(abs(m.velocity_um_s - v[k]) < 0.3 for k, m in enumerate(found) if m.clearance >= 2)


def test_spikes_are_told_and_used_by_no_fit() -> None:
    t, x, _ = legs((1.5,), (5.0, -5.0), 3.0)
    spoilt = x.copy()
    spoilt[[20, 33, 70]] += (4.0, -1.0, 0.8)
    found = told(LocalMotion(), t, spoilt)
    assert [k for k, m in enumerate(found) if m.spike] == [20, 33, 70]
    assert found[20].position_um == pytest.approx(x[20], abs=0.01)
    assert all(abs(abs(m.velocity_um_s) - 5.0) < 0.2 for m in found if m.clearance >= 2)
    # The peak of a quick reversal sticks out too, but is none.
    t, x, _ = legs((1.5,), (60.0, -60.0), 3.0)
    assert not any(m.spike for m in told(LocalMotion(), t, x))


def test_jump_is_no_motion() -> None:
    t, x, _ = legs((), (0.0,), 4.0)
    rng = np.random.default_rng(1)
    found = told(LocalMotion(), t, x + np.where(t > 2.0, 5.0, 0.0) + 0.02 * rng.standard_normal(len(t)), sigma_um=0.02)
    assert max(abs(m.velocity_um_s) for m in found) < 0.5
    assert not any(m.after_corner for m in found)


def test_nothing_is_fitted_across_a_gap() -> None:
    t, x, _ = legs((), (5.0,), 4.0)
    kept = (t < 1.0) | (t > 1.3)
    moved = np.where(t > 1.3, x + 0.1, x)
    found = told(LocalMotion(), t[kept], moved[kept])
    assert all(m.velocity_um_s == pytest.approx(5.0, rel=1e-6) for m in found)
    assert {m.begin_ns for m in found} == {0, round(1e9 * t[kept][t[kept] > 1.3][0])}


def test_a_single_position_tells_no_velocity() -> None:
    motion = LocalMotion()
    motion.update(0, 3.0, 0.06)
    (only,) = motion.tell_now()
    assert (only.position_um, only.velocity_um_s, only.velocity_sigma_um_s) == (3.0, 0.0, math.inf)


def test_parabola_tells_the_acceleration() -> None:
    t = np.arange(60) / RATE_HZ
    found = told(LocalMotion(MotionSettings(with_acceleration=True)), t, 1.0 + 3.0 * t + 2.0 * t * t)
    assert all(m.acceleration_um_s2 == pytest.approx(4.0, rel=1e-6) for m in found)
    assert all(m.velocity_um_s == pytest.approx(3.0 + 4.0 * m.t_ns / 1e9, rel=1e-6) for m in found)


@pytest.mark.parametrize(("lag", "window"), [(3, 20), (9, 9)])
def test_settings_that_cannot_work_are_refused(lag: int, window: int) -> None:
    with pytest.raises(OutOfRange, match="lag"):
        LocalMotion(MotionSettings(lag=lag, window=window))


@pytest.mark.parametrize(("at", "known"), [(60.0, False), (60.05, False), (60.5, True)])
def test_a_position_at_a_corner_may_be_of_either_speed(at: float, known: bool) -> None:
    t, x, _ = legs((at / RATE_HZ,), (5.0, -5.0), 4.0)
    found = told(LocalMotion(SHORT), t, x + 0.02 * np.random.default_rng(3).standard_normal(len(t)), sigma_um=0.02)
    near = [k for k, motion in enumerate(found) if motion.corner_um_s > 0.0]
    assert near == ([] if known else [60])
    assert all(found[k].corner_um_s == pytest.approx(10.0, abs=2.0) for k in near)


def test_what_changes_within_the_window_shows_beyond_noise_alone() -> None:
    rng = np.random.default_rng(4)
    t = np.arange(0.0, 20.0, 1.0 / RATE_HZ)
    asked = SHORT._replace(with_lateness=True)
    noise = 0.02 * rng.standard_normal(len(t))
    steady = told(LocalMotion(asked), t, 5.0 * t + noise, sigma_um=0.02)
    assert np.mean([m.late_um_s > 0.0 for m in steady]) < 0.02
    quickens = told(LocalMotion(asked), t, 5.0 * t + 1.5 * t * t + noise, sigma_um=0.02)
    late = np.array([m.late_um_s for m in quickens[30:]])
    assert np.median(late) == pytest.approx(3.0 * 5.0 / RATE_HZ, rel=0.2)
    assert not any(m.late_um_s for m in told(LocalMotion(SHORT), t, 5.0 * t + 1.5 * t * t + noise, sigma_um=0.02))


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(5, 25), st.booleans())
def test_fit_and_gains_equal_least_squares(seed: int, count: int, parabola: bool) -> None:
    rng = np.random.default_rng(seed)
    t, x = 1e3 + np.sort(rng.uniform(0.0, 1.0, count)), rng.normal(0.0, 1.0, count)
    points = [Point(*row) for row in zip(t.tolist(), x.tolist(), strict=True)]
    powers = np.vander(t - 1e3, 3 if parabola else 2, increasing=True)

    def left(columns: Array) -> tuple[Array, float]:
        theta = np.linalg.lstsq(columns, x, rcond=None)[0]
        return theta, float(np.sum((x - columns @ theta) ** 2))

    theta, rest = left(powers)
    line = fit(points, parabola=parabola)
    assert line.left_um2 == pytest.approx(rest, rel=1e-6, abs=1e-9)
    assert line.position_um(1e3 + 0.3) == pytest.approx(np.polyval(theta[::-1], 0.3), rel=1e-6, abs=1e-6)
    assert line.velocity_um_s(1e3 + 0.3) == pytest.approx(np.polyval(np.polyder(theta[::-1]), 0.3), rel=1e-5, abs=1e-5)
    newest, oldest = count - 2, 2
    gains = broken_line_gains(points, line, newest=newest, oldest=oldest)
    for j, gain in zip(range(newest, oldest - 1, -1), gains, strict=True):
        hinge = np.maximum(t - t[j], 0.0)
        _, broken = left(np.column_stack([powers, hinge]))
        assert gain == pytest.approx(rest - broken, rel=1e-4, abs=1e-7)
        assert shape_gain(points, line, hinge.tolist()) == pytest.approx(gain, rel=1e-4, abs=1e-7)
