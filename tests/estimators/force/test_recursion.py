"""A specimen identified on line, on closed-form indentations; the recursion itself is tested beside."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest

from microdrivers.core.contact_samples import IndentationSample, SpecimenEstimate
from microdrivers.core.errors import OutOfRange
from microdrivers.estimators.force.four_samples import Scales
from microdrivers.estimators.force.onset import ForceOnset
from microdrivers.estimators.force.recursion import RecursionSettings, SpecimenRecursion

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


@pytest.mark.parametrize("approach_um_s", [0.0, 1.0, 5.0])
def test_contact_is_found_where_the_noise_of_the_deformation_is_not_stated(approach_um_s: float) -> None:
    estimator = SpecimenRecursion()
    for seen in indentation(SINGLE, approach_um_s=approach_um_s)[:90]:
        estimator.update(msgspec.structs.replace(seen, deformation_sigma_um=math.nan))
    assert estimator.contact is not None
    assert estimator.contact.contact_um == pytest.approx(0.0, abs=0.1)


def test_nothing_is_estimated_without_contact() -> None:
    samples = [sample(k / RATE_HZ, 0.0, 0.02 * (-1) ** k) for k in range(300)]
    estimator = SpecimenRecursion()
    assert fed(estimator, samples) == []
    assert estimator.contact is None


def test_same_samples_give_the_same_bits() -> None:
    samples = indentation(SINGLE, seed=11, depth_um=30.0)
    assert repr(fed(SpecimenRecursion(), samples)) == repr(fed(SpecimenRecursion(), samples))


@pytest.mark.parametrize(
    "wrong",
    [
        {"forgetting": 0.0},
        {"forgetting": 1.1},
        {"forgetting": math.nan},
        {"branch_forgetting": -0.1},
        {"clearance": 1},
        {"least_share": 1.0},
        {"baseline_sigma_uN": 0.0},
        {"max_gap_s": 0.0},
        {"ridge": 0.0},
        {"lag": 3},
    ],
)
def test_settings_that_make_no_sense_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(OutOfRange, match=next(iter(wrong))) as caught:
        SpecimenRecursion(RecursionSettings(**wrong))
    assert caught.value.remedy


def test_whole_numbers_may_be_those_of_numpy() -> None:
    samples = indentation(SINGLE, depth_um=30.0)
    settings = RecursionSettings()
    same = settings._replace(
        lag=np.int64(settings.lag), window=np.int64(settings.window), clearance=np.int64(settings.clearance)
    )
    assert repr(fed(SpecimenRecursion(same), samples)) == repr(fed(SpecimenRecursion(settings), samples))


def test_a_contact_point_that_is_no_number_is_refused() -> None:
    with pytest.raises(OutOfRange, match="contact_um is nan"):
        SpecimenRecursion(contact_um=math.nan)
