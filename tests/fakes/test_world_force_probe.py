"""What the emulated force probe gives out: its noise has the density, band and memory that it states."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from microdrivers.core.units import NS_PER_S
from microdrivers.fakes.world.force_probe import ForceProbe

DENSITY, BANDWIDTH_HZ = 0.07, 30.0


def probe(**changes: Any) -> ForceProbe:
    """One that shows µN as V, without limits, so that its output is the force."""
    settings: dict[str, Any] = {
        "force_uN": lambda t_ns: 0.0,
        "zero_V": 0.0,
        "sensitivity_uN_per_V": 1.0,
        "output_V": (-math.inf, math.inf),
        "noise_uN_per_sqrt_Hz": 0.0,
        "bandwidth_hz": BANDWIDTH_HZ,
        "drift_uN_per_min": 0.0,
        "zero_spread_uN": 0.0,
        "seed": 1,
        "start_ns": 0,
    }
    return ForceProbe(**(settings | changes))


def readings(rate_hz: float, count: int, **changes: Any) -> np.ndarray:
    one = probe(noise_uN_per_sqrt_Hz=DENSITY, **changes)
    return np.array([one.voltage_at(round(n * NS_PER_S / rate_hz)) for n in range(count)])


def test_the_standard_deviation_is_density_times_root_of_bandwidth() -> None:
    seen = readings(30.0, 10_000)
    assert seen.std() == pytest.approx(DENSITY * math.sqrt(BANDWIDTH_HZ), rel=0.03)
    assert seen.mean() == pytest.approx(0.0, abs=0.02)


def test_readings_within_the_band_are_alike() -> None:
    seen = readings(1000.0, 30_000)
    for lag in (1, 5, 10):
        alike = float(np.mean(seen[lag:] * seen[:-lag]) / np.mean(seen**2))
        assert alike == pytest.approx(math.exp(-4.0 * BANDWIDTH_HZ * lag / 1000.0), abs=0.06)


def test_the_density_below_the_band_is_the_stated_one() -> None:
    """The mean over a time T of white noise with a one-sided density d scatters by d/√(2 T)."""
    means = readings(200.0, 60_000).reshape(-1, 200).mean(axis=1)
    assert means.std() == pytest.approx(DENSITY / math.sqrt(2.0), rel=0.15)


def test_the_noise_does_not_depend_on_how_often_it_is_read() -> None:
    assert readings(10_000.0, 20_000).std() == pytest.approx(readings(100.0, 5000).std(), rel=0.2)


def test_force_and_sensitivity_make_the_voltage() -> None:
    one = probe(force_uN=lambda t_ns: 40.0, zero_V=2.5, sensitivity_uN_per_V=50.0, output_V=(0.0, 5.0))
    assert one.voltage_at(0) == pytest.approx(3.3)
    other = probe(force_uN=lambda t_ns: 40.0, zero_V=2.5, sensitivity_uN_per_V=-50.0, output_V=(0.0, 5.0))
    assert other.voltage_at(0) == pytest.approx(1.7)


@pytest.mark.parametrize(("force_uN", "volts"), [(1e3, 5.0), (-1e3, 1.0)])
def test_the_output_ends_at_its_limits(force_uN: float, volts: float) -> None:
    one = probe(force_uN=lambda t_ns: force_uN, zero_V=2.5, sensitivity_uN_per_V=50.0, output_V=(1.0, 5.0))
    assert one.voltage_at(0) == volts


def test_drift_is_steady_and_its_rate_is_drawn() -> None:
    drifts = [probe(drift_uN_per_min=0.1, seed=seed) for seed in range(40)]
    rates = np.array([one.voltage_at(60 * NS_PER_S) for one in drifts])
    assert rates == pytest.approx([one.drift_uN_per_min for one in drifts])
    assert np.all((np.abs(rates) >= 0.05) & (np.abs(rates) <= 0.15))
    assert {-1.0, 1.0} == set(np.sign(rates))
    assert drifts[0].voltage_at(120 * NS_PER_S) == pytest.approx(2 * rates[0])


def test_the_power_on_zero_is_drawn_and_stays() -> None:
    zeros = np.array([probe(zero_spread_uN=5.0, seed=seed).voltage_at(0) for seed in range(400)])
    assert zeros.std() == pytest.approx(5.0, rel=0.15)
    one = probe(zero_spread_uN=5.0)
    assert one.voltage_at(0) == one.voltage_at(NS_PER_S) == one.power_on_uN != 0.0


def test_a_seed_repeats_everything() -> None:
    everything = {"drift_uN_per_min": 0.1, "zero_spread_uN": 5.0}
    assert np.array_equal(readings(30.0, 50, **everything), readings(30.0, 50, **everything))
    assert not np.array_equal(readings(30.0, 50, **everything), readings(30.0, 50, seed=2, **everything))
