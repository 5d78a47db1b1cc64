"""What a slow sensor shifts, by simulated records whose force is late."""

import dataclasses

import numpy as np
import pytest

from microdrivers.estimators.force.identify import identify
from microdrivers.estimators.force.record import IndentationRecord
from microdrivers.routines.force.sensor_lag import beyond_intervals, lag_biases, lag_s
from tests.routines.indentation_source import result_of

K1, K2, B = 4.5, 1e-4, 20.0
SPEED_UM_S, DEPTH_UM, RATE_HZ, CONTACT_S = 5.0, 80.0, 30.0, 3.0


def record(late_s, *, seed=0):
    """A specimen that is pressed and let go of; its force comes later."""
    turn_s = CONTACT_S + DEPTH_UM / SPEED_UM_S
    rng = np.random.default_rng(seed)

    def push_um(t):
        return SPEED_UM_S * np.where(t < turn_s, t - CONTACT_S, 2.0 * turn_s - CONTACT_S - t)

    def force_uN(t):
        x = push_um(t)
        v = np.where(t < turn_s, SPEED_UM_S, -SPEED_UM_S)
        return np.where(x > 0.0, np.maximum(K1 * x + K2 * x**3 + B * v, 0.0), 0.0)

    # Until the damper has pulled the tip free: the specimen comes back as fast as the tip goes.
    t = np.arange(0.0, 2.0 * turn_s, 1.0 / RATE_HZ)
    seen = np.maximum(push_um(t), 0.0) + 0.03 * rng.standard_normal(len(t))
    felt = force_uN(t - late_s) + 0.1 * rng.standard_normal(len(t))
    return IndentationRecord(t, seen, felt, 0.03, 0.1)


def test_a_first_order_sensor_is_late_by_its_time_constant():
    assert lag_s(5.0) == pytest.approx(0.0318, rel=1e-2)


@pytest.mark.parametrize("name", ["single", "loading"])
def test_the_bias_is_that_of_records_whose_force_is_late(name):
    late_s = 0.02
    prompt, late = (identify(record(each_s)).protocols[name] for each_s in (0.0, late_s))
    told = lag_biases(late, late_s, speed_um_s=SPEED_UM_S)
    assert late.b_loading_uN_s_per_um - prompt.b_loading_uN_s_per_um == pytest.approx(told["b"], rel=0.25)
    assert told["b"] == pytest.approx(-late_s * K1, rel=0.2)


def test_what_lies_within_the_intervals_is_not_named():
    covariance = np.diag([1.0, 1.0, 1.0])
    assert beyond_intervals({"k1": 1.9, "k2": -2.0, "b": 2.0}, covariance) == {"k2": -2.0, "b": 2.0}
    assert beyond_intervals({"k1": 9.0, "k2": 9.0, "b": 9.0}, np.full((3, 3), np.nan)) == {}


def test_what_a_slow_sensor_shifts_is_in_brackets(characterised):
    _, run, result, _ = characterised
    assert result.protocols["single"].identifiable.b
    fast, slow = (
        result_of(run._replace(setup=run.setup._replace(bandwidth_hz=hz))).protocols["single"].identifiable
        for hz in (5000.0, 1.0)
    )
    assert (fast.k1, fast.b) == (True, True)
    assert (slow.k1, slow.k2, slow.b) == (False, False, False)
    shallow = {name: dataclasses.replace(fit, deepest_um=0.0) for name, fit in run.identification.protocols.items()}
    unpressed = dataclasses.replace(run.identification, protocols=shallow)
    setup = run.setup._replace(bandwidth_hz=1.0)
    assert result_of(run._replace(identification=unpressed, setup=setup)).protocols["single"].identifiable.b
    assert slow.reasons["b"].startswith("with its bandwidth of 1 Hz the sensor is 1.6e+02 ms late, which shifts ")
