"""The camera backend on a Video4Linux device of the kernel's own: the `vivid` driver, whose test pattern is the truth.

The guest is slow and its pace uneven: nothing here depends on how long something takes.
"""

import itertools
from pathlib import Path

import numpy as np
import pytest

from microdrivers.core.bus import Bus
from microdrivers.core.clock import SystemClock
from microdrivers.core.errors import BusyError, LinkLost, UnsupportedError
from microdrivers.core.units import NS_PER_MS, NS_PER_S
from tests.vm.v4l2_controls import Controls

pytestmark = pytest.mark.vm

DEVICE = "/dev/video0"
SOURCE = f"v4l2://{DEVICE}?size=640x480&stamp=start"
DRIVER = Path("/sys/bus/platform/drivers/vivid")
PATIENCE_S = 30.0


@pytest.fixture
def controls():
    known = Controls(DEVICE)
    known.set("OSD Text Mode", "None")
    known.set("Gain, Automatic", 0)
    known.set("Timestamp Source", "Start of Exposure")
    known.set("Test Pattern", "Gray Ramp")
    known.set("Percentage of Dropped Buffers", 0)
    return known


@pytest.fixture
def make_camera(controls):
    from microdrivers.backends.camera import CameraDeviceSettings
    from microdrivers.backends.camera.source_camera import SourceCamera

    clock = SystemClock()
    cameras = []

    def make(source=SOURCE, *, size=(640, 480), **settings):
        rig = CameraDeviceSettings(source=source, sensor_size_px=size, pixel_pitch_um=5.0, **settings)
        cameras.append(SourceCamera("eye", rig, clock=clock, bus=Bus()))
        return cameras[-1]

    yield make
    for camera in cameras:
        camera.close()
    clock.close()
    clock.check()


@pytest.fixture
def camera(make_camera):
    opened = make_camera()
    opened.open()
    return opened


def take(camera, count):
    return list(itertools.islice(camera.frames(timeout_s=PATIENCE_S), count))


def test_it_tells_who_it_is(camera):
    assert camera.info.model == "vivid"
    assert camera.info.serial_number == "platform:vivid-000"


def test_settings_are_what_the_device_confirms(camera, controls):
    settings = camera.configure(gain=77.0, rate_hz=15.0)
    assert (settings.gain, settings.rate_hz) == (77.0, 15.0)
    assert controls.get("Gain") == 77
    assert settings.exposure_ms == pytest.approx(1000 / 15)  # it has no exposure control: the whole period
    assert camera.configure(gain=5000.0).gain == 255.0
    frame = camera.grab(timeout_s=PATIENCE_S)
    assert frame.settings_id == camera.settings.settings_id
    assert frame.exposure_ms == camera.settings.exposure_ms


def test_frames_carry_the_drivers_own_times(camera):
    period_ns = round(NS_PER_S / camera.settings.rate_hz)
    half_exposure_ns = round(camera.settings.exposure_ms * NS_PER_MS / 2)
    called_ns = camera.clock.now_ns()
    seen = [(frame, camera.clock.now_ns()) for frame in take(camera, 10)]
    frames = [frame for frame, _ in seen]
    assert {frame.t_source for frame in frames} == {"device"}
    assert {frame.dt_ns for frame in frames} == {NS_PER_MS}
    assert all(called_ns <= frame.t_ns - half_exposure_ns <= seen_ns for frame, seen_ns in seen)
    for before, after in itertools.pairwise(frames):
        assert before.t_ns < after.t_ns
        assert after.frame_id - before.frame_id == max(1, round((after.t_ns - before.t_ns) / period_ns))
        assert after.frame_id - before.frame_id == 1 + after.dropped_before


def test_frames_that_the_driver_drops_are_counted(camera, controls):
    controls.set("Percentage of Dropped Buffers", 50)
    frames = take(camera, 15)
    assert sum(frame.dropped_before for frame in frames) >= 3
    ids = [frame.frame_id for frame in frames]
    assert ids == sorted(set(ids))


def test_stamps_that_lie_in_the_future_are_not_believed(camera, controls, caplog):
    """`vivid` tells the end of a frame before that end has come."""
    controls.set("Timestamp Source", "End of Frame")
    assert {frame.t_source for frame in take(camera, 8)[-3:]} == {"arrival"}
    assert "arrival times are used" in caplog.text


def test_a_grab_shows_what_is_there_after_the_call(camera, controls):
    with camera.running():
        for pattern, low, high in [("100% Black", 0, 30), ("100% White", 220, 255)] * 4:
            controls.set("Test Pattern", pattern)
            frame = camera.grab(timeout_s=PATIENCE_S)
            assert low <= np.median(frame.image) <= high


@pytest.mark.parametrize(("fourcc", "kind"), [("GREY", np.uint8), ("YUYV", np.uint8), ("Y16", np.uint16)])
def test_every_pixel_format_shows_the_same_picture(make_camera, fourcc, kind):
    camera = make_camera(f"{SOURCE}&fourcc={fourcc}")
    camera.open()
    frame = camera.grab(timeout_s=PATIENCE_S)
    assert frame.image.dtype == kind
    assert frame.bit_depth == 8 * frame.image.itemsize
    ramp = frame.image.astype(float).mean(axis=0) / np.iinfo(kind).max
    assert ramp[600] - ramp[40] > 0.5
    assert np.all(np.diff(ramp) >= 0)


@pytest.mark.parametrize(
    "check",
    [
        "delivers_read_only_images_of_the_stated_size",
        "refuses_impossible_settings",
        "iterates_over_new_frames",
    ],
)
def test_conformance(camera, check):
    """The checks that need no truth about the exposures."""
    from tests.conformance.bench import CameraBench
    from tests.conformance.camera_suite import SUITE

    with camera.running():
        take(camera, 10)  # the first ones come unevenly
        SUITE.checks[check](CameraBench(camera, camera.clock, true_middle_ns=lambda _: 0))


@pytest.mark.parametrize(
    ("source", "size", "words"),
    [
        (SOURCE, (1280, 720), r"the camera has \(640, 480\) px, the rig file says \(1280, 720\)"),
        (f"v4l2://{DEVICE}?size=641x480", (641, 480), r"in the place of \(641, 480\)"),
        (f"v4l2://{DEVICE}?fourcc=Y800", (640, 480), "does not offer 'Y800'"),
    ],
)
def test_another_camera_than_the_rig_file_says_is_refused(make_camera, source, size, words):
    with pytest.raises(UnsupportedError, match=words):
        make_camera(source, size=size).open()
    make_camera().open()  # it was released


def test_a_second_opener_is_told_that_it_is_busy(camera, make_camera):
    second = make_camera()
    with pytest.raises(BusyError, match="another program uses /dev/video0"):
        second.open()
    with camera.running(), pytest.raises(BusyError, match="another program uses /dev/video0"):
        second.open()
    camera.close()
    second.open()


def unplug(controls):
    (DRIVER / "unbind").write_text("vivid.0")


def plug_in():
    if not (DRIVER / "vivid.0").exists():
        (DRIVER / "bind").write_text("vivid.0")


@pytest.mark.parametrize("how", [unplug, lambda controls: controls.set("Disconnect", 1)], ids=["unbind", "disconnect"])
def test_a_camera_that_vanishes_is_lost_at_once_and_usable_when_it_is_back(camera, controls, how):
    """At once: as LinkLost and not as a time-out."""
    serial_number = camera.info.serial_number
    try:
        stream = camera.frames(timeout_s=PATIENCE_S)
        next(stream)
        how(controls)
        with pytest.raises(LinkLost, match="eye: /dev/video0 has failed") as caught:
            list(stream)
        assert "cable" in caught.value.remedy
        assert camera.link == "lost"
        camera.close()
        if how is unplug:
            with pytest.raises(LinkLost, match="cannot open /dev/video0"):
                camera.open()
    finally:
        plug_in()
    camera.open()
    assert camera.info.serial_number == serial_number
    camera.grab(timeout_s=PATIENCE_S)
