"""Force from the camera alone on closed-form indentations of specimens whose model is known."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.contact_samples import VisionForceSample
from microdrivers.core.errors import DataError, OutOfRange
from microdrivers.estimators.force.indenter import IndentationEstimator
from microdrivers.estimators.force.matcher import IndentationMatcher
from microdrivers.estimators.force.vision_force import VisionForce, VisionForceSettings
from tests.estimators.force.camera_indentations import (
    CONTACT_S,
    PIXEL_UM,
    PRESETS,
    RATE_HZ,
    Record,
    error_percent,
    fed,
    frame,
    frames,
    indentation,
    swinging,
)


@pytest.mark.parametrize("name", list(PRESETS))
def test_force_of_a_fresh_indentation(name: str) -> None:
    for seed in range(2):
        record = indentation(PRESETS[name], depth_um=90.0 + 10.0 * seed, phase=0.3 * seed)
        estimator = VisionForce(PRESETS[name])
        found = fed(estimator, frames(record, seed=seed))
        assert len(found) == len(record.t_s) - estimator.settings.lag
        assert [force.t_ns for force in found] == [round(1e9 * t) for t in record.t_s[: len(found)]]
        assert error_percent(found, record) <= 5.0
        forces = np.array([force.force_uN for force in found])
        assert np.all(forces >= 0.0)
        assert np.all(forces[record.t_s[: len(found)] < CONTACT_S - 0.1] == 0.0)
        assert not any(force.flags for force in found)
        assert not estimator.touches


@settings(deadline=None, max_examples=6)
@given(
    st.sampled_from(list(PRESETS)), st.integers(0, 2**32 - 1), st.floats(4.5, 12.0), st.floats(60.0, 140.0),
    st.sampled_from([0.0, 1.5]), st.floats(0.0, 1.0),
)  # fmt: skip
def test_at_any_speed_depth_and_phase(
    name: str, seed: int, speed_um_s: float, depth_um: float, hold_s: float, phase: float
) -> None:
    record = indentation(PRESETS[name], speed_um_s=speed_um_s, depth_um=depth_um, hold_s=hold_s, phase=phase)
    found = fed(VisionForce(PRESETS[name]), frames(record, seed=seed))
    # A frame on the wrong side of a corner costs the damper's force, and a short push has few frames.
    wrong_uN = 2.0 * PRESETS[name].b_loading_uN_s_per_um * speed_um_s
    rms_uN = float(np.sqrt(np.mean(record.force_uN**2)))
    assert error_percent(found, record) <= 3.0 + 100.0 * wrong_uN * math.sqrt(2.0 / len(found)) / rms_uN
    assert all(force.force_uN >= 0.0 for force in found)


@pytest.mark.parametrize("name", list(PRESETS))
def test_sigma_covers_the_error(name: str) -> None:
    inside = []
    for seed in range(2):
        record = indentation(PRESETS[name], phase=0.25 * seed)
        found = fed(VisionForce(PRESETS[name]), frames(record, seed=seed + 50))
        inside += [
            abs(f.force_uN - truth) <= 1.96 * f.sigma_uN for f, truth in zip(found, record.force_uN, strict=False)
        ]
    assert 0.9 <= np.mean(inside) <= 0.99


def test_damper_changes_at_the_reversal_and_not_around_it() -> None:
    preset = PRESETS["unloading_springs"]
    record = indentation(preset, phase=0.5)
    found = fed(VisionForce(preset), frames(record, noise_um=0.001))
    turn = int(np.argmax(record.deformation_um))
    errors = np.array([force.force_uN for force in found]) - record.force_uN[: len(found)]
    assert np.abs(errors[turn - 5 : turn - 1]).max() < 15.0
    assert np.abs(errors[turn + 2 : turn + 7]).max() < 15.0
    assert found[turn - 3].force_uN - found[turn + 3].force_uN > 240.0


def test_contact_instant_is_that_of_the_deformation_and_carries_the_slip() -> None:
    preset = PRESETS["slip_corrected"]
    errors = []
    for seed in range(12):
        estimator = VisionForce(preset)
        fed(estimator, frames(indentation(preset, phase=seed / 12), seed=seed)[:150])
        assert estimator.touches
        assert estimator.touched_ns is not None
        errors.append(estimator.touched_ns / 1e9 - CONTACT_S)
    assert np.sqrt(np.mean(np.square(errors))) < 1.0 / RATE_HZ
    assert abs(np.mean(errors)) < 0.35 / RATE_HZ


def test_zero_of_the_model_need_not_be_that_of_the_deformation() -> None:
    preset = PRESETS["single"]
    record = indentation(preset)
    moved = [frame(k, t, x - 12.0) for k, (t, x) in enumerate(zip(record.t_s, record.deformation_um, strict=True))]
    assert error_percent(fed(VisionForce(preset._replace(contact_um=-12.0)), moved), record) < 3.0


def test_no_force_without_contact() -> None:
    rng = np.random.default_rng(1)
    for preset in PRESETS.values():
        estimator = VisionForce(preset)
        found = fed(
            estimator, [frame(k, k / RATE_HZ, x) for k, x in enumerate(rng.normal(0.0, PIXEL_UM, 600).tolist())]
        )
        assert all(force.force_uN == 0.0 for force in found)
        assert estimator.touched_ns is None


def test_camera_that_looks_when_the_tool_presses_already_tells_the_force() -> None:
    preset = PRESETS["single"]
    found = fed(VisionForce(preset), [frame(k, k / RATE_HZ, 40.0) for k in range(40)])
    assert found[0].force_uN == pytest.approx(preset.k1_uN_per_um * 40.0 + 1e-4 * 64000.0, abs=1.0)


def test_second_push_is_felt_again() -> None:
    preset = PRESETS["unloading_springs"]
    record = indentation(preset, depth_um=40.0)
    estimator = VisionForce(preset)
    once = frames(record)
    again = [frame(k, s.t_ns / 1e9 + 30.0, s.deformation_um) for k, s in enumerate(once)]
    found = fed(estimator, [*once, *again])[len(once) :]
    assert error_percent(found, record) <= 5.0


def test_slip_begins_anew_once_the_specimen_has_come_back() -> None:
    preset = PRESETS["slip_corrected"]
    record = indentation(preset, depth_um=60.0)
    estimator = VisionForce(preset)
    once = frames(record)
    again = [frame(k, s.t_ns / 1e9 + 60.0, s.deformation_um) for k, s in enumerate(once)]
    found = fed(estimator, [*once, *again])[len(once) :]
    assert error_percent(found, record) <= 2.0
    # After the push itself the specimen stays where it has slipped to: the slip does not begin anew.
    assert estimator.touched_ns is not None
    assert estimator.touched_ns / 1e9 == pytest.approx(60.0 + CONTACT_S, abs=0.1)


def test_lost_frames_are_said_at_once_in_order_and_recovered_from() -> None:
    preset = PRESETS["single"]
    record = indentation(preset)
    samples = frames(record)
    gone = frame(300, record.t_s[300], math.nan, found=False)
    estimator = VisionForce(preset)
    before = fed(estimator, samples[:300])
    told = estimator.update(gone)
    assert len(before) + len(told) == 301
    assert told[-1].flags == {"LOST"}
    assert math.isnan(told[-1].force_uN)
    assert math.isnan(told[-1].sigma_uN)
    after = fed(estimator, samples[301:])
    times = [force.t_ns for force in (*before, *told, *after)]
    assert times == sorted(times)
    errors = [f.force_uN - record.force_uN[301 + k] for k, f in enumerate(after)]
    assert max(map(abs, errors[:100])) < 30.0


def test_an_indentation_that_ends_while_pressed_gives_a_force_for_every_frame() -> None:
    record = indentation(PRESETS["single"])
    samples = frames(record)[:400]
    estimator = IndentationEstimator(None, IndentationMatcher(), vision_force=VisionForce(PRESETS["single"]))
    found = [force for sample in samples for force in estimator.update(sample)]
    assert len(found) < len(samples)
    found += estimator.finish()
    assert [force.t_ns for force in found] == [sample.t_ns for sample in samples]
    last = [force.force_uN for force in found[-5:] if isinstance(force, VisionForceSample)]
    assert last == pytest.approx(record.force_uN[395:400].tolist(), rel=0.05)
    assert estimator.finish() == []


def test_beyond_the_characterised_range_is_said() -> None:
    preset = PRESETS["single"]._replace(deepest_um=60.0, fastest_um_s=6.0)
    record = indentation(preset)
    found = fed(VisionForce(preset), frames(record))
    deeper = {record.t_s[k] for k, force in enumerate(found) if "OUTSIDE_RANGE" in force.flags}
    depth = dict(zip(record.t_s.tolist(), record.deformation_um.tolist(), strict=True))
    assert all(depth[t] > 59.8 for t in deeper)
    assert len(deeper) == pytest.approx(2 * 40.0 / 5.0 * RATE_HZ, abs=8)
    quick = fed(VisionForce(preset._replace(deepest_um=200.0)), frames(indentation(preset, speed_um_s=9.0)))
    assert sum("OUTSIDE_RANGE" in force.flags for force in quick) > 200
    same = fed(
        VisionForce(preset._replace(deepest_um=100.0, fastest_um_s=5.0)), frames(indentation(preset, hold_s=2.0))
    )
    assert not any(force.flags for force in same)
    slow_back = preset._replace(deepest_um=200.0, fastest_unloading_um_s=3.0)
    told = fed(VisionForce(slow_back), frames(record))
    outside = [force.velocity_um_s for force in told if "OUTSIDE_RANGE" in force.flags]
    assert len(outside) > 200
    assert max(outside) < -3.0
    no_way_back = fed(VisionForce(preset._replace(deepest_um=200.0, fastest_unloading_um_s=0.0)), frames(record))
    back = [force for force in no_way_back if force.velocity_um_s < -1.0 and force.deformation_um > 2.0]
    assert len(back) > 200
    # Also where the model's damper leaves no force.
    assert all("OUTSIDE_RANGE" in force.flags for force in back)
    assert min(force.force_uN for force in back) == 0.0
    assert not any(force.velocity_um_s > 0.0 for force in no_way_back if "OUTSIDE_RANGE" in force.flags)


def test_uncertain_model_widens_sigma() -> None:
    record = indentation(PRESETS["single"])
    covariance = tuple(np.diag([0.1**2, 1e-6**2, 1.0**2]).ravel().tolist())
    plain = fed(VisionForce(PRESETS["single"]), frames(record))
    unsure = fed(VisionForce(PRESETS["single"]._replace(covariance=covariance, residual_uN=2.0)), frames(record))
    k = 400
    x_um, v_um_s = plain[k].deformation_um, plain[k].velocity_um_s
    added = math.hypot(0.1 * x_um, 1e-6 * x_um**3, 1.0 * v_um_s, 2.0)
    assert unsure[k].sigma_uN == pytest.approx(math.hypot(plain[k].sigma_uN, added), rel=1e-6)
    assert unsure[k].force_uN == plain[k].force_uN
    assert plain[k].sigma_uN > math.hypot(4.5 * 0.03, 27.72 * 0.02)


def test_spike_of_the_tracker_is_no_force() -> None:
    preset = PRESETS["single"]
    record = indentation(preset)
    samples = frames(record)
    clean = fed(VisionForce(preset), samples)
    samples[400] = frame(400, record.t_s[400], record.deformation_um[400] + 5.0)
    spoilt = fed(VisionForce(preset), samples)
    assert max(abs(a.force_uN - b.force_uN) for a, b in zip(clean, spoilt, strict=True)) < 10.0


def test_frame_that_comes_late_or_twice_is_counted_and_left_out() -> None:
    samples = frames(indentation(PRESETS["single"], depth_um=20.0))
    estimator = VisionForce(PRESETS["single"])
    expected = fed(VisionForce(PRESETS["single"]), samples)
    assert repr(fed(estimator, [*samples[:50], samples[49], samples[20], *samples[50:]])) == repr(expected)
    assert estimator.late_frames == 2


def test_longer_lag_is_allowed_and_a_shorter_one_refused() -> None:
    record = indentation(PRESETS["single"])
    found = fed(VisionForce(PRESETS["single"], VisionForceSettings(lag=8)), frames(record))
    assert len(found) == len(record.t_s) - 8
    assert error_percent(found, record) <= 5.0
    with pytest.raises(OutOfRange, match="lag"):
        VisionForce(PRESETS["single"], VisionForceSettings(lag=1))


@pytest.mark.parametrize(
    "settings", [{"max_gap_s": 0.0}, {"max_gap_s": -1.0}, {"max_gap_s": math.nan}, {"lag": 4.5}, {"window": 5}]
)
def test_settings_that_make_no_sense_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(OutOfRange) as caught:
        VisionForce(PRESETS["single"], VisionForceSettings(**settings))
    assert caught.value.remedy


def test_a_model_that_is_none_is_refused_before_the_first_frame() -> None:
    with pytest.raises(OutOfRange, match="covariance has 2 entries"):
        VisionForce(PRESETS["single"]._replace(covariance=(1.0, 2.0)))


def test_a_negative_standard_deviation_is_refused_and_changes_nothing() -> None:
    samples = frames(indentation(PRESETS["single"], depth_um=10.0))
    estimator = VisionForce(PRESETS["single"])
    before = fed(estimator, samples[:40])
    with pytest.raises(DataError, match="standard deviation -1 µm"):
        estimator.update(frame(40, samples[40].t_ns / 1e9, 0.0, sigma_um=-1.0))
    assert repr(before + fed(estimator, samples[40:])) == repr(fed(VisionForce(PRESETS["single"]), samples))


def test_noise_that_is_not_stated_is_observed_and_until_then_there_is_no_force() -> None:
    record = indentation(PRESETS["single"], depth_um=20.0)
    samples = [frame(s.seq, s.t_ns / 1e9, s.deformation_um, sigma_um=math.nan) for s in frames(record)]
    found = fed(VisionForce(PRESETS["single"]), samples)
    assert all(f.flags == {"NO_VELOCITY"} and math.isnan(f.force_uN) for f in found[:9])
    assert all(math.isfinite(f.force_uN) and math.isfinite(f.sigma_uN) for f in found[9:])


def test_sigma_contains_what_the_lag_of_the_velocity_hides() -> None:
    preset = PRESETS["single"]
    t = np.arange(0.0, 20.0, 1.0 / RATE_HZ)
    since = np.maximum(t - CONTACT_S, 0.0)
    angle = 2.0 * np.pi * since / 4.0
    x = 3.0 * since + 2.0 * 4.0 / (2.0 * np.pi) * (1.0 - np.cos(angle))
    v = np.where(since > 0.0, 3.0 + 2.0 * np.sin(angle), 0.0)
    record = Record(t, x, preset.k1_uN_per_um * x + preset.k2_uN_per_um3 * x**3 + preset.b_loading_uN_s_per_um * v)
    found = fed(VisionForce(preset), frames(record))
    # The first change of speed is seen a window later.
    seen = [f for f in found if f.t_ns > 3.0e9]
    truth = record.force_uN[len(found) - len(seen) : len(found)]
    off = np.array([abs(f.force_uN - force) for f, force in zip(seen, truth, strict=True)])
    assert np.sqrt(np.mean(off**2)) > 7.0
    assert np.mean(off > 3.0 * np.array([f.sigma_uN for f in seen])) < 0.02


@pytest.mark.parametrize("name", list(PRESETS))
@pytest.mark.parametrize(("rate_hz", "max_gap_s"), [(3.0, 0.25), (30.0, 0.03)])
def test_a_camera_too_slow_for_a_velocity_tells_no_force(name: str, rate_hz: float, max_gap_s: float) -> None:
    slow = [frame(k, k / rate_hz, 5.0 / rate_hz * max(k - 6, 0)) for k in range(60)]
    found = fed(VisionForce(PRESETS[name], VisionForceSettings(max_gap_s=max_gap_s)), slow)
    assert len(found) > 50
    assert all(math.isnan(f.force_uN) and math.isnan(f.sigma_uN) and f.flags == {"NO_VELOCITY"} for f in found)


def test_a_camera_too_slow_for_a_velocity_tells_the_force_of_springs() -> None:
    preset = PRESETS["single"]
    slow = [frame(k, k / 3.0, 5.0 / 3.0 * max(k - 6, 0)) for k in range(60)]
    springs = preset._replace(b_loading_uN_s_per_um=0.0, b_unloading_uN_s_per_um=0.0)
    told = fed(VisionForce(springs), slow)
    assert told[-1].force_uN == pytest.approx(4.5161 * told[-1].deformation_um, rel=0.3)
    assert all(math.isnan(f.velocity_um_s) for f in told)


def test_a_force_left_over_where_the_specimen_rests_on_its_way_back_is_flagged() -> None:
    slipping = PRESETS["slip_corrected"]
    record = indentation(slipping, hold_s=3.0)
    without = slipping._replace(slip_um=0.0, slip_rate_per_s=0.0)
    found = fed(VisionForce(without), frames(record))
    said = [f for f in found if "MAY_BE_RELEASED" in f.flags]
    left_s = record.t_s[np.flatnonzero(record.force_uN > 0.0)[-1]]
    assert len(said) > 0.8 * np.sum(record.t_s[: len(found)] > left_s)
    assert all(f.t_ns > 1e9 * (left_s - 0.1) and f.force_uN > 100.0 for f in said)


@pytest.mark.parametrize(
    ("rate_hz", "speed_um_s", "share"),
    [(0.02, 3.77, 0.003), (0.1, 4.4, 0.003), (0.3, 4.4, 0.003), (1.0, 4.4, 0.003), (2.0, 3.8, 0.01)],
)
def test_sigma_covers_an_oscillation_after_a_ramp(rate_hz: float, speed_um_s: float, share: float) -> None:
    preset = PRESETS["single"]
    record = swinging(preset, rate_hz=rate_hz, speed_um_s=speed_um_s)
    found = fed(VisionForce(preset), frames(record, noise_um=0.035))
    pairs = zip(found, record.force_uN, strict=False)
    beyond = [abs(f.force_uN - truth) > 4.0 * f.sigma_uN for f, truth in pairs if not f.flags]
    assert sum(beyond) <= share * len(beyond)


def test_a_steady_ramp_keeps_its_small_sigma() -> None:
    preset = PRESETS["single"]
    found = fed(VisionForce(preset), frames(indentation(preset), noise_um=0.035))
    steady = [f.sigma_uN for f in found if CONTACT_S + 4.0 < f.t_ns / 1e9 < CONTACT_S + 19.0]
    noise_uN = 27.72 * 0.035 * RATE_HZ / math.sqrt(20 * (20**2 - 1) / 12.0)
    assert np.median(steady) < 1.4 * noise_uN
