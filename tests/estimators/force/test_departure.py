"""A force that leaves its baseline steeply, slowly, or not at all, at any noise."""

import numpy as np
import pytest

from microdrivers.estimators.force.departure import find_departure


def force(step_uN, slope_uN, sigma_uN, *, at=150, length=600, seed=0, drift_uN=0.0):
    """A baseline that drifts by so much a sample, from which a force rises."""
    i = np.arange(length)
    rising = np.where(i >= at, step_uN + slope_uN * (i - at), 0.0)
    return rising + drift_uN * i + sigma_uN * np.random.default_rng(seed).standard_normal(length)


@pytest.mark.parametrize("sigma_uN", [0.05, 1.0, 5.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_step_is_found_to_the_sample(sigma_uN, sign):
    assert find_departure(sign * force(135.0, 0.5, sigma_uN), sigma_uN) == (150, 150)


@pytest.mark.parametrize("slope_in_sigmas", [0.05, 0.2, 1.0])
@pytest.mark.parametrize("step_in_sigmas", [0.0, 3.0])
def test_a_slow_rise_lies_within_what_is_told_of_it(slope_in_sigmas, step_in_sigmas):
    outside = 0
    for seed in range(100):
        at = 60 + seed
        early, late = find_departure(force(3.0 * step_in_sigmas, 3.0 * slope_in_sigmas, 3.0, at=at, seed=seed), 3.0)
        outside += not early <= at <= late
    assert outside <= 3


def test_the_slower_it_rises_the_less_is_told():
    widths = [
        np.mean([late - early for early, late in (find_departure(force(0.0, s, 3.0, seed=n), 3.0) for n in range(20))])
        for s in (2.0, 0.5, 0.1)
    ]
    assert widths[0] < widths[1] < widths[2]


@pytest.mark.parametrize("seed", range(20))
def test_noise_leaves_no_baseline(seed):
    assert find_departure(force(0.0, 0.0, 3.0, seed=seed), 3.0) is None


def test_a_slow_drift_of_a_quiet_sensor_leaves_no_baseline():
    assert find_departure(force(0.0, 0.0, 0.05, drift_uN=0.05 / 30.0), 0.05) is None


@pytest.mark.parametrize("length", range(9, 20))
def test_a_slow_rise_in_a_few_samples_is_no_error(length):
    assert find_departure(force(0.0, 4.8, 0.0, at=0, length=length), 3.0) is None


@pytest.mark.parametrize("seed", range(20))
def test_a_slow_rise_is_not_passed_over_for_the_step_at_the_reversal(seed):
    """A rise of a tenth of the noise a sample drags a short baseline along until it turns."""
    rise = force(5.0, 0.1, 1.0, at=60, length=1600, seed=seed)
    rise[1200:] -= 20.0
    early, late = find_departure(rise, 1.0)
    assert early <= 60 + 2
    assert 60 - 2 <= late < 80
