"""The force of a frame is that of its exposure, whatever the order in which frames and readings arrive."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.contact_samples import DeformationSample, IndentationSample
from microdrivers.core.errors import OutOfRange
from microdrivers.core.samples import ForceSample, Sample
from microdrivers.estimators.force.matcher import IndentationMatcher, MatcherSettings
from microdrivers.estimators.force.scatter import RunningScatter

MS = 1_000_000


def frame(t_ms: float, *, exposure_ms: float = 10.0, found: bool = True, seq: int = 0) -> DeformationSample:
    return DeformationSample(
        t_ns=round(t_ms * MS),
        dt_ns=1000,
        device="camera",
        seq=seq,
        deformation_um=0.5 * t_ms if found else math.nan,
        sigma_um=0.06,
        tip_um=math.nan,
        tip_sigma_um=math.nan,
        u_px=0.0,
        v_px=0.0,
        found=found,
        frame_seq=seq,
        exposure_ms=exposure_ms,
    )


def reading(t_ms: float, force_uN: float, *flags: str) -> ForceSample:
    return ForceSample(
        t_ns=round(t_ms * MS), device="probe", force_uN=force_uN, raw_uN=force_uN, flags=frozenset(flags)
    )


def fed(matcher: IndentationMatcher, samples: Iterable[Sample]) -> list[IndentationSample]:
    return [found for sample in samples for found in matcher.update(sample)]


def readings(rate_hz: float, until_ms: float, slope_uN_per_ms: float = 1.0) -> list[ForceSample]:
    times = np.arange(0.0, until_ms, 1000.0 / rate_hz).tolist()
    return [reading(t, slope_uN_per_ms * t) for t in times]


def test_force_is_the_mean_of_the_readings_within_the_exposure() -> None:
    matcher = IndentationMatcher()
    forces = [reading(t, 100.0 if 45 <= t <= 55 else -7.0) for t in range(100)]
    forces[50] = reading(50, 111.0)
    (matched,) = fed(matcher, [frame(50.0, seq=4), *forces])
    assert matched.force_uN == pytest.approx(101.0)
    assert (matched.readings, matched.t_ns, matched.dt_ns, matched.frame_seq) == (11, 50 * MS, 1000, 4)
    assert (matched.deformation_um, matched.deformation_sigma_um, matched.t_source) == (25.0, 0.06, "computed")


def test_sensor_that_is_slower_than_the_exposure_is_interpolated_at_mid_exposure() -> None:
    matcher = IndentationMatcher()
    (matched,) = fed(matcher, [reading(40.0, 10.0), frame(50.0), reading(73.3, 20.0)])
    assert matched.force_uN == pytest.approx(10.0 + 10.0 * 10.0 / 33.3)
    assert matched.readings == 0


@pytest.mark.parametrize("rate_hz", [30.0, 100.0, 1000.0])
def test_a_ramp_is_met_at_mid_exposure(rate_hz: float) -> None:
    matched = fed(IndentationMatcher(), [*(frame(k * 33.3 + 7.0) for k in range(1, 30)), *readings(rate_hz, 1100.0)])
    assert len(matched) == 29
    assert any(m.readings == 0 for m in matched) == (rate_hz == 30.0)
    # A single reading is the only one that must do as it is.
    assert all(m.force_uN == pytest.approx(m.t_ns / MS, rel=1e-6) for m in matched if m.readings != 1)
    assert all(abs(m.force_uN - m.t_ns / MS) <= 5.0 for m in matched)


def test_nothing_is_extrapolated() -> None:
    matcher = IndentationMatcher()
    assert fed(matcher, [frame(50.0), reading(40.0, 1.0), reading(54.9, 1.0)]) == []
    assert matcher.waiting == 1
    early = IndentationMatcher()
    assert fed(early, [frame(50.0), reading(46.0, 1.0), reading(90.0, 1.0)]) == []
    assert early.unmatched == {"UNBRACKETED": 1}


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        (["SATURATED"], "SATURATED"),
        (["STALE"], "STALE"),
        (["DISCONNECTED", "UNTARED"], "DISCONNECTED"),
        ([], "INVALID"),
    ],
)
@pytest.mark.parametrize("rate_hz", [30.0, 1000.0])
def test_frame_with_a_reading_that_is_not_valid_is_counted_with_its_reason(
    flags: list[str], reason: str, rate_hz: float
) -> None:
    forces = readings(rate_hz, 400.0)
    at = next(k for k, sample in enumerate(forces) if sample.t_ns >= 200 * MS)
    forces[at] = reading(forces[at].t_ns / MS, math.nan, *flags)
    matcher = IndentationMatcher()
    matched = fed(matcher, [*(frame(t, exposure_ms=2.0) for t in (100.5, 200.5, 300.5)), *forces])
    assert [round(m.t_ns / MS) for m in matched] == [100, 300]
    assert matcher.unmatched == {reason: 1}
    assert all(math.isfinite(m.force_uN) for m in matched)


def test_untared_readings_are_used_and_say_so() -> None:
    forces = [reading(float(t), 3.0, "UNTARED") for t in range(100)]
    (matched,) = fed(IndentationMatcher(), [frame(50.0), *forces])
    assert matched.flags == {"UNTARED"}


def test_lost_frames_gaps_and_frames_that_nobody_measures_are_counted() -> None:
    matcher = IndentationMatcher(MatcherSettings(max_waiting=3))
    assert fed(matcher, [frame(10.0, found=False)]) == []
    assert fed(matcher, [reading(20.0, 1.0), frame(100.0), reading(200.0, 1.0)]) == []
    assert matcher.unmatched == {"LOST": 1, "GAP": 1}
    fed(matcher, [frame(1000.0 + t) for t in range(5)])
    assert (matcher.unmatched["OVERFLOW"], matcher.waiting) == (2, 3)
    fed(matcher, [frame(999.0)])
    assert matcher.unmatched["OUT_OF_ORDER"] == 1


def test_no_frame_is_matched_twice_or_forgotten() -> None:
    matcher = IndentationMatcher()
    frames = [frame(33.3 * k, found=k % 7 != 0) for k in range(1, 40)]
    matched = fed(matcher, [*frames, *readings(500.0, 1000.0)])
    assert len(matched) + matcher.unmatched.total() + matcher.waiting == len(frames)
    assert [m.seq for m in matched] == list(range(len(matched)))


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.sampled_from([30.0, 200.0, 1000.0]))
def test_how_the_streams_interleave_and_how_late_readings_are_changes_nothing(seed: int, rate_hz: float) -> None:
    rng = np.random.default_rng(seed)
    frames = [frame(33.3 * k + 3.1, exposure_ms=8.0, found=rng.uniform() > 0.1, seq=k) for k in range(1, 12)]
    forces = [reading(t, rng.normal()) for t in np.arange(0.0, 450.0, 1000.0 / rate_hz).tolist()]
    forces = [reading(f.t_ns / MS, math.nan, "STALE") if rng.uniform() < 0.02 else f for f in forces]
    expected = fed(in_order := IndentationMatcher(), [*frames, *forces])
    # Each reading up to 4 ms late among its own stream, the two streams merged at random.
    late = [forces[k] for k in np.argsort([f.t_ns + rng.uniform(0.0, 4.0 * MS) for f in forces])]
    merged: list[Sample] = []
    left, right = list(frames), late
    while left or right:
        merged.append(left.pop(0) if left and (not right or rng.uniform() < 0.3) else right.pop(0))
    matcher = IndentationMatcher()
    assert repr(fed(matcher, merged)) == repr(expected)
    assert matcher.unmatched == in_order.unmatched
    assert matcher.late_readings == 0


def test_reading_that_is_too_late_is_counted_and_left_out() -> None:
    matcher = IndentationMatcher(MatcherSettings(lateness_s=0.002))
    forces = [reading(float(t), 5.0) for t in range(60)]
    assert len(fed(matcher, [frame(50.0), *forces, reading(50.0, 1e6), reading(70.0, 5.0)])) == 1
    assert matcher.late_readings == 1


def test_sigma_follows_the_scatter_of_the_readings_and_their_number() -> None:
    rng = np.random.default_rng(4)
    # A steep ramp with a jump of 200 µN: neither may pass for noise.
    times = np.arange(0.0, 2000.0, 1.0).tolist()
    forces = [reading(t, 0.05 * t + (200.0 if t > 1500.0 else 0.0) + rng.normal(0.0, 0.4)) for t in times]
    matched = fed(IndentationMatcher(), [*(frame(33.3 * k, exposure_ms=16.0) for k in range(20, 59)), *forces])
    for sample in matched[2:]:
        assert sample.force_sigma_uN == pytest.approx(0.4 / math.sqrt(sample.readings), rel=0.25)
    slow = fed(IndentationMatcher(), [*(frame(33.3 * k, exposure_ms=2.0) for k in range(50, 59)), *forces[::40]])
    assert {s.readings for s in slow} == {0}
    assert all(0.3 / math.sqrt(2.0) < s.force_sigma_uN < 3.0 for s in slow)


def test_sigma_of_a_sensor_that_is_read_faster_than_it_answers() -> None:
    """A low-pass of 125 Hz noise bandwidth, read at 1 kHz: neighbouring readings are alike."""
    rng = np.random.default_rng(6)
    noise = [0.0]
    for fresh in rng.normal(0.0, 0.4, 20_000).tolist():
        noise.append(math.exp(-0.5) * noise[-1] + math.sqrt(1.0 - math.exp(-1.0)) * fresh)
    forces = [reading(float(t), 0.02 * t + value) for t, value in enumerate(noise)]
    matched = fed(IndentationMatcher(), _with_frames(forces, exposure_ms=16.0))
    stated = np.nanmedian([sample.force_sigma_uN for sample in matched])
    off = np.array([sample.force_uN - 0.02 * sample.t_ns / MS for sample in matched])
    assert len(matched) > 400
    assert stated == pytest.approx(np.std(off), rel=0.1)
    assert stated > 1.5 * 0.4 / math.sqrt(16.0)


def _with_frames(forces: list[ForceSample], *, exposure_ms: float) -> Iterable[Sample]:
    """Readings, and a frame every 33 of them."""
    for index, sample in enumerate(forces):
        yield sample
        if index % 33 == 20:
            yield frame(sample.t_ns / MS - 8.0, exposure_ms=exposure_ms)


def test_at_the_end_nobody_is_late() -> None:
    matcher = IndentationMatcher()
    assert fed(matcher, [reading(40.0, 1.0), reading(55.0, 3.0), frame(50.0), frame(70.0, seq=1)]) == []
    (matched,) = matcher.finish()
    assert matched.t_ns == 50 * MS
    assert matcher.unmatched == {"UNBRACKETED": 1}
    assert (matcher.waiting, matcher.finish()) == (0, [])


def test_frames_that_were_given_up_are_told() -> None:
    matcher = IndentationMatcher()
    full = ForceSample(
        t_ns=50 * MS, device="probe", force_uN=math.nan, raw_uN=2001.0, tare_uN=1.0, flags=frozenset({"SATURATED"})
    )
    assert fed(matcher, [reading(40.0, 1.0), frame(20.0, found=False), frame(50.0), full, reading(70.0, 1.0)]) == []
    lost, saturated = matcher.given_up
    assert (lost.t_ns, lost.reason) == (20 * MS, "LOST")
    assert math.isnan(lost.force_uN)
    assert saturated == (50 * MS, "SATURATED", 2000.0)


def test_scatter_of_few_or_quantised_readings() -> None:
    scatter = RunningScatter()
    for t in range(9):
        scatter.add(t, 3.0 * t)
    assert math.isnan(scatter.sigma)
    scatter.add(9, 27.0)
    assert scatter.sigma == 0.0
    rng = np.random.default_rng(0)
    for t, value in enumerate(np.round(rng.normal(0.0, 0.25, 2000)).tolist(), start=10):
        scatter.add(t, value)
    assert 0.0 < scatter.sigma < 0.5


def test_interpolated_frame_needs_valid_neighbours_but_not_more() -> None:
    matcher = IndentationMatcher()
    forces = [reading(0.0, math.nan, "STALE"), reading(33.0, 1.0), reading(66.0, 1.0), reading(99.0, math.nan, "STALE")]
    assert len(fed(matcher, [frame(50.0), *forces])) == 1
    assert fed(matcher, [frame(80.0), reading(120.0, 1.0)]) == []
    assert matcher.unmatched == {"STALE": 1}


def test_two_readings_of_the_same_instant() -> None:
    twice = [sample for t in range(40) for sample in (reading(t, t), reading(t, t))]
    (matched,) = fed(IndentationMatcher(), [frame(20.0, exposure_ms=0.0), *twice])
    assert (matched.force_uN, matched.readings) == (20.0, 2)


@pytest.mark.parametrize(
    "settings",
    [
        MatcherSettings(lateness_s=-1.0),
        MatcherSettings(lateness_s=math.nan),
        MatcherSettings(max_gap_s=0.0),
        MatcherSettings(max_gap_s=math.inf),
        MatcherSettings(max_waiting=0),
        MatcherSettings(max_readings=1),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings: MatcherSettings) -> None:
    with pytest.raises(OutOfRange) as caught:
        IndentationMatcher(settings)
    assert caught.value.remedy
