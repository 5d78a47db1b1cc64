"""The doctor finds what was planted, names it, and lets no failure hide another device."""

import msgspec
import pytest

from microdrivers.backends.camera.source_camera import SourceCamera
from microdrivers.backends.oriental_az.zoom import AzZoomMotor
from microdrivers.backends.pi_gcs.stage import GcsXYThetaStage
from microdrivers.configs import shipped_rig
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.errors import LinkTimeout
from microdrivers.fakes.wire import wire_named
from microdrivers.rig import build_rig
from microdrivers.routines.doctor import diagnose
from microdrivers.routines.optics import CircleSettings
from microdrivers.routines.stream_check import POSE_RATE_HZ, ZOOM_RATE_HZ


@pytest.fixture
def examine():
    """Diagnose the emulated workstation; returns the devices by name. If drivers are replaced, only these devices."""

    def call(*, motion=False, prepare=lambda rig: None, **drivers):
        rig = build_rig(shipped_rig("microscope"), fake=True, seed=4, clock=SimulatedClock())
        for name, driver in drivers.items():
            rig.devices[name] = driver(name, rig.simulation.settings_of(name), clock=rig.clock, bus=rig.bus)
        if drivers:
            rig.devices = {name: rig.devices[name] for name in drivers}
        prepare(rig)
        try:
            diagnosis = diagnose(rig, motion=motion)
        finally:
            rig.close()
        return {device.name: device for device in diagnosis.devices}

    return call


def texts(device, level):
    return [f"{finding.what} -> {finding.remedy}" for finding in device.findings if finding.level == level]


def sole_problem(found, name):
    """The only problem of the whole rig is this device's; returns it."""
    for other, device in found.items():
        assert len(texts(device, "problem")) == (other == name), device.findings
    return texts(found[name], "problem")[0]


def test_a_sound_rig_has_no_problem_and_figures_that_fit_the_wire(examine):
    found = examine(motion=True)
    assert [texts(device, "problem") + texts(device, "warning") for device in found.values()] == [[], [], []]
    stage, zoom, camera = (found[name].figures for name in ("sample_stage", "zoom", "camera_fine"))
    assert 1.0 < stage["read_median_ms"] <= stage["read_worst_ms"] < 20.0
    assert stage["stream_hz"] == pytest.approx(100, abs=2)
    assert stage["steps_x_um"] == pytest.approx([20, -20, -20, 20], abs=0.3)
    assert stage["steps_y_um"] == pytest.approx([20, -20, -20, 20], abs=0.3)
    assert 11.0 < zoom["read_median_ms"] < 14.0
    assert camera["rate_hz"] == pytest.approx(30.0, abs=0.1)
    assert camera["dropped_frames"] == 0
    assert camera["t_source"] == "device"


def test_without_motion_nothing_moves_and_the_missing_reference_is_a_warning_with_the_command(examine):
    axes = {}

    def note(rig):
        axes.update(rig.simulation.world.stage_axes)

    found = examine(sample_stage=GcsXYThetaStage, prepare=note)
    (warning,) = texts(found["sample_stage"], "warning")
    assert "NOT REFERENCED: x, y, theta" in warning
    assert "--device sample_stage --axes x,y,theta" in warning
    assert [axis.position_at(10**11) for axis in axes.values()] == [axis.position_at(0) for axis in axes.values()]


def test_the_rates_are_those_that_the_calibration_uses():
    defaults = CircleSettings()
    assert (defaults.pose_rate_hz, defaults.zoom_rate_hz) == (POSE_RATE_HZ, ZOOM_RATE_HZ)


# ---------------------------------------------------------------------- links


def test_an_unplugged_device_hides_no_other(examine):
    found = examine(prepare=lambda rig: wire_named("sample_stage").unplug())
    assert "cable" in sole_problem(found, "sample_stage")
    assert found["zoom"].figures["read_median_ms"] > 0
    assert found["camera_fine"].figures["rate_hz"] > 0


class FailsToAnswer(GcsXYThetaStage):
    """Loses some replies after it was opened."""

    every = 4
    _asked = 0

    def _read(self):
        self._asked += 1
        if self._asked % self.every == 0:
            raise LinkTimeout("no reply to b'POS?'", remedy="check the cable")
        return super()._read()


class NeverAnswers(FailsToAnswer):
    every = 1


def test_lost_replies_are_counted(examine):
    problem = sole_problem(examine(sample_stage=FailsToAnswer), "sample_stage")
    assert "3 of 12 reads failed" in problem
    assert "check the cable" in problem


def test_a_device_that_no_longer_answers_is_not_asked_for_long(examine):
    found = examine(sample_stage=NeverAnswers)
    assert "3 of 3 reads failed" in sole_problem(found, "sample_stage")
    assert "stream_hz" not in found["sample_stage"].figures


class Stalls(GcsXYThetaStage):
    """Takes half a second for one read in ten: a latency timer, or a busy line."""

    _asked = 0

    def _read(self):
        self._asked += 1
        with self.clock.transaction():
            self.clock.sleep(0.5 if self._asked % 10 == 0 else 0.0)
            return super()._read()


def test_a_line_that_stalls_is_a_warning_with_both_figures(examine):
    found = examine(sample_stage=Stalls)["sample_stage"]
    assert any("ms at worst" in text and "latency timer" in text for text in texts(found, "warning"))
    assert any("of 100 asked" in text for text in texts(found, "warning"))
    assert found.figures["read_worst_ms"] > 500


class Counting(GcsXYThetaStage):
    @property
    def line_counters(self):
        return {"exchanges": 40, "timeouts": 2, "discarded_bytes": 0}


def test_line_counters_are_shown_if_the_driver_has_them(examine):
    found = examine(sample_stage=Counting)["sample_stage"]
    assert any("40 exchanges, 2 timeouts, 0 discarded bytes" in text for text in texts(found, "warning"))
    assert found.figures["line"]["timeouts"] == 2


class VagueTime(GcsXYThetaStage):
    def _read(self):
        return msgspec.structs.replace(super()._read(), dt_ns=5_000_000, t_source="midpoint")


def test_a_pose_of_vague_time_leads_to_settled_calibration(examine):
    found = examine(sample_stage=VagueTime)["sample_stage"]
    assert any("±5 ms (midpoint)" in text and "--settled" in text for text in texts(found, "warning"))


def test_an_alarm_is_a_problem_with_the_drives_own_words(examine):
    def raise_alarm(rig):
        rig.devices["zoom"].fault = None
        honest = rig.devices["zoom"]._drive.read_alarm
        rig.devices["zoom"]._drive.read_alarm = lambda: honest() or 0x30

    problem = sole_problem(examine(zoom=AzZoomMotor, prepare=raise_alarm), "zoom")
    assert "at fault" in problem
    assert "30" in problem


# ---------------------------------------------------------------------- motion


class WrongSign(GcsXYThetaStage):
    def _start_move(self, targets, speeds):
        super()._start_move({axis: 15_000 - goal for axis, goal in targets.items()}, speeds)


class SwappedAxes(GcsXYThetaStage):
    def _start_move(self, targets, speeds):
        other = {"x": "y", "y": "x", "theta": "theta"}
        super()._start_move({other[a]: v for a, v in targets.items()}, {other[a]: v for a, v in speeds.items()})


class StandsStill(GcsXYThetaStage):
    def _start_move(self, targets, speeds):
        pass


class HalfWay(GcsXYThetaStage):
    def _start_move(self, targets, speeds):
        super()._start_move({axis: 7500 + (goal - 7500) / 2 for axis, goal in targets.items()}, speeds)


@pytest.mark.parametrize(
    ("fault", "name"),
    [(WrongSign, "wrong sign"), (SwappedAxes, "swapped"), (StandsStill, "did not move"), (HalfWay, "wrong size")],
)
def test_an_axis_that_does_not_move_as_told_is_named_with_its_fault(examine, fault, name):
    problems = texts(examine(motion=True, sample_stage=fault)["sample_stage"], "problem")
    assert len(problems) == 2
    for axis, problem in zip("xy", problems, strict=True):
        assert f"axis {axis} was told to move +20.00 µm" in problem
        assert name in problem


def test_a_fault_in_motion_is_no_fault_without_it(examine):
    assert texts(examine(sample_stage=WrongSign)["sample_stage"], "problem") == []


class KnowsNoReference(GcsXYThetaStage):
    def _reference_axis(self, axis):
        if axis != "y":
            super()._reference_axis(axis)


def test_an_axis_without_reference_is_not_moved(examine):
    stages = []

    def remember(rig):
        stages.append(wire_named("sample_stage").emulator)

    found = examine(motion=True, sample_stage=KnowsNoReference, prepare=remember)["sample_stage"]
    assert any("axis y was not moved" in text for text in texts(found, "warning"))
    assert len(found.figures["steps_x_um"]) == 4
    assert not [text for _, text in stages[0].events if text.startswith("move y")]


# ---------------------------------------------------------------------- camera


class Silent(SourceCamera):
    def _start(self):
        pass


def test_a_silent_camera_is_a_problem(examine):
    assert "no frame" in sole_problem(examine(camera_fine=Silent), "camera_fine")


class StaleFrame(SourceCamera):
    def grab(self, *, timeout_s=1.0):
        return self.topic.latest or super().grab(timeout_s=timeout_s)


def test_a_stale_frame_is_a_problem(examine):
    problem = sole_problem(examine(camera_fine=StaleFrame), "camera_fine")
    assert "before the call" in problem
    assert "buffered" in problem


class ArrivalOnly(SourceCamera):
    def _take(self, raw):
        super()._take(msgspec.structs.replace(raw, t_ns=None))


class VagueStamp(SourceCamera):
    def _take(self, raw):
        super()._take(msgspec.structs.replace(raw, dt_ns=2_000_000))


class Loses(SourceCamera):
    def _take(self, raw):
        if raw.frame_id % 3:
            super()._take(raw)


class Bright(SourceCamera):
    def _take(self, raw):
        super()._take(msgspec.structs.replace(raw, image=raw.image | 0xFF))


class Dark(SourceCamera):
    def _take(self, raw):
        super()._take(msgspec.structs.replace(raw, image=raw.image // 50))


class Frozen(SourceCamera):
    def _take(self, raw):
        self._first = getattr(self, "_first", raw.image)
        super()._take(msgspec.structs.replace(raw, image=self._first.copy()))


@pytest.mark.parametrize(
    ("camera", "what", "remedy"),
    [
        (ArrivalOnly, "only the arrival", "--settled"),
        (VagueStamp, "±2 ms", "0.2 ms"),
        (Loses, "frames dropped", "rate_hz"),
        (Bright, "100 % of the pixels at 255", "shorten exposure_ms"),
        (Dark, "the image is dark", "lens cap"),
        (Frozen, "identical to the last bit", "frozen"),
    ],
)
def test_what_makes_a_camera_unfit_for_measuring_is_a_warning(examine, camera, what, remedy):
    found = examine(camera_fine=camera)["camera_fine"]
    assert texts(found, "problem") == []
    assert any(what in text and remedy in text for text in texts(found, "warning")), found.findings
