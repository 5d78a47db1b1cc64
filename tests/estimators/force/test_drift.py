"""A drift that both ends of a record agree on, and what is none."""

import numpy as np
import pytest

from microdrivers.estimators.force.drift import line_through, straight_drift

TIME_S = np.arange(1800) / 30.0


def pressed(*, begin_s=3.0, turn_s=30.0, end_s=55.0, step_uN=0.0, slope_uN_s=8.0):
    """Rises from `begin_s` on, steeply if there is a step, and falls to zero again until `end_s`."""
    top = step_uN + slope_uN_s * (turn_s - begin_s)
    rising = np.where(begin_s < TIME_S, step_uN + slope_uN_s * (TIME_S - begin_s), 0.0)
    falling = np.where(end_s > TIME_S, top * (end_s - TIME_S) / (end_s - turn_s), 0.0)
    return np.where(turn_s > TIME_S, rising, falling)


def noisy(force_uN, sigma_uN=1.5, seed=0):
    return force_uN + sigma_uN * np.random.default_rng(seed).standard_normal(len(force_uN))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("step_uN", [0.0, 50.0])
@pytest.mark.parametrize("rate_uN_s", [-1.0, 1.0, 3.0])
def test_a_drift_is_found_however_fast_it_is(rate_uN_s, step_uN, seed):
    found = straight_drift(TIME_S, noisy(pressed(step_uN=step_uN) + rate_uN_s * TIME_S + 5.0, seed=seed), 1.5)
    assert abs(found.slope_uN_s - rate_uN_s) < 4.0 * found.sigma_slope_uN_s < 0.1
    middle_uN = found.at(np.array([found.middle_s]))
    assert abs(middle_uN - rate_uN_s * found.middle_s - 5.0) < 4.0 * found.sigma_level_uN


@pytest.mark.parametrize("seed", range(10))
def test_noise_is_no_drift(seed):
    assert straight_drift(TIME_S, noisy(pressed(), seed=seed), 1.5) is None


@pytest.mark.parametrize(
    "force_uN",
    [
        pressed(begin_s=-5.0),
        pressed(end_s=80.0),
        pressed(begin_s=-5.0, end_s=80.0),
        pressed() + 30.0 * np.sin(np.pi * TIME_S / 60.0),
        pressed(end_s=59.9) + TIME_S,
        8.0 * TIME_S,
    ],
    ids=["begins in contact", "ends in contact", "both", "curved", "too short an end", "nothing but a line"],
)
def test_ends_that_lie_on_no_common_line_are_no_drift(force_uN):
    assert straight_drift(TIME_S, noisy(force_uN), 1.5) is None


@pytest.mark.parametrize("seed", range(10))
def test_ends_too_short_to_slope_by_themselves_are_no_drift(seed):
    """Any two levels lie on some line: here the rest before the contact, and the second after a soft press turned."""
    force_uN = pressed(begin_s=1.0, turn_s=59.0, end_s=117.0, step_uN=10.0, slope_uN_s=0.8)
    force_uN[TIME_S >= 59.0] -= 10.0
    assert straight_drift(TIME_S, noisy(force_uN, seed=seed), 1.5) is None


def test_the_line_and_its_deviations_are_those_of_least_squares():
    t, force = TIME_S[:90], noisy(2.0 + 0.5 * TIME_S[:90])
    (slope, level), covariance = np.polyfit(t - t.mean(), force, 1, cov="unscaled")
    line = line_through(t, force, 1.5)
    assert line[1:4:2] == pytest.approx((level, slope))
    assert line[2::2] == pytest.approx(1.5 * np.sqrt(np.diag(covariance)[::-1]))
