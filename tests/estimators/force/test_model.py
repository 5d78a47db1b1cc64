import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.estimators.force.model import (
    SpecimenModel,
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
