"""The calibration against the truth, and the faults that must spoil it."""

import msgspec
import numpy as np
import pytest

from microdrivers.backends.camera.source_camera import SourceCamera
from microdrivers.backends.oriental_az.zoom import AzZoomMotor
from microdrivers.backends.pi_gcs.stage import GcsXYThetaStage
from microdrivers.core.errors import (
    CalibrationError,
    MicrodriversError,
    MotionError,
    NotReferenced,
    OutOfRange,
    TargetLost,
)
from microdrivers.core.samples import TrackedPoint
from microdrivers.estimators.optics import student_factor
from microdrivers.estimators.optics.calibrator import CalibratorSettings, OpticsCalibrator
from microdrivers.routines.optics.targets import make_tracker


def problems(calibration):
    """What is wrong with a calibration, by name; empty if it agrees with the truth."""
    result, truth = calibration.result, calibration.truth
    found = set()
    if abs(truth.errors["scale_percent"]) > 0.1:
        found.add("scale")
    if abs(truth.errors["angle_deg"]) > 0.03:
        found.add("angle")
    if result.view != truth.view:
        found.add("view")
    sigma = np.sqrt(np.diag(np.array(result.covariance)))
    if np.any(np.abs(truth.errors["projection"]) > 2.5 * student_factor(result.degrees_of_freedom) * sigma):
        found.add("covariance")
    if result.zoom_change is None or (result.zoom_change.iterations_to_0p1_px or 99) > 12:
        found.add("settling")
    if np.nanmedian([np.nan if e is None else e for e in result.prediction_error_px]) > 0.06:
        found.add("prediction")
    return found


@pytest.fixture(scope="module")
def sound(calibrate):
    """The paper's run, with the samples that its estimator saw."""
    return calibrate(keep_samples=True)


SHORT = {"change_after_frame": 22, "frames": 42}
one_run = pytest.mark.xdist_group("the paper's calibration")


@one_run
def test_a_sound_rig_calibrates_to_the_truth(sound):
    assert problems(sound) == set()
    assert sound.run.lost_frames == 0
    assert sound.run.unmatched_frames == 0


@pytest.mark.parametrize("seed", [12, 13, 14])
def test_so_do_others_in_fewer_frames(calibrate, seed):
    calibration = calibrate(seed=seed, frames=70)
    assert problems(calibration) == set()
    assert calibration.run.lost_frames == 0
    assert calibration.run.unmatched_frames == 0


class ArrivalStampCamera(SourceCamera):
    def _take(self, raw):
        super()._take(msgspec.structs.replace(raw, t_ns=self.clock.now_ns()))


class ArrivalStampStage(GcsXYThetaStage):
    def _read(self):
        return msgspec.structs.replace(super()._read(), t_ns=self.clock.now_ns())


class SwappedReading(GcsXYThetaStage):
    def _read(self):
        pose = super()._read()
        return msgspec.structs.replace(pose, x_um=pose.y_um, y_um=pose.x_um)


class MirroredReading(GcsXYThetaStage):
    def _read(self):
        pose = super()._read()
        return msgspec.structs.replace(pose, x_um=15_000 - pose.x_um)


class StretchedReading(GcsXYThetaStage):
    """One axis reads one percent too much."""

    def _read(self):
        pose = super()._read()
        return msgspec.structs.replace(pose, x_um=7500 + 1.01 * (pose.x_um - 7500))


class ZoomThatNeverMoves(AzZoomMotor):
    """Its samples never say that it moves."""

    def _read(self):
        sample = super()._read()
        return msgspec.structs.replace(sample, moving=False, zoom=0.9)


@pytest.mark.parametrize(
    ("device", "fault", "name"),
    [
        ("camera_fine", ArrivalStampCamera, "angle"),
        ("sample_stage", ArrivalStampStage, "angle"),
        ("zoom", ZoomThatNeverMoves, "settling"),
    ],
    ids=lambda value: getattr(value, "__name__", str(value)),
)
def test_a_planted_fault_spoils_the_calibration_by_name(calibrate, device, fault, name):
    assert name in problems(calibrate(drivers={device: fault}, **SHORT))


@pytest.mark.parametrize("fault", [SwappedReading, MirroredReading, StretchedReading], ids=lambda fault: fault.__name__)
def test_a_stage_that_reads_the_wrong_axis_sign_or_scale_is_stopped(calibrate, fault):
    with pytest.raises((MotionError, CalibrationError)):
        calibrate(drivers={"sample_stage": fault})


def test_millimetres_for_micrometres_are_suspected(calibrate):
    class Millimetres(GcsXYThetaStage):
        def _start_move(self, targets, speeds):
            near = {axis: 7500 + (goal - 7500) / 1000 if axis != "theta" else goal for axis, goal in targets.items()}
            super()._start_move(near, speeds)

        def _read(self):
            pose = super()._read()
            stretch = lambda value: 7500 + (value - 7500) * 1000  # noqa: E731
            return msgspec.structs.replace(pose, x_um=stretch(pose.x_um), y_um=stretch(pose.y_um))

    with pytest.raises(MicrodriversError):
        calibrate(drivers={"sample_stage": Millimetres})


class Tracked:
    """A tracker that finds again what another one has found, with a fault of its own."""

    def __init__(self, points, spoil):
        self._points = points
        self._spoil = spoil

    def update(self, frame):
        return self._spoil(self._points[frame.seq])


def replayed(calibration, tracker, settings=None):
    """Feed the recorded samples to a new estimator."""
    estimator = OpticsCalibrator(tracker, settings, frames=len(calibration.run.estimates))
    return [result for sample in calibration.run.recorded for result in estimator.update(sample)]


@pytest.fixture(scope="module")
def again(sound):
    """What an estimator makes of the recorded samples."""
    first = sound.run.estimates[0]
    return replayed(sound, make_tracker("square", near_px=(first.u_px, first.v_px)))


def estimates(results):
    return [result for result in results if hasattr(result, "projection")]


def spoilt(sound, again, spoil=lambda point: point, settings=None):
    """What an estimator makes of them whose tracker is spoilt, or that is set otherwise."""
    points = {result.frame_seq: result for result in again if isinstance(result, TrackedPoint)}
    return estimates(replayed(sound, Tracked(points, spoil), settings))


@one_run
def test_the_recorded_order_gives_the_same_bits(sound, again):
    assert [sample.order for sample in sound.run.recorded] == sound.run.arrivals
    assert [e.projection for e in estimates(again)] == [e.projection for e in sound.run.estimates]
    assert [e.covariance for e in estimates(again)] == [e.covariance for e in sound.run.estimates]


@one_run
def test_a_tracker_with_the_wrong_sign_of_v_is_found_by_the_view(sound, again):
    flipped = spoilt(sound, again, lambda point: msgspec.structs.replace(point, v_px=-point.v_px))
    right = np.linalg.det(np.reshape(sound.run.estimates[-1].projection, (2, 3))[:, :2])
    assert np.sign(np.linalg.det(np.reshape(flipped[-1].projection, (2, 3))[:, :2])) == -np.sign(right)


@one_run
def test_without_flushing_the_stack_the_calibration_does_not_settle_in_time(sound, again):
    """Two frames of the old zoom stay in the stack; λ = 0 for one frame is not enough."""
    poor = spoilt(sound, again, settings=CalibratorSettings(flush_frames=1))
    change = sound.result.zoom_change
    first_clean = change.last_moving_frame + 4
    assert max(e.prediction_error_px for e in poor[first_clean : first_clean + 4]) > 0.5
    assert max(sound.result.prediction_error_px[first_clean + 1 : first_clean + 4]) < 0.2


def test_a_target_out_of_view_is_named(calibrate, tmp_path):
    world = tmp_path / "world.yaml"
    world.write_text("target: {visible: false}\n")
    with pytest.raises(TargetLost, match="not wholly in view"):
        calibrate(world=world)


def test_a_target_partly_in_view_is_named(calibrate, tmp_path):
    world = tmp_path / "world.yaml"
    world.write_text("target: {side_um: 2600}\n")
    with pytest.raises(TargetLost, match="not wholly in view"):
        calibrate(world=world)


def test_a_circle_that_cannot_be_large_enough_is_refused_before_it_moves_there(calibrate, tmp_path):
    world = tmp_path / "world.yaml"
    world.write_text("target: {side_um: 1100, offset_um: 0}\n")
    with pytest.raises(OutOfRange, match="only a circle of"):
        calibrate(world=world)


def test_an_unreferenced_stage_on_hardware_is_not_referenced_but_named(calibrate, monkeypatch):
    from microdrivers.rig import Rig

    monkeypatch.setattr(Rig, "fake", property(lambda rig: False))
    with pytest.raises(NotReferenced, match="never references by itself") as caught:
        calibrate()
    assert "microdrivers reference" in caught.value.remedy
    assert "--axes x,y,theta" in caught.value.remedy


def test_at_rest_the_calibration_needs_no_time_stamps(calibrate):
    """A camera that cannot tell the time makes the routine take frames at rest, by itself, and as exactly."""

    class NoStamps(SourceCamera):
        def _take(self, raw):
            super()._take(msgspec.structs.replace(raw, t_ns=None))

    steps = []

    class Steps:
        def step(self, text):
            steps.append(text)

        def count(self, done, total):
            pass

    calibration = calibrate(drivers={"camera_fine": NoStamps}, **SHORT, progress=Steps())
    assert any("taking frames at rest" in text for text in steps)
    assert problems(calibration) == set()
    assert calibration.result.zoom_change.zoom_after == pytest.approx(1.2, rel=1e-3)


def test_in_motion_may_be_insisted_on_and_its_uncertainty_says_what_it_costs(calibrate):
    class NoStamps(SourceCamera):
        def _take(self, raw):
            super()._take(msgspec.structs.replace(raw, t_ns=None))

    calibration = calibrate(drivers={"camera_fine": NoStamps}, frames=60, settled=False)
    assert abs(calibration.truth.errors["angle_deg"]) > 0.03
    assert abs(calibration.truth.errors["angle_deg"]) < 3 * calibration.result.angle_sigma_deg


def test_a_scale_that_contradicts_the_optics_is_suspected_to_be_a_wrong_unit(calibrate):
    def wrong_pitch(rig):
        rig.devices["camera_fine"].pixel_pitch_um *= 10

    with pytest.raises(CalibrationError, match="shifts the image by"):
        calibrate(prepare=wrong_pitch)


def test_too_few_frames_to_settle_are_refused_before_anything_moves(calibrate):
    with pytest.raises(OutOfRange, match="end before the calibration can settle"):
        calibrate(frames=48)


def test_a_zoom_too_slow_to_arrive_gives_an_old_calibration_that_says_so(calibrate):
    def slow(rig):
        zoom = rig.devices["zoom"]
        zoom._settings = zoom._settings.model_copy(update={"speed_steps_s": 100})
        zoom.axis = msgspec.structs.replace(zoom.axis, max_speed=100.0)

    calibration = calibrate(prepare=slow, frames=60)
    assert not calibration.result.complete
    assert any("this is the calibration at zoom 0.89" in note for note in calibration.result.notes)
    assert abs(calibration.truth.errors["scale_percent"]) < 0.1


def test_a_frame_rate_that_poses_cannot_follow_is_taken_at_rest(calibrate):
    def faster(rig):
        rig.devices["camera_fine"].settings = msgspec.structs.replace(rig.devices["camera_fine"].settings, rate_hz=60.0)

    calibration = calibrate(prepare=faster, **SHORT)
    assert calibration.run.complete
    assert problems(calibration) == set()
