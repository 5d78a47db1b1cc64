"""Ctrl-C and cut cables: whatever happens, the stage stands still afterwards, and the emulator's log proves it."""

from contextlib import suppress

import pytest

from microdrivers.core.errors import IllConditioned, LinkError
from microdrivers.estimators.optics import student_factor
from microdrivers.fakes.wire import Wire, wire_named


def stage_state(rig, emulator):
    """Where the axes are, and whether a stop arrived."""
    later_ns = rig.clock.now_ns() + 10**9
    axes = rig.simulation.world.stage_axes.values()
    speeds = [abs(axis.speed_at(later_ns)) for axis in axes]
    return speeds, [text for _, text in emulator.events if "stop" in text]


class InterruptAt:
    """Progress that is interrupted at a frame."""

    def __init__(self, frame):
        self._frame = frame

    def step(self, text):
        pass

    def count(self, done, total):
        if done >= self._frame:
            raise KeyboardInterrupt


def interrupt(calibrate, frame, **options):
    """A run that is interrupted at a frame, and the emulator on its stage's wire."""
    emulators = []
    calibration = calibrate(
        progress=InterruptAt(frame),
        prepare=lambda rig: emulators.append(wire_named("sample_stage").emulator),
        **options,
    )
    return calibration, emulators[0]


LATE = 58


@pytest.fixture(scope="module", params=[11, 12])
def interrupted(request, calibrate):
    """A run that was interrupted some frames after the zoom change."""
    return interrupt(calibrate, LATE, seed=request.param)


def assert_stopped_and_kept(calibration, emulator, frame):
    speeds, stops = stage_state(calibration.rig, emulator)
    assert speeds == pytest.approx([0, 0, 0], abs=1e-9)
    assert stops
    assert not calibration.result.complete
    assert frame - 3 <= calibration.result.frames <= frame + 1
    assert any("interrupted" in note for note in calibration.result.notes)


@pytest.mark.parametrize("frame", [20, 46])
def test_ctrl_c_on_the_circle_stops_all_axes_and_keeps_what_was_measured(calibrate, frame):
    assert_stopped_and_kept(*interrupt(calibrate, frame), frame)


after_the_change = pytest.mark.xdist_group("interrupted after the zoom change")


@after_the_change
def test_so_does_ctrl_c_at_the_new_zoom(interrupted):
    assert_stopped_and_kept(*interrupted, LATE)


OLD_ZOOM, NEW_ZOOM = 0.9, 1.2


@after_the_change
@pytest.mark.parametrize(
    ("frame", "zoom"), [(47, OLD_ZOOM), (49, OLD_ZOOM), (51, OLD_ZOOM), (54, OLD_ZOOM), (58, NEW_ZOOM)]
)
def test_ctrl_c_soon_after_the_zoom_change_keeps_the_calibration_that_is_well_founded(interrupted, frame, zoom):
    """The zoom changes after frame 45; fewer than 57 frames are refused beforehand, so no interruption may use them."""
    calibration, _ = interrupted
    run = calibration.run._replace(estimates=calibration.run.estimates[:frame])
    result, truth = calibration.judge(run)
    assert not result.complete
    assert result.zoom == result.valid_for.zoom == pytest.approx(zoom, rel=1e-3)
    assert truth.zoom == pytest.approx(zoom, rel=5e-3)
    half_width = student_factor(result.degrees_of_freedom) * result.scale_sigma_px_per_um
    assert abs(result.scale_px_per_um - truth.scale_px_per_um) <= half_width
    low, high = result.tilt.interval_deg
    assert low <= truth.tilt_deg <= high
    since = sum(estimate.frame_index > 44 for estimate in run.estimates)
    ended = [note for note in result.notes if f"ended {since} frames after the zoom began to change" in note]
    assert bool(ended) == (zoom == OLD_ZOOM)
    assert (result.zoom_change is None) == (zoom == OLD_ZOOM)


def test_ctrl_c_before_either_zoom_is_measured_well_enough_says_what_is_missing(calibrate):
    with pytest.raises(IllConditioned) as caught:
        calibrate(progress=InterruptAt(8), change_after_frame=3)
    assert "9 are needed" in caught.value.what
    assert "inf" not in str(caught.value)


def test_ctrl_c_at_rest_keeps_the_old_zoom_too(calibrate):
    """Between two frames at rest the zoom comes and goes unseen."""
    result = calibrate(progress=InterruptAt(20), settled=True, change_after_frame=14).result
    assert result.valid_for.zoom == pytest.approx(OLD_ZOOM, rel=1e-3)
    assert any("too few for the new zoom (5 frames with the zoom at rest" in note for note in result.notes)


def test_too_short_an_arc_is_no_calibration(calibrate):
    with pytest.raises(IllConditioned, match="too short an arc"):
        calibrate(progress=InterruptAt(14), degrees_per_frame=1.0)


@pytest.mark.parametrize("write", [40, 90, 125, 150, 230, 262, 300])
def test_ctrl_c_in_the_middle_of_an_exchange_stops_all_axes(calibrate, monkeypatch, write):
    """At any request on any line: while referencing, finding the target, streaming, changing the zoom, and after."""
    written, seen = [0], {}
    honest = Wire.write

    def interrupting(wire, data):
        honest(wire, data)
        written[0] += 1
        if written[0] == write:
            raise KeyboardInterrupt

    def prepare(rig):
        seen["rig"], seen["emulator"] = rig, wire_named("sample_stage").emulator

    monkeypatch.setattr(Wire, "write", interrupting)
    with suppress(KeyboardInterrupt, IllConditioned):  # perhaps too little was measured for a result
        calibrate(prepare=prepare, change_after_frame=12, frames=40)
    assert written[0] > write
    speeds, stops = stage_state(seen["rig"], seen["emulator"])
    assert speeds == pytest.approx([0, 0, 0], abs=1e-9)
    assert stops


def test_a_cut_camera_cable_ends_the_run_with_a_typed_error_and_stops_the_stage(calibrate, monkeypatch):
    from microdrivers.fakes.camera.source import FakeFrameSource

    honest, delivered, seen = FakeFrameSource._deliver, [0], {}

    def failing(source, *arguments):
        delivered[0] += 1
        source.connected = delivered[0] < 30
        honest(source, *arguments)

    def prepare(rig):
        seen["rig"], seen["emulator"] = rig, wire_named("sample_stage").emulator

    monkeypatch.setattr(FakeFrameSource, "_deliver", failing)
    with pytest.raises(LinkError, match="camera_fine"):
        calibrate(prepare=prepare)
    speeds, stops = stage_state(seen["rig"], seen["emulator"])
    assert speeds == pytest.approx([0, 0, 0], abs=1e-9)
    assert stops
