import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from microdrivers.estimators.force.trajectory import KNOT_SPACINGS_S, RAMP, spline, trajectory


@given(st.integers(12, 200), st.integers(1, 8))
def test_splines_hold_cubic_polynomials_and_their_derivatives(samples, pieces):
    t = np.linspace(2.0, 9.0, samples)
    value, rate, curve = spline(t, np.linspace(2.0, 9.0, pieces + 1))
    assert np.allclose(value.sum(axis=1), 1.0)
    if samples >= pieces + 3:
        eta = np.linalg.lstsq(value, t**3 - 4.0 * t, rcond=None)[0]
        assert np.allclose(value @ eta, t**3 - 4.0 * t)
        assert np.allclose(rate @ eta, 3.0 * t**2 - 4.0)
        assert np.allclose(curve @ eta, 6.0 * t)


@pytest.mark.parametrize("samples", [1, 2, 4, 9])
def test_a_few_samples_get_a_polynomial(samples):
    t = np.linspace(0.0, 1.0, samples)
    value, rate, _ = spline(t, np.linspace(0.0, 1.0, 4))
    assert value.shape == rate.shape
    assert value.shape[1] <= 3
    eta = np.linalg.lstsq(value, 3.0 * t + 1.0, rcond=None)[0]
    assert np.allclose(rate @ eta, 3.0 if samples > 1 else 0.0)


def two_branches(spacing_s, yields=0.0):
    t = np.arange(600) / 30.0
    branch = (t >= 10.0).astype(np.int64)
    force = np.where(branch == 0, 20.0 * t, 200.0 - 30.0 * (t - 10.0)) + np.sin(t)
    way = np.where(branch == 0, 5.0 * t, 50.0 - 7.0 * (t - 10.0)) - yields * force
    return trajectory(t, force, branch, spacing_s=spacing_s, depth_um=50.0, force_sigma_uN=0.05), way, branch, t


@pytest.mark.parametrize("spacing_s", KNOT_SPACINGS_S)
def test_no_family_smears_the_reversal(spacing_s):
    family, way, branch, _ = two_branches(spacing_s)
    eta = np.linalg.lstsq(family.value, way, rcond=None)[0]
    assert np.allclose(family.rate @ eta, np.where(branch == 0, 5.0, -7.0), atol=1e-6)


def test_ramps_bend_with_the_force_that_the_sensor_yields_to():
    family, way, branch, t = two_branches(RAMP, yields=0.01)
    assert family.compliance is not None
    eta = np.linalg.lstsq(family.value, way, rcond=None)[0]
    assert eta[family.compliance] == pytest.approx(0.01, rel=1e-3)
    expected = np.where(branch == 0, 5.0 - 0.2, -7.0 + 0.3) - 0.01 * np.cos(t)
    assert np.allclose(family.rate @ eta, expected, atol=1e-3)


@pytest.mark.parametrize("spacing_s", KNOT_SPACINGS_S)
def test_blocks_hold_all_that_is_not_zero(spacing_s):
    family, *_ = two_branches(spacing_s)
    outside = np.ones(family.value.shape, dtype=bool)
    for rows, columns in family.blocks:
        outside[rows, columns] = False
    for part in (family.value, family.rate, family.acceleration):
        assert not part[outside].any()
