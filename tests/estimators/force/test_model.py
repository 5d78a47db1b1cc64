import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.errors import OutOfRange
from microdrivers.estimators.force.model import (
    SpecimenModel,
    check_model,
    force_uN,
    slip_speed_um_s,
    slipped_um,
    stiffness_uN_per_um,
)

MODEL = SpecimenModel(4.5, 1e-4, 27.0, 13.0, slip_um=25.0, slip_rate_per_s=0.1)


def test_force_is_eq_21_with_the_damper_of_the_direction():
    loading, unloading = force_uN(MODEL._replace(m_kg=0.5), 50.0, [5.0, -5.0], 2.0)
    springs = 4.5 * 50.0 + 1e-4 * 50.0**3
    assert loading == 1.0 + 27.0 * 5.0 + springs
    assert unloading == 1.0 - 13.0 * 5.0 + springs


@given(st.floats(-50.0, 200.0), st.floats(-50.0, 50.0))
@settings(max_examples=60)
def test_without_adhesion_the_specimen_only_pushes_and_only_where_it_is_touched(x, v):
    force = float(force_uN(MODEL, x, v))
    free = float(force_uN(MODEL, x, v, adhesion=True))
    assert force >= 0.0
    assert force == (max(free, 0.0) if x > 0.0 else 0.0)


def test_a_deformation_that_was_not_seen_has_no_force():
    assert math.isnan(force_uN(MODEL, math.nan, 5.0))
    assert math.isnan(force_uN(MODEL, 5.0, math.nan))


def test_slip_is_eq_26_and_its_speed_is_the_derivative():
    t = np.array([-1.0, 0.0, 1e-3, 5.0, 40.0])
    assert np.allclose(slipped_um(MODEL, t), 25.0 * (1.0 - np.exp(-0.1 * np.maximum(t, 0.0))))
    step = 1e-6
    numeric = (slipped_um(MODEL, t[2:] + step) - slipped_um(MODEL, t[2:] - step)) / (2.0 * step)
    assert np.allclose(slip_speed_um_s(MODEL, t[2:]), numeric, rtol=1e-6)
    assert slip_speed_um_s(MODEL, -1.0) == 0.0


def test_stiffness_is_the_slope_of_the_springs():
    x, step = np.array([0.5, 30.0, 120.0]), 1e-4
    numeric = (force_uN(MODEL, x + step, 0.0) - force_uN(MODEL, x - step, 0.0)) / (2.0 * step)
    assert np.allclose(stiffness_uN_per_um(MODEL, x), numeric, rtol=1e-7)


def test_a_model_may_have_a_negative_damper_no_covariance_and_no_limits():
    check_model(MODEL)
    check_model(MODEL._replace(b_loading_uN_s_per_um=-1.0, covariance=(1.0,) * 9, deepest_um=np.float32(100.0)))
    check_model(MODEL._replace(slip_um=0.0, slip_rate_per_s=0.0, fastest_unloading_um_s=0.0))


@pytest.mark.parametrize("name", [name for name in SpecimenModel._fields if name != "covariance"])
@pytest.mark.parametrize("value", [math.nan, -math.inf, None, "4.5"])
def test_a_model_with_a_number_that_is_none_is_refused(name, value):
    with pytest.raises(OutOfRange, match=f"{name} is {value}") as caught:
        check_model(MODEL._replace(**{name: value}))
    assert caught.value.remedy


@pytest.mark.parametrize(
    "change",
    [
        {"deepest_um": 0.0},
        {"fastest_um_s": 0.0},
        {"fastest_unloading_um_s": -1.0},
        {"residual_uN": -1.0},
        {"slip_rate_per_s": 0.0},
        {"slip_rate_per_s": -0.1},
        {"covariance": (1.0, 2.0)},
        {"covariance": np.eye(3)},
        {"covariance": np.eye(3).ravel()},
        {"covariance": None},
        {"covariance": ("1.0",) * 9},
        {"covariance": (math.nan,) * 9},
    ],
)
def test_a_model_out_of_range_is_refused(change):
    with pytest.raises(OutOfRange, match=next(iter(change)).split("_")[0]):
        check_model(MODEL._replace(**change))
