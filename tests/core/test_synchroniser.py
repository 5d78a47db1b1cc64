"""The synchroniser: interpolates between neighbours, never extrapolates, never invents."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.samples import TrackedPoint, XYThetaSample
from microdrivers.core.synchroniser import Neighbours, Synchroniser, interpolate_pose

MS = 1_000_000


def pose(t_ms, x_um=0.0, **changes):
    return XYThetaSample(
        t_ns=round(t_ms * MS), device="stage", x_um=x_um, y_um=-x_um, theta_deg=0.0, moving=True, on_target=False,
        referenced=True, **changes,
    )  # fmt: skip


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
    assert [sample.t_ns for sample in neighbours["stage"]] == [10 * MS, 20 * MS]


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


def test_interpolation_is_linear_with_the_velocity_between_the_neighbours():
    between = interpolate_pose(pose(10, 100.0, dt_ns=3), pose(20, 106.0, dt_ns=7), 15 * MS)
    assert (between.x_um, between.y_um) == (103.0, -103.0)
    assert between.velocity_x_um_s == pytest.approx(600.0)
    assert (between.dt_ns, between.gap_ns) == (7, 10 * MS)


@pytest.mark.parametrize("t_ms", [9.99, 20.01])
def test_interpolation_refuses_to_extrapolate(t_ms):
    with pytest.raises(ValueError, match="never extrapolated"):
        interpolate_pose(pose(10), pose(20), round(t_ms * MS))


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
        assert [sample.t_ns for sample in found] == [before[-1] * MS, after[0] * MS]
    else:
        assert found is None
