"""The calibrator: zoom changes that no frame has seen."""

import math

import pytest

from microdrivers.core.samples import Frame, OpticsEstimate, TrackedPoint, XYThetaSample, ZoomSample
from microdrivers.estimators.optics.calibrator import OpticsCalibrator

PERIOD_NS = 33_000_000


class Exact:
    """A tracker that knows where the point is: scale as the zoom, no noise."""

    def __init__(self):
        self.scale = 0.2

    def update(self, frame):
        x_um, y_um = circle(frame.seq)
        return TrackedPoint(
            t_ns=frame.t_ns, device="t", u_px=self.scale * x_um, v_px=-self.scale * y_um, sigma_px=0.0, found=True,
            frame_seq=frame.seq,
        )  # fmt: skip


def circle(number):
    return 300 * math.cos(0.07 * number), 300 * math.sin(0.07 * number)


def play(calibrator, tracker, frames, zoom_of):
    """Feed frames with a pose and a zoom reading at each one's time."""
    estimates = []
    for number in range(frames):
        t_ns = number * PERIOD_NS
        x_um, y_um = circle(number)
        zoom = zoom_of(number)
        tracker.scale = 0.2 * zoom
        for sample in (
            XYThetaSample(t_ns=t_ns, device="s", x_um=x_um, y_um=y_um, theta_deg=0.0, moving=True, on_target=False,
                          referenced=True),
            ZoomSample(t_ns=t_ns, device="z", zoom=zoom, position_steps=0, moving=False, on_target=True,
                       referenced=True),
            Frame(t_ns=t_ns, device="c", seq=number, image=None, exposure_ms=1.0, frame_id=number,
                  principal_point_px=(0.0, 0.0)),
        ):  # fmt: skip
            estimates += [e for e in calibrator.update(sample) if isinstance(e, OpticsEstimate)]
    return estimates


def test_a_zoom_change_between_two_frames_is_flushed_though_no_frame_saw_it():
    tracker = Exact()
    estimates = play(OpticsCalibrator(tracker), tracker, 40, lambda number: 1.0 if number < 20 else 1.5)
    assert not any(estimate.zoom_moving for estimate in estimates)
    assert [estimate.valid for estimate in estimates[19:24]] == [True, False, False, True, True]
    for estimate in estimates[22:]:
        assert estimate.scale_px_per_um == pytest.approx(0.3, rel=1e-6)


def test_a_zoom_that_comes_back_between_two_frames_is_flushed_too():
    tracker = Exact()
    calibrator = OpticsCalibrator(tracker)
    play(calibrator, tracker, 10, lambda number: 1.0)
    moved = ZoomSample(
        t_ns=9 * PERIOD_NS + 5, device="z", zoom=1.0, position_steps=0, moving=True, on_target=False, referenced=True
    )
    calibrator.update(moved)
    for sample in (
        ZoomSample(t_ns=10 * PERIOD_NS, device="z", zoom=1.0, position_steps=0, moving=False, on_target=True,
                   referenced=True),
        XYThetaSample(t_ns=10 * PERIOD_NS, device="s", x_um=circle(10)[0], y_um=circle(10)[1], theta_deg=0.0,
                      moving=True, on_target=False, referenced=True),
        Frame(t_ns=10 * PERIOD_NS, device="c", seq=10, image=None, exposure_ms=1.0, frame_id=10,
              principal_point_px=(0.0, 0.0)),
    ):  # fmt: skip
        found = [e for e in calibrator.update(sample) if isinstance(e, OpticsEstimate)]
    assert [estimate.valid for estimate in found] == [False]


@pytest.mark.parametrize(
    ("frame_ns", "next_zoom", "moves"),
    [
        (5_000_000, 1.5, False),  # after the first reading at the target
        (1_500_000, 1.5, True),  # within that reading's own uncertainty
        (5_000_000, 1.5004, True),  # it was not there for good
    ],
)
def test_a_frame_after_the_first_reading_at_the_target_sees_a_resting_zoom(frame_ns, next_zoom, moves):
    tracker = Exact()
    calibrator = OpticsCalibrator(tracker)
    play(calibrator, tracker, 10, lambda number: 1.0)
    start_ns = 10 * PERIOD_NS
    tracker.scale = 0.3

    def zoom(t_ns, reading, moving):
        return ZoomSample(
            t_ns=start_ns + t_ns, dt_ns=2_000_000, device="z", zoom=reading, position_steps=0, moving=moving,
            on_target=not moving, referenced=True,
        )  # fmt: skip

    def pose(t_ns):
        x_um, y_um = circle(10)
        return XYThetaSample(t_ns=start_ns + t_ns, device="s", x_um=x_um, y_um=y_um, theta_deg=0.0, moving=True,
                             on_target=False, referenced=True)  # fmt: skip

    frame = Frame(t_ns=start_ns + frame_ns, device="c", seq=10, image=None, exposure_ms=1.0, frame_id=10,
                  principal_point_px=(0.0, 0.0))  # fmt: skip
    found = []
    for sample in (
        pose(0), zoom(0, 1.5, True), frame, pose(15_000_000), zoom(15_000_000, next_zoom, False),
    ):  # fmt: skip
        found += [e for e in calibrator.update(sample) if isinstance(e, OpticsEstimate)]
    assert [estimate.zoom_moving for estimate in found] == [moves]


def test_frames_beyond_the_number_asked_for_are_ignored():
    tracker = Exact()
    assert len(play(OpticsCalibrator(tracker, frames=12), tracker, 40, lambda number: 1.0)) == 12
