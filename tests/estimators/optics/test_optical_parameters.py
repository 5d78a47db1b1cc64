"""Scale, angle, view, translation and tilt recovered from projections built out of them."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.errors import DataError, IllConditioned
from microdrivers.estimators.optics import OpticalParameters, optical_parameters, wrap_deg

scales = st.floats(0.01, 20.0)
angles = st.floats(-180.0, 180.0)
tilts = st.floats(0.0, 60.0)
EXACT = np.zeros((6, 6))


def Rx(deg: float) -> np.ndarray:
    c, s = math.cos(math.radians(deg)), math.sin(math.radians(deg))
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def Ry(deg: float) -> np.ndarray:
    c, s = math.cos(math.radians(deg)), math.sin(math.radians(deg))
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def Rz(deg: float) -> np.ndarray:
    c, s = math.cos(math.radians(deg)), math.sin(math.radians(deg))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def tilted(tilt_deg: float, axis_deg: float) -> np.ndarray:
    """Rotation about an axis in the image plane."""
    return Rz(axis_deg) @ Rx(tilt_deg) @ Rz(-axis_deg)


def projection(A: np.ndarray, t: tuple[float, float] = (0.0, 0.0)) -> list[float]:
    return [A[0, 0], A[0, 1], t[0], A[1, 0], A[1, 1], t[1]]


def angle_between(one_deg: float, other_deg: float) -> float:
    return abs(wrap_deg(one_deg - other_deg))


@settings(deadline=None, max_examples=200)
@given(scales, angles, tilts, angles, st.booleans())
def test_recovers_scale_angle_tilt_and_view(M: float, psi: float, tilt: float, axis: float, mirrored: bool) -> None:
    R = Rz(psi) @ (Rx(180.0) if mirrored else np.eye(3)) @ tilted(tilt, axis)
    found = optical_parameters(projection(M * R[:2, :2], (50.0 * M, -20.0 * M)), EXACT)
    assert found.view == ("along_minus_z_or_mirrored" if mirrored else "along_plus_z")
    assert found.largest_scale_px_per_um == pytest.approx(M, rel=1e-12)
    assert found.scale_px_per_um == pytest.approx(M * (1.0 + math.cos(math.radians(tilt))) / 2.0, rel=1e-12)
    assert angle_between(found.angle_deg, psi) < 1e-9
    assert found.tilt_deg_interval == pytest.approx((tilt, tilt), abs=2e-6)
    ratio = M / found.scale_px_per_um
    assert found.translation_um == pytest.approx((50.0 * ratio, -20.0 * ratio), rel=1e-12)


@settings(deadline=None, max_examples=100)
@given(angles, st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.booleans())
def test_rz_ry_rx_of_the_paper(psi: float, about_y: float, about_x: float, mirrored: bool) -> None:
    R = Rz(psi) @ Ry(about_y) @ Rx(about_x + (180.0 if mirrored else 0.0))
    found = optical_parameters(projection(0.243 * R[:2, :2]), EXACT)
    expected = math.degrees(math.acos(min(1.0, abs(R[2, 2]))))
    assert found.tilt_deg_interval == pytest.approx((expected, expected), abs=2e-6)
    # Two tilts together turn the image by half their product, to second order.
    assert angle_between(found.angle_deg, psi) < abs(math.radians(about_x) * about_y) / 2.0 * 1.01 + 1e-9


def test_angle_is_that_of_the_image_of_stage_x_in_both_views() -> None:
    u, v = math.cos(math.radians(30.0)), math.sin(math.radians(30.0))
    for second_column in ([-v, u], [v, -u]):
        A = 0.2 * np.column_stack([[u, v], second_column])
        assert optical_parameters(projection(A)).angle_deg == pytest.approx(30.0)


@settings(deadline=None, max_examples=100)
@given(angles, angles, st.floats(0.0, 10.0), st.booleans())
def test_turning_the_stage_turns_the_angle_and_nothing_else(
    psi: float, turn: float, tilt: float, mirrored: bool
) -> None:
    R = Rz(psi) @ (Rx(180.0) if mirrored else np.eye(3)) @ tilted(tilt, 20.0)
    A = 0.243 * R[:2, :2]
    before = optical_parameters(projection(A), EXACT)
    # Coordinates in a stage frame turned by `turn`: X = Rz(turn) X'.
    after = optical_parameters(projection(A @ Rz(turn)[:2, :2]), EXACT)
    sign = -1.0 if mirrored else 1.0
    assert angle_between(after.angle_deg, before.angle_deg + sign * turn) < 1e-9
    assert after.scale_px_per_um == pytest.approx(before.scale_px_per_um, rel=1e-12)
    assert after.tilt_deg_interval == pytest.approx(before.tilt_deg_interval, abs=1e-5)
    assert after.view == before.view


def some_covariance(size: float) -> np.ndarray:
    root = np.random.default_rng(1).standard_normal((6, 6)) * [size, size, 1.0, size, size, 1.0]
    return root.T @ root


@pytest.mark.parametrize("mirrored", [False, True])
def test_sigmas_agree_with_monte_carlo(mirrored: bool) -> None:
    covariance = some_covariance(1e-5)
    A = 0.243 * (Rz(130.0) @ (Rx(180.0) if mirrored else np.eye(3)) @ tilted(5.0, 40.0))[:2, :2]
    P = np.array(projection(A, (30.0, -12.0)))
    found = optical_parameters(P, covariance)
    draws = np.random.default_rng(2).multivariate_normal(P, covariance, size=4000)
    seen = [optical_parameters(draw) for draw in draws]
    assert found.sigma_scale_px_per_um == pytest.approx(np.std([one.scale_px_per_um for one in seen]), rel=0.05)
    assert found.sigma_angle_deg == pytest.approx(np.std([one.angle_deg for one in seen]), rel=0.05)


@pytest.mark.parametrize("degrees_of_freedom", [math.inf, 6.0])
@pytest.mark.parametrize("true_tilt_deg", [0.0, 0.5, 1.0, 3.0])
def test_tilt_interval_covers(true_tilt_deg: float, degrees_of_freedom: float) -> None:
    """Noise of 5e-5 of the scale in the entries: as much as a tilt of half a degree."""
    rng = np.random.default_rng(3)
    shape = np.diag([1.0, 2.0, 1.0, 2.0, 1.0, 0.5]) * 0.243 * 5e-5
    truth = np.array(projection(0.243 * (Rz(20.0) @ tilted(true_tilt_deg, 70.0))[:2, :2]))
    runs, inside, bounds = 400, 0, 0
    for _ in range(runs):
        # An estimated covariance is off by a factor χ²/n.
        off = 1.0
        if math.isfinite(degrees_of_freedom):
            off = rng.chisquare(degrees_of_freedom) / degrees_of_freedom
        found = optical_parameters(
            truth + shape @ rng.standard_normal(6), shape @ shape * off, degrees_of_freedom=degrees_of_freedom
        )
        low, high = found.tilt_deg_interval
        inside += low - 1e-9 <= true_tilt_deg <= high
        bounds += low == 0.0
    assert inside >= 0.92 * runs
    if true_tilt_deg == 0.0:
        assert bounds >= 0.92 * runs
    if true_tilt_deg == 3.0:
        assert bounds == 0


def test_a_per_mille_between_the_axes_reads_as_a_tilt_of_two_and_a_half_degrees() -> None:
    found = optical_parameters([0.2, 0.0, 0.0, 0.0, 0.2 * 0.999, 0.0], EXACT)
    assert found.tilt_deg_interval == pytest.approx((2.56, 2.56), abs=0.01)
    assert found.tilt_label == "tilt or stage/pixel anisotropy"
    assert found.tilt_sign_ambiguous


def test_a_covariance_of_lower_rank_still_gives_an_interval() -> None:
    direction = np.array([1.0, 0.0, 0.0, 0.0, -1.0, 0.0]) * 1e-5
    low, high = optical_parameters([0.2, 0.0, 0.0, 0.0, 0.2, 0.0], np.outer(direction, direction)).tilt_deg_interval
    assert low == pytest.approx(0.0, abs=0.05)
    assert high == pytest.approx(math.degrees(2.0 * math.atan(math.sqrt(2.4477 * 1e-5 / 0.2))), rel=1e-3)


def test_an_unknown_scale_alone_leaves_the_tilt_exact() -> None:
    P = np.array(projection(0.243 * (Rz(20.0) @ tilted(40.0, 70.0))[:2, :2]))
    found = optical_parameters(P, np.outer(P, P) * 1e-2)
    assert found.sigma_scale_px_per_um == pytest.approx(0.1 * found.scale_px_per_um)
    assert found.sigma_angle_deg == pytest.approx(0.0, abs=1e-6)
    assert found.tilt_deg_interval == pytest.approx((40.0, 40.0), abs=1e-4)


def test_without_covariance_nothing_is_claimed() -> None:
    found = optical_parameters([0.2, 0.0, 3.0, 0.0, -0.2, 4.0])
    assert found.sigma_scale_px_per_um is None
    assert found.sigma_angle_deg is None
    assert found.tilt_deg_interval == (0.0, 90.0)
    too_few = optical_parameters([0.2, 0.0, 3.0, 0.0, -0.2, 4.0], some_covariance(1e-6), degrees_of_freedom=1.0)
    assert too_few.tilt_deg_interval == (0.0, 90.0)


def test_magnification_needs_the_pixel_pitch() -> None:
    P = [0.243, 0.0, 0.0, 0.0, -0.243, 0.0]
    assert optical_parameters(P).magnification is None
    assert optical_parameters(P, pixel_pitch_um=7.4).magnification == pytest.approx(1.798, abs=1e-3)


def test_survives_json() -> None:
    found = optical_parameters([0.2, 0.0, 3.0, 0.0, -0.2, 4.0])
    assert msgspec.json.decode(msgspec.json.encode(found), type=OpticalParameters) == found


@pytest.mark.parametrize("P", [[0.1, 0.0, 0.0, 0.1, 0.0, 0.0], [0.0] * 6])
def test_refuses_a_singular_projection(P: list[float]) -> None:
    with pytest.raises(IllConditioned):
        optical_parameters(P)


def test_refuses_what_is_not_a_finite_projection() -> None:
    good = [0.1, 0.0, 0.0, 0.0, 0.1, 0.0]
    with pytest.raises(DataError):
        optical_parameters([math.nan, *good[1:]])
    with pytest.raises(DataError):
        optical_parameters(good[:5])
    with pytest.raises(DataError):
        optical_parameters(good, np.full((6, 6), math.inf))
    with pytest.raises(DataError):
        optical_parameters(good, np.zeros((4, 4)))


@settings(deadline=None, max_examples=100)
@given(st.floats(-1e6, 1e6))
def test_wrapped_angle_is_the_same_direction_in_its_range(angle: float) -> None:
    wrapped = wrap_deg(angle)
    assert -180.0 < wrapped <= 180.0
    assert math.cos(math.radians(wrapped - angle)) == pytest.approx(1.0)


def test_half_a_turn_has_one_name() -> None:
    assert [wrap_deg(angle) for angle in (-180.0, 180.0, 540.0, -540.0)] == [180.0] * 4
