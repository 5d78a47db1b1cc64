"""The recursion against eq. (25) on all stacked rows, on singular input, and on closed-form indentations."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.contact_samples import IndentationSample, SpecimenEstimate
from microdrivers.core.errors import DataError
from microdrivers.estimators.force.four_samples import STACK, FourSampleRecursion, Scales
from microdrivers.estimators.force.onset import ForceOnset
from microdrivers.estimators.force.recursion import RecursionSettings, SpecimenRecursion

Array = npt.NDArray[np.float64]

RATE_HZ = 30.0
SPEED_UM_S = 5.0
CONTACT_S = 2.013


class Specimen(NamedTuple):
    k1: float
    k2: float
    b_loading: float
    b_unloading: float


SINGLE = Specimen(4.5161, 1e-4, 27.72, 27.72)
UNLOADING_SPRINGS = Specimen(2.9577, 1e-4, 51.3317, 0.0)


def indentation(
    specimen: Specimen,
    *,
    seed: int = 0,
    depth_um: float = 100.0,
    pixel_um: float = 0.06,
    sensor_uN: float = 0.05,
    zero_um: float = 0.0,
    zero_uN: float = 0.0,
    approach_um_s: float = 0.0,
) -> list[IndentationSample]:
    """In and out at one speed; `approach_um_s` lets the deformation's coordinate move before the contact."""
    rng = np.random.default_rng(seed)
    turn_s = CONTACT_S + depth_um / SPEED_UM_S
    t = np.arange(0.0, 2.0 * turn_s - CONTACT_S, 1.0 / RATE_HZ)
    x = SPEED_UM_S * np.minimum(t - CONTACT_S, 2.0 * turn_s - CONTACT_S - t)
    v = np.where(t < turn_s, SPEED_UM_S, -SPEED_UM_S)
    force = specimen.k1 * x + specimen.k2 * x**3 + np.where(v > 0.0, specimen.b_loading, specimen.b_unloading) * v
    force = np.where(x > 0.0, np.maximum(force, 0.0), 0.0)
    seen = np.where(t < CONTACT_S, approach_um_s * (t - CONTACT_S), x)
    return [
        sample(t_s, zero_um + deformation, zero_uN + felt)
        for t_s, deformation, felt in zip(
            t.tolist(),
            (seen + pixel_um * rng.standard_normal(len(t))).tolist(),
            (force + sensor_uN * rng.standard_normal(len(t))).tolist(),
            strict=True,
        )
    ]


def sample(t_s: float, deformation_um: float, force_uN: float) -> IndentationSample:
    return IndentationSample(
        t_ns=round(1e9 * t_s),
        device="indentation",
        deformation_um=deformation_um,
        deformation_sigma_um=0.06,
        force_uN=force_uN,
        force_sigma_uN=0.05,
        readings=2,
        frame_seq=0,
    )


def fed(estimator: SpecimenRecursion, samples: Iterable[IndentationSample]) -> list[SpecimenEstimate]:
    return [estimate for one in samples for estimate in estimator.update(one)]


def on(estimates: list[SpecimenEstimate], branch: str) -> SpecimenEstimate:
    return [estimate for estimate in estimates if branch in estimate.flags][-1]


# ---------------------------------------------------------------------- the four-sample form


class Rows(NamedTuple):
    x: Array
    v: Array
    a: Array
    force: Array
    factors: Array
    restarts: npt.NDArray[np.bool_]


def random_rows(seed: int, count: int) -> Rows:
    rng = np.random.default_rng(seed)
    x, v, a = rng.uniform(0.0, 120.0, count), rng.uniform(-6.0, 6.0, count), rng.normal(0.0, 30.0, count)
    force = 4.5 * x + 1e-4 * x**3 + 27.0 * v + 0.3 * a + rng.standard_normal(count)
    factors = rng.choice([0.0, 0.3, 1.0, 0.99, 0.9], count, p=[0.03, 0.05, 0.3, 0.32, 0.3])
    return Rows(x, v, a, force, factors, rng.uniform(size=count) < 0.1)


def recursion_of(rows: Rows, **changes: Any) -> FourSampleRecursion:
    estimator = FourSampleRecursion(**changes)
    for x, v, a, force, factor, restart in zip(*(column.tolist() for column in rows), strict=True):
        if restart:
            estimator.restart_stack()
        estimator.update(x_um=x, v_um_s=v, a_um_s2=a, force_uN=force, forgetting=factor)
    return estimator


def batch(rows: Rows, *, with_mass: bool, ridge: float) -> tuple[Array, Array, Array, float, Array]:
    """R and θ of eq. (25) from the stacks of eq. (23); the sandwich in θ's own columns; weights."""
    scales = Scales()
    columns = [(rows.x / scales.x_um) ** 3, rows.x / scales.x_um, rows.v / scales.v_um_s]
    phi = np.column_stack([*columns, rows.a / scales.a_um_s2] if with_mass else columns)
    count, width = phi.shape
    weights, ridge_sum, begin = np.zeros(count), 0.0, 0
    R, f = np.zeros((width, width)), np.zeros(width)
    for k in range(count):
        begin = k if rows.restarts[k] else begin
        stack = slice(max(begin, k - STACK + 1), k + 1)
        R = rows.factors[k] * R + phi[stack].T @ phi[stack] + ridge * np.eye(width)
        f = rows.factors[k] * f + phi[stack].T @ rows.force[stack]
        ridge_sum = rows.factors[k] * ridge_sum + ridge
        weights *= rows.factors[k]
        weights[stack] += 1.0
    theta = np.linalg.solve(R, f)
    inverse = np.linalg.inv(R)
    S = phi.T @ (weights[:, None] ** 2 * phi)
    residual = rows.force - phi @ theta
    variance = float(np.sum(weights * residual**2) / (weights.sum() - np.trace(inverse @ S)))
    return R, theta, inverse @ S @ inverse, variance, weights


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1), st.integers(6, 60), st.booleans(), st.sampled_from([1e-9, 1e-3]))
def test_equals_the_batch_ridge_of_the_stacked_rows(seed: int, count: int, with_mass: bool, ridge: float) -> None:
    rows = random_rows(seed, count)
    estimator = recursion_of(rows, with_mass=with_mass, ridge=ridge)
    R, theta, _, _, _ = batch(rows, with_mass=with_mass, ridge=ridge)
    width = len(theta)
    assert np.allclose(estimator.information, R, rtol=0.0, atol=1e-12 * np.abs(R).max())
    # Rounding of the data alone moves θ by this much.
    tolerance = max(1e-9, 1e-14 * np.linalg.cond(R)) * np.linalg.norm(theta)
    assert np.abs(np.array(estimator.theta[:width]) - theta).max() <= tolerance
    k1, k2, b, m = estimator.parameters
    expected = theta / np.array([1e6, 1e2, 5.0, 50.0])[:width]
    assert np.allclose([k2, k1, b, m][:width], expected, rtol=1e-6, atol=1e-6 * np.abs(expected))
    assert math.isnan(m) != with_mass


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_covariance_is_the_sandwich_of_the_weights_with_which_samples_count(seed: int, with_mass: bool) -> None:
    rows = random_rows(seed, 80)
    rows.factors[-40:] = 0.97
    estimator = recursion_of(rows, with_mass=with_mass)
    _, _, spread, variance, weights = batch(rows, with_mass=with_mass, ridge=1e-9)
    assert weights.max() > 3.0
    found = estimator.spread()
    scale = np.diag([1e-6, 1e-2, 0.2])
    order = [1, 0, 2]
    expected = (variance * scale @ spread[:3, :3] @ scale)[np.ix_(order, order)]
    assert found.determined
    assert np.allclose(np.array(found.covariance).reshape(3, 3), expected, rtol=1e-5, atol=0.0)
    assert found.noise_uN == pytest.approx(math.sqrt(variance), rel=1e-5)
    exact = math.sqrt(np.linalg.cond(estimator.information))
    assert exact <= found.condition * (1.0 + 1e-9) <= 2.0 * exact


def test_four_times_counted_samples_do_not_halve_the_covariance() -> None:
    rng = np.random.default_rng(5)
    errors, predicted = [], []
    for _ in range(100):
        rows = random_rows(int(rng.integers(2**32)), 60)
        rows = rows._replace(factors=np.ones(60), restarts=np.zeros(60, dtype=bool))
        estimator = recursion_of(rows._replace(force=rows.force - 0.3 * rows.a))
        errors.append(estimator.parameters[0] - 4.5)
        predicted.append(math.sqrt(estimator.spread().covariance[0]))
    assert np.sqrt(np.mean(np.square(errors))) / np.mean(predicted) == pytest.approx(1.0, abs=0.2)


def singular_kinds(rng: np.random.Generator, kind: str, count: int) -> Array:
    """Columns x, v, force that leave θ undetermined."""
    noise = rng.standard_normal((count, 2))
    if kind == "far beyond the scales":
        return np.column_stack([np.full(count, 2e4), np.full(count, 5e3), 300.0 + noise[:, 0]])
    if kind == "at rest":
        return np.column_stack([np.full(count, 50.0), np.zeros(count), 300.0 + noise[:, 0]])
    if kind == "one depth":
        return np.column_stack([50.0 + 1e-7 * noise[:, 1], np.full(count, 5.0), 300.0 + noise[:, 0]])
    if kind == "never touching":
        return np.zeros((count, 3))
    return np.column_stack([100.0 * noise[:, 1], 5.0 * noise[:, 1], 1000.0 * noise[:, 1]])


def run_singular(kind: str, count: int, seed: int, forgetting: float, *, with_mass: bool = False) -> None:
    estimator = FourSampleRecursion(with_mass=with_mass)
    largest = 0.0
    for k, (x, v, force) in enumerate(singular_kinds(np.random.default_rng(seed), kind, count).tolist()):
        estimator.update(x_um=x, v_um_s=v, a_um_s2=x, force_uN=force, forgetting=forgetting)
        if k % 10 == 0:
            largest = max(largest, *map(abs, estimator.theta))
            assert math.isfinite(largest)
    assert largest < 1e7
    found = estimator.spread()
    assert kind == "one line" or not found.determined
    assert np.linalg.eigvalsh(estimator.information)[0] >= 0.0


@settings(deadline=None, max_examples=8)
@given(
    st.sampled_from(["at rest", "one depth", "far beyond the scales", "never touching", "one line"]),
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.0, 0.5, 0.99, 1.0]),
    st.booleans(),
)
def test_stays_finite_on_singular_input(kind: str, seed: int, forgetting: float, with_mass: bool) -> None:
    run_singular(kind, 1500, seed, forgetting, with_mass=with_mass)


def test_stays_finite_for_a_hundred_thousand_singular_updates() -> None:
    run_singular("one depth", 100_000, 1, 0.99)


def test_what_cannot_be_used_is_refused_and_changes_nothing() -> None:
    estimator = recursion_of(random_rows(1, 20))
    before = estimator.theta
    for wrong in ({"x_um": math.nan}, {"force_uN": math.inf}, {"v_um_s": 1e200}):
        with pytest.raises(DataError, match="not finite"):
            estimator.update(**({"x_um": 1.0, "v_um_s": 1.0, "force_uN": 1.0, "forgetting": 1.0} | wrong))
    with pytest.raises(ValueError, match="forgetting"):
        estimator.update(x_um=1.0, v_um_s=1.0, force_uN=1.0, forgetting=1.1)
    assert estimator.theta == before
    for bad in ({"ridge": 0.0}, {"ridge": math.nan}, {"scales": Scales(x_um=0.0)}):
        with pytest.raises(ValueError, match="positive"):
            FourSampleRecursion(**bad)


def test_nothing_is_determined_before_enough_samples() -> None:
    estimator = FourSampleRecursion()
    assert estimator.spread().condition == math.inf
    for x, v in ((10.0, 5.0), (50.0, -5.0)):
        estimator.update(x_um=x, v_um_s=v, force_uN=1.0, forgetting=1.0)
        assert not estimator.spread().determined
    estimator.update(x_um=100.0, v_um_s=3.0, force_uN=1.0, forgetting=1.0)
    assert estimator.spread().determined
    assert estimator.spread().covariance == ()


# ---------------------------------------------------------------------- a whole indentation


@pytest.mark.parametrize("specimen", [SINGLE, UNLOADING_SPRINGS])
def test_identifies_a_specimen_on_the_way_in(specimen: Specimen) -> None:
    estimates = fed(SpecimenRecursion(), indentation(specimen))
    found = on(estimates, "LOADING")
    assert found.valid
    assert found.k1_uN_per_um == pytest.approx(specimen.k1, rel=0.02)
    assert found.k2_uN_per_um3 == pytest.approx(specimen.k2, rel=0.04)
    assert found.b_uN_s_per_um == pytest.approx(specimen.b_loading, rel=0.01)
    assert math.isnan(found.m_kg)
    assert len(found.covariance) == 9
    assert 1.0 < found.condition_number < 100.0
    assert abs(found.prediction_error_uN) < 0.3 * specimen.b_loading
    assert [e.seq for e in estimates] == list(range(len(estimates)))


def test_without_noise_the_reversal_smears_nothing() -> None:
    samples = indentation(SINGLE, pixel_um=1e-6, sensor_uN=1e-6)
    whole = RecursionSettings(forgetting=1.0, branch_forgetting=1.0, clearance=2)
    found = fed(SpecimenRecursion(whole), samples)[-1]
    assert found.b_uN_s_per_um == pytest.approx(SINGLE.b_loading, rel=1e-4)
    assert found.k1_uN_per_um == pytest.approx(SINGLE.k1, rel=1e-4)
    assert found.k2_uN_per_um3 == pytest.approx(SINGLE.k2, rel=3e-3)
    # The force falls by 277 µN there.
    assert max(abs(e.prediction_error_uN) for e in fed(SpecimenRecursion(whole), samples)[100:]) < 1.5


def test_contact_is_detected_in_force_and_zero_taken_from_before_it() -> None:
    estimator = SpecimenRecursion()
    samples = indentation(SINGLE, zero_um=3.0, zero_uN=-2.0)
    estimates = fed(estimator, samples)
    assert estimator.contact is not None
    assert estimator.contact.contact_um == pytest.approx(3.0, abs=0.03)
    assert estimator.contact.baseline_uN == pytest.approx(-2.0, abs=0.03)
    assert estimator.contact.t_ns == pytest.approx(1e9 * CONTACT_S, abs=4e7)
    assert estimates[0].t_ns > 1e9 * CONTACT_S
    assert on(estimates, "LOADING").b_uN_s_per_um == pytest.approx(SINGLE.b_loading, rel=0.01)


def test_coordinate_that_moves_during_the_approach_has_its_zero_at_the_contact() -> None:
    estimator = SpecimenRecursion()
    fed(estimator, indentation(SINGLE, approach_um_s=SPEED_UM_S, zero_um=-7.0, seed=3)[:200])
    assert estimator.contact is not None
    assert estimator.contact.contact_um == pytest.approx(-7.0, abs=0.2)


def test_contact_is_not_found_in_noise_or_drift() -> None:
    rng = np.random.default_rng(8)
    onset = ForceOnset()
    forces = (rng.normal(0.0, 0.05, 3000) + 1e-4 * np.arange(3000)).tolist()
    assert all(onset.update(k * 33_000_000, 0.0, 0.06, force) is None for k, force in enumerate(forces))


def test_given_contact_needs_no_approach() -> None:
    samples = [s for s in indentation(SINGLE, zero_um=1.5) if s.t_ns > 1e9 * CONTACT_S]
    estimates = fed(SpecimenRecursion(contact_um=1.5), samples)
    assert on(estimates, "LOADING").b_uN_s_per_um == pytest.approx(SINGLE.b_loading, rel=0.01)


def test_memory_is_cut_where_the_motion_turns() -> None:
    estimates = fed(SpecimenRecursion(), indentation(UNLOADING_SPRINGS))
    turned = next(e for e in estimates if "UNLOADING" in e.flags)
    assert not turned.valid
    assert turned.covariance == ()
    assert turned.condition_number == math.inf
    found = on(estimates, "UNLOADING")
    assert found.b_uN_s_per_um == pytest.approx(0.0, abs=0.2)
    assert found.k1_uN_per_um == pytest.approx(UNLOADING_SPRINGS.k1, rel=0.01)
    kept = RecursionSettings(branch_forgetting=1.0)
    assert on(fed(SpecimenRecursion(kept), indentation(UNLOADING_SPRINGS)), "UNLOADING").b_uN_s_per_um > 5.0


def test_branches_may_be_kept_apart() -> None:
    estimator = SpecimenRecursion(RecursionSettings(separate_branches=True))
    samples = indentation(UNLOADING_SPRINGS)
    estimates = fed(estimator, samples)
    loading = on(estimates, "LOADING")
    assert estimator.recursion("loading").parameters[2] == loading.b_uN_s_per_um
    assert estimator.recursion("unloading").parameters[2] == pytest.approx(0.0, abs=0.2)
    later = [sample(s.t_ns / 1e9 + 60.0, s.deformation_um, s.force_uN) for s in samples]
    assert on(fed(estimator, later), "LOADING").b_uN_s_per_um == pytest.approx(51.33, rel=0.02)


def test_mass_is_estimated_where_the_motion_tells_it() -> None:
    rng = np.random.default_rng(2)
    t = np.arange(0.0, 40.0, 1.0 / RATE_HZ)
    omega = 2.5
    x = 40.0 + 30.0 * np.sin(omega * t)
    v, a = 30.0 * omega * np.cos(omega * t), -30.0 * omega**2 * np.sin(omega * t)
    force = 2.0 * v + 8.0 * x + 1e-3 * x**3 + 0.5 * a
    seen = x + 0.01 * rng.standard_normal(len(t))
    chosen = RecursionSettings(
        with_mass=True, forgetting=1.0, branch_forgetting=1.0, clearance=2, lag=6, window=11, scales=Scales(70, 75, 190)
    )
    samples = [sample(*row) for row in zip(t.tolist(), seen.tolist(), force.tolist(), strict=True)]
    found = fed(SpecimenRecursion(chosen, contact_um=0.0), samples)[-1]
    assert found.valid
    assert found.m_kg == pytest.approx(0.5, abs=0.05)
    assert found.b_uN_s_per_um == pytest.approx(2.0, rel=0.04)


def test_spikes_gaps_late_and_invalid_samples_do_no_harm() -> None:
    samples = indentation(SINGLE, seed=7)
    estimator = SpecimenRecursion()
    spoilt = [
        sample(s.t_ns / 1e9, s.deformation_um + (8.0 if k % 53 == 0 else 0.0), s.force_uN)
        for k, s in enumerate(samples)
        if not 300 < k < 330
    ]
    spoilt[200] = sample(spoilt[200].t_ns / 1e9, 60.0, math.nan)
    spoilt.insert(250, spoilt[240])
    estimates = fed(estimator, spoilt)
    used = {e.t_ns for e in estimates}
    assert not used & {samples[k].t_ns for k in range(0, len(samples), 53)}
    found = on(estimates, "LOADING")
    assert found.b_uN_s_per_um == pytest.approx(SINGLE.b_loading, rel=0.02)
    assert found.k1_uN_per_um == pytest.approx(SINGLE.k1, rel=0.02)
    assert estimator.late_samples == 1
    assert estimator.excluded_samples >= 10


def test_nothing_is_estimated_without_contact() -> None:
    samples = [sample(k / RATE_HZ, 0.0, 0.02 * (-1) ** k) for k in range(300)]
    estimator = SpecimenRecursion()
    assert fed(estimator, samples) == []
    assert estimator.contact is None


def test_same_samples_give_the_same_bits() -> None:
    samples = indentation(SINGLE, seed=11, depth_um=30.0)
    assert repr(fed(SpecimenRecursion(), samples)) == repr(fed(SpecimenRecursion(), samples))
