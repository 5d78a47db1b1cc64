"""The synchroniser: interpolates between neighbours, never extrapolates, never invents."""

import math

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.samples import TrackedPoint, XYThetaSample
from microdrivers.core.synchroniser import Around, Neighbours, Synchroniser, interpolate_pose

MS = 1_000_000


def pose(t_ms, x_um=0.0, **changes):
    return XYThetaSample(
        t_ns=round(t_ms * MS), device="stage", x_um=x_um, y_um=-x_um, theta_deg=0.0, moving=True, on_target=False,
        referenced=True, **changes,
    )  # fmt: skip


def circling(t_ms, angle):
    return msgspec.structs.replace(pose(t_ms), x_um=1000.0 * math.cos(angle), y_um=1000.0 * math.sin(angle))


def point(t_ms):
    return TrackedPoint(
        t_ns=round(t_ms * MS), device="camera", u_px=0.0, v_px=0.0, sigma_px=0.01, found=True, frame_seq=0
    )


def test_a_sample_waits_until_a_pose_lies_on_either_side():
    synchroniser = Synchroniser(("stage",))
    synchroniser.add(point(15))
    synchroniser.add_reference("stage", pose(0))
    synchroniser.add_reference("stage", pose(10))
    assert synchroniser.release() == []
    synchroniser.add_reference("stage", pose(20))
    [(released, neighbours)] = synchroniser.release()
    assert released.t_ns == 15 * MS
    assert [sample.t_ns for sample in neighbours["stage"]] == [10 * MS, 20 * MS, 0]


def test_every_reference_stream_must_bracket():
    synchroniser = Synchroniser(("stage", "zoom"))
    for t_ms in (0, 20):
        synchroniser.add_reference("stage", pose(t_ms))
    synchroniser.add(point(10))
    assert synchroniser.release() == []
    for t_ms in (5, 25):
        synchroniser.add_reference("zoom", pose(t_ms))
    assert len(synchroniser.release()) == 1


def test_a_sample_older_than_all_poses_is_given_up_and_counted():
    synchroniser = Synchroniser(("stage",))
    synchroniser.add(point(5))
    synchroniser.add_reference("stage", pose(10))
    assert synchroniser.release() == []
    assert synchroniser.unmatched == 1


def test_waiting_is_bounded_and_what_is_given_up_is_counted():
    synchroniser = Synchroniser(("stage",), max_waiting=3)
    for t_ms in range(5):
        synchroniser.add(point(t_ms))
    assert synchroniser.unmatched == 2


def test_two_samples_are_interpolated_on_a_line_with_the_velocity_between_them():
    between = interpolate_pose(Around(pose(10, 100.0, dt_ns=3), pose(20, 106.0, dt_ns=7)), 15 * MS)
    assert (between.x_um, between.y_um) == (103.0, -103.0)
    assert between.velocity_x_um_s == pytest.approx(600.0)
    assert (between.dt_ns, between.gap_ns) == (7, 10 * MS)


@pytest.mark.parametrize("t_ms", [9.99, 20.01])
def test_interpolation_refuses_to_extrapolate(t_ms):
    with pytest.raises(ValueError, match="never extrapolated"):
        interpolate_pose(Around(pose(10), pose(20), pose(0)), round(t_ms * MS))


@settings(deadline=None, max_examples=100)
@given(st.integers(2, 30), st.floats(0.0, 1.0), st.floats(-50.0, 50.0), st.floats(500.0, 5000.0))
def test_a_curve_is_followed_whatever_the_samples_intervals(past_ms, share, bend_um_s2, speed_um_s):
    def place_um(t_ms):
        return 7.0 + speed_um_s * 1e-3 * t_ms + bend_um_s2 * 1e-6 * t_ms**2

    samples = [pose(t_ms, place_um(t_ms)) for t_ms in (0, 10, -past_ms)]
    between = interpolate_pose(Around(*samples), round(10 * share * MS))
    assert between.x_um == pytest.approx(place_um(10 * share), abs=1e-3 * speed_um_s * 1e-6 + 1e-9)
    assert between.y_um == pytest.approx(-between.x_um)


def test_a_circle_keeps_its_radius_between_the_samples():
    samples = [circling(0, 0.0), circling(10, 0.06), circling(-10, -0.06)]
    between = interpolate_pose(Around(*samples), 5 * MS)
    chord = interpolate_pose(Around(*samples[:2]), 5 * MS)
    assert math.hypot(chord.x_um, chord.y_um) == pytest.approx(1000.0 * math.cos(0.03))
    assert math.hypot(between.x_um, between.y_um) == pytest.approx(1000.0, abs=0.02)


@pytest.mark.parametrize(("earlier_um", "before_um", "after_um"), [(-5.0, 0.0, 0.0), (0.0, 0.0, 5.0), (5.0, 0.0, 5.0)])
def test_a_stage_that_stops_starts_or_turns_stays_between_its_samples(earlier_um, before_um, after_um):
    samples = Around(pose(10, before_um), pose(20, after_um), pose(0, earlier_um))
    assert interpolate_pose(samples, 15 * MS).x_um == (before_um + after_um) / 2.0


@settings(deadline=None, max_examples=100)
@given(st.lists(st.integers(0, 1000), min_size=2, max_size=40, unique=True), st.integers(-10, 1010))
def test_neighbours_are_the_nearest_on_either_side(times_ms, wanted_ms):
    times_ms = sorted(times_ms)
    stream = Neighbours()
    for t_ms in times_ms:
        stream.add(pose(t_ms))
    found = stream.around(wanted_ms * MS)
    before = [t for t in times_ms if t <= wanted_ms]
    after = [t for t in times_ms if t >= wanted_ms]
    if before and after:
        assert [sample.t_ns for sample in found[:2]] == [before[-1] * MS, after[0] * MS]
        earlier = before[-2:-1] if before[-1] != after[0] else []
        assert [found.earlier.t_ns] == [t * MS for t in earlier] if found.earlier else not earlier
    else:
        assert found is None
