"""Video4Linux cameras: what is asked of the device and in which order, its errors, and its stamps.

The device is scripted at OpenCV's door: a container has none.
"""

import os
import subprocess
import sys
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest

from microdrivers.backends.camera import CameraDeviceSettings, opencv_source
from microdrivers.backends.camera.source_camera import SourceCamera
from microdrivers.backends.camera.v4l2_node import NodeInfo, query_node
from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock, SystemClock
from microdrivers.core.errors import BusyError, LinkLost, LinkTimeout, UnsupportedError
from microdrivers.devices.frame_sources import find_frame_source

# One after the other: they run in real time.
pytestmark = pytest.mark.xdist_group("real_time")

YUYV = cv2.VideoWriter.fourcc(*"YUYV")
GREY = cv2.VideoWriter.fourcc(*"GREY")


class ScriptedCapture:
    """A camera of 64×48 px behind OpenCV's interface; `buffers` are those that wait in the driver's queue."""

    formats = (GREY, YUYV)
    opened = True
    stamps = True
    tells_exposure = True
    buffers = 0
    frames = 1_000_000
    instances: ClassVar[list[Any]] = []

    def __init__(self, path, api):
        assert api == cv2.CAP_V4L2
        self.path = path
        self.asked = []
        self.values = {
            cv2.CAP_PROP_FOURCC: self.formats[0], cv2.CAP_PROP_FRAME_WIDTH: 32, cv2.CAP_PROP_FRAME_HEIGHT: 24,
            cv2.CAP_PROP_FPS: 15.0, cv2.CAP_PROP_BUFFERSIZE: 4, cv2.CAP_PROP_AUTO_EXPOSURE: 3,
            cv2.CAP_PROP_EXPOSURE: 157, cv2.CAP_PROP_GAIN: 32,
        }  # fmt: skip
        self.clock = SystemClock()
        self.released = False
        self.stamp_ms = 0.0
        self.number = 0
        type(self).instances.append(self)

    def isOpened(self):
        return self.opened

    def release(self):
        self.released = True

    def set(self, key, value):
        self.asked.append(key)
        if key == cv2.CAP_PROP_FOURCC and value not in self.formats:
            return False
        if key == cv2.CAP_PROP_EXPOSURE and not self.tells_exposure:
            return False
        limits = {
            cv2.CAP_PROP_FRAME_WIDTH: 64, cv2.CAP_PROP_FRAME_HEIGHT: 48, cv2.CAP_PROP_FPS: 30.0,
            cv2.CAP_PROP_GAIN: 100,
        }  # fmt: skip
        self.values[key] = min(value, limits.get(key, value))
        return True

    def get(self, key):
        if key == cv2.CAP_PROP_POS_MSEC:
            return self.stamp_ms if self.stamps else 0.0
        if key == cv2.CAP_PROP_AUTO_EXPOSURE and not self.tells_exposure:
            return -1.0
        return float(self.values.get(key, -1))

    def grab(self):
        if self.buffers:
            self.buffers -= 1
        else:
            self.clock.sleep(0.01)
        self.number += 1
        self.stamp_ms = self.clock.now_ns() / 1e6 - 3.0
        return self.number <= self.frames

    @staticmethod
    def waitAny(captures, timeoutNs):
        return True, [0]

    def retrieve(self):
        if self.values[cv2.CAP_PROP_FOURCC] == YUYV:
            return True, np.dstack([np.full((48, 64), self.number % 250), np.full((48, 64), 128)]).astype(np.uint8)
        return True, np.full((48, 64), self.number % 250, np.uint8)


@pytest.fixture
def scripted(monkeypatch):
    class Capture(ScriptedCapture):
        instances: ClassVar[list[Any]] = []

    monkeypatch.setattr(cv2, "VideoCapture", Capture)
    info = NodeInfo("uvcvideo", "Some Camera", "usb-0000:00:14.0-1")
    monkeypatch.setattr(opencv_source, "query_node", lambda path: info)
    return Capture


@pytest.fixture
def make_camera():
    clock = SystemClock()
    cameras = []

    def make(source="v4l2:///dev/video0", *, size=(64, 48), **settings):
        rig = CameraDeviceSettings(source=source, sensor_size_px=size, pixel_pitch_um=5.0, **settings)
        cameras.append(SourceCamera("eye", rig, clock=clock, bus=Bus()))
        return cameras[-1]

    yield make
    for camera in cameras:
        camera.close()
    clock.close()
    clock.check()


def test_settings_are_made_in_an_order_that_drivers_take_and_read_back(scripted, make_camera):
    camera = make_camera("v4l2://7", exposure_ms=2.04, gain=500.0, rate_hz=60.0)
    camera.open()
    (capture,) = scripted.instances
    assert capture.path == "/dev/video7"
    order = [capture.asked.index(key) for key in (cv2.CAP_PROP_FOURCC, cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FPS)]
    assert order == sorted(order)
    assert capture.asked.index(cv2.CAP_PROP_AUTO_EXPOSURE) < capture.asked.index(cv2.CAP_PROP_EXPOSURE)
    assert capture.values[cv2.CAP_PROP_BUFFERSIZE] == 1
    assert capture.values[cv2.CAP_PROP_AUTO_EXPOSURE] == 1
    assert (camera.settings.exposure_ms, camera.settings.gain, camera.settings.rate_hz) == (2.0, 100.0, 30.0)
    assert camera.info.model == "Some Camera"
    camera.close()
    assert capture.released


def test_an_exposure_that_is_not_told_is_taken_to_last_the_period(scripted, make_camera):
    scripted.tells_exposure = False
    camera = make_camera(rate_hz=25.0, exposure_ms=1.0)
    camera.open()
    assert camera.settings.exposure_ms == pytest.approx(40.0)


def test_settings_can_be_changed_where_the_exposure_is_not_told(scripted, make_camera):
    """A third of 100 ms is no fraction that a float holds: the whole period must still fit the rate."""
    scripted.tells_exposure = False
    camera = make_camera(rate_hz=30.0, exposure_ms=1.0)
    camera.open()
    assert camera.configure(gain=2.0).gain == 2.0


def test_the_luminance_of_yuyv_is_taken_as_it_is(scripted, make_camera):
    scripted.formats = (YUYV,)
    camera = make_camera()
    camera.open()
    frame = camera.grab()
    assert frame.image.shape == (48, 64)
    assert (frame.image == frame.frame_id % 250).all()


@pytest.mark.parametrize(
    ("option", "delay_ms", "uncertainty_ms"),
    [("stamp=start&stamp_uncertainty_ms=0.2", 2.0, 0.2), ("stamp=end", 4.0, 1.0), ("", 3.0 + 50 / 3, 50 / 3 + 2.0)],
)
def test_stamps_are_moved_to_mid_exposure(scripted, make_camera, option, delay_ms, uncertainty_ms):
    camera = make_camera(f"v4l2:///dev/video0?{option}", exposure_ms=2.0)
    camera.open()
    capture = scripted.instances[0]
    seen = []
    camera.topic.subscribe(lambda frame: seen.append((frame, capture.clock.now_ns())))
    camera.grab()
    frame, seen_ns = seen[0]
    assert frame.t_source == "device"
    assert frame.dt_ns == pytest.approx(uncertainty_ms * 1e6, abs=1)
    assert seen_ns - frame.t_ns >= delay_ms * 1e6 - 1


def test_without_monotonic_stamps_arrival_is_used(scripted, make_camera):
    scripted.stamps = False
    camera = make_camera(arrival_delay_ms=5.0, arrival_uncertainty_ms=6.0)
    camera.open()
    frame = camera.grab()
    assert frame.t_source == "arrival"
    assert frame.dt_ns == 6_000_000


def test_a_stamp_from_the_future_ends_the_trust_in_them(scripted, make_camera, caplog):
    camera = make_camera()
    camera.open()
    capture = scripted.instances[0]
    assert camera.grab().t_source == "device"
    honest = capture.get
    capture.get = lambda key: honest(key) + (1e6 if key == cv2.CAP_PROP_POS_MSEC else 0)
    assert camera.grab().t_source == "arrival"
    capture.get = honest
    assert camera.grab().t_source == "arrival"
    assert caplog.text.count("arrival times are used") == 1


def test_a_camera_that_is_silent_can_be_stopped(scripted, make_camera, monkeypatch):
    camera = make_camera()
    camera.open()
    monkeypatch.setattr(scripted, "waitAny", staticmethod(lambda captures, timeoutNs: (False, [])))
    with pytest.raises(LinkTimeout, match="no frame exposed after the call"):
        camera.grab(timeout_s=0.05)


def test_frames_left_in_the_queue_since_the_last_time_are_not_delivered(scripted, make_camera):
    """Without stamps an old frame would look new."""
    scripted.stamps = False
    camera = make_camera()
    camera.open()
    capture = scripted.instances[0]
    camera.grab()
    capture.values[cv2.CAP_PROP_BUFFERSIZE] = 3  # a driver that does not do with less
    capture.buffers, before = 3, capture.number
    stream = camera.frames()
    first = next(stream)
    stream.close()
    assert first.image[0, 0] == before + 4


def test_frames_that_the_driver_dropped_show_in_the_counter(scripted, make_camera):
    camera = make_camera(rate_hz=30.0)
    camera.open()
    capture = scripted.instances[0]
    capture.clock.sleep(0)
    frames = []
    camera.topic.subscribe(frames.append)
    with camera.running():
        camera.clock.sleep(0.05)
        capture.buffers = 0
        honest, capture.grab = capture.grab, lambda: (capture.clock.sleep(0.13), honest())[1]
        camera.clock.sleep(0.3)
    assert max(frame.dropped_before for frame in frames) >= 3


def failing_wait(captures, timeoutNs):
    raise cv2.error("Error is reported for camera stream: 0")


@pytest.mark.parametrize("by", ["grab", "wait"])
def test_a_camera_that_disappears_is_a_typed_error_without_a_timeout(scripted, make_camera, monkeypatch, by):
    scripted.frames = 3 if by == "grab" else 1_000_000
    if by == "wait":
        monkeypatch.setattr(scripted, "waitAny", staticmethod(failing_wait))
    camera = make_camera()
    camera.open()
    began_ns = camera.clock.now_ns()
    with pytest.raises(LinkLost, match="eye: /dev/video0 has failed") as caught:
        list(camera.frames(timeout_s=30.0))
    assert camera.clock.now_ns() - began_ns < 10 * 10**9
    assert "cable" in caught.value.remedy
    assert camera.link == "lost"
    scripted.frames = 1_000_000
    monkeypatch.setattr(scripted, "waitAny", ScriptedCapture.waitAny)
    camera.close()
    camera.open()
    camera.grab()


@pytest.mark.parametrize("change", [{"roi": (0, 0, 10, 10)}, {"binning": 2}])
def test_regions_and_binning_are_refused(scripted, make_camera, change):
    camera = make_camera()
    camera.open()
    with pytest.raises(UnsupportedError, match="whole images"):
        camera.configure(**change)
    assert camera.grab().image.shape == (48, 64)


@pytest.mark.parametrize(
    ("source", "size", "words"),
    [
        ("v4l2:///dev/video0", (640, 480), r"the camera has \(64, 48\) px, the rig file says \(640, 480\)"),
        ("v4l2:///dev/video0?size=640x480", (640, 480), r"offers \(64, 48\) px in the place of \(640, 480\)"),
        ("v4l2:///dev/video0?fourcc=Y16", (64, 48), "does not offer 'Y16 '"),
        ("v4l2:///dev/video0?colour=1", (64, 48), "option colour='1' of a v4l2 source"),
        ("v4l2:///dev/video0?size=big", (64, 48), "option size='big'"),
        ("v4l2:///dev/video0?stamp_uncertainty_ms=0", (64, 48), "option stamp_uncertainty_ms='0'"),
    ],
)
def test_what_the_camera_does_not_offer_is_refused(scripted, make_camera, source, size, words):
    with pytest.raises(UnsupportedError, match=words):
        make_camera(source, size=size).open()
    assert all(capture.released for capture in scripted.instances)


def test_a_device_that_another_program_uses(scripted, make_camera):
    scripted.opened = False
    with pytest.raises(BusyError, match="another program uses /dev/video0"):
        make_camera().open()


def test_a_missing_device_is_told_with_a_remedy(make_camera):
    with pytest.raises(LinkLost, match="eye: cannot open /dev/video99: No such file") as caught:
        make_camera("v4l2:///dev/video99").open()
    assert "--fake" in caught.value.remedy


def test_a_device_that_is_no_camera():
    with pytest.raises(UnsupportedError, match="/dev/null is not a video device"):
        query_node("/dev/null")


@pytest.mark.parametrize(
    ("failure", "error", "words"),
    [
        (PermissionError(13, "Permission denied"), LinkLost, "group that owns it"),
        (OSError(16, "Device or resource busy"), BusyError, "fuser"),
        (OSError(19, "No such device"), LinkLost, "cable"),
    ],
)
def test_devices_that_cannot_be_opened(monkeypatch, failure, error, words):
    def refuse(*_):
        raise failure

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(error) as caught:
        query_node("/dev/video0")
    assert words in caught.value.remedy


def test_a_simulated_clock_is_refused():
    with pytest.raises(UnsupportedError, match="/dev/video0 is a real device and cannot run on a simulated clock"):
        find_frame_source("v4l2:///dev/video0", SimulatedClock()).open()


def test_an_unknown_source_lists_the_known_ones():
    with pytest.raises(UnsupportedError, match=r"known: .*images, mjpeg\+http, v4l2, video"):
        find_frame_source("telepathy://x", SimulatedClock())


def test_opencv_is_not_imported_before_a_camera_opens():
    program = (
        "import sys; from microdrivers.backends.camera import DRIVER, CameraDeviceSettings as S;"
        "from microdrivers.core.bus import Bus; from microdrivers.core.clock import SimulatedClock;"
        "s = S(source='v4l2://0', sensor_size_px=(4, 4), pixel_pitch_um=1.0);"
        "DRIVER.create('eye', s, SimulatedClock(), Bus()); sys.exit('cv2' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
