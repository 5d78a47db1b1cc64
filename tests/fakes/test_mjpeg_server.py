"""The emulated camera's HTTP stream, read with the standard library and with OpenCV, not with the project's driver."""

import http.client
import socket
import urllib.parse
from contextlib import contextmanager

import cv2
import msgspec
import numpy as np
import pytest

from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock, SystemClock
from microdrivers.core.errors import LinkLost, UnsupportedError
from microdrivers.devices.camera import CameraSettings, RawFrame
from microdrivers.devices.drivers import WorldRequest
from microdrivers.fakes.camera.mjpeg_server import MjpegServer, _Sensor, _Viewer
from microdrivers.fakes.camera.source import FakeFrameSource
from microdrivers.fakes.camera.stream_format import CODINGS
from microdrivers.fakes.world import WORLD
from microdrivers.fakes.world.settings import WorldSettings

# One after the other: they run in real time.
pytestmark = pytest.mark.xdist_group("real_time")

SETTINGS = CameraSettings(
    exposure_ms=2.0, gain=1.0, rate_hz=50.0, roi=(0, 0, 160, 120), binning=1, pixel_format="mono8"
)


def make_source(clock):
    world = WORLD.build(WorldRequest(settings=WorldSettings(), rig={}, seed=1, clock=clock, bus=Bus()))
    return FakeFrameSource(
        "eye", world, clock=clock, sensor_size_px=(160, 120), principal_point_px=(79.5, 59.5), seed=1
    )  # fmt: skip


@contextmanager
def serving():
    clock = SystemClock()
    server = MjpegServer("eye", make_source(clock), SETTINGS, clock=clock)
    try:
        yield server
    finally:
        server.close()
        server.close()
        clock.close()
        clock.check()


class Client:
    """A viewer of its own making."""

    def __init__(self, server, query="", *, path=None, accept="*/*"):
        url = urllib.parse.urlsplit(server.url.removeprefix("mjpeg+"))
        self.connection = http.client.HTTPConnection(url.hostname, url.port, timeout=5.0)
        self.connection.request("GET", f"{path or url.path}?{query}", headers={"Accept": accept})
        self.response = self.connection.getresponse()
        self.headers = self.response.headers

    def part(self):
        assert self.response.readline() == b"--frame\r\n"
        headers = http.client.parse_headers(self.response)
        body = self.response.read(int(headers["Content-Length"]))
        assert self.response.readline() == b"\r\n"
        return headers, body

    def image(self):
        headers, body = self.part()
        return int(headers["Frame-Id"]), cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_UNCHANGED)

    def close(self):
        self.response.close()
        self.connection.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def test_frames_come_with_identity_settings_and_stamps():
    clock = SystemClock()
    with serving() as server, Client(server) as client:
        assert client.headers["Content-Type"] == "multipart/x-mixed-replace; boundary=frame"
        assert client.headers["Serial-Number"] == "SIM-eye"
        assert client.headers["Sensor-Size"] == "160x120"
        assert [client.headers[key] for key in ("Rate-Hz", "Exposure-Ms", "Roi")] == ["50.0", "2.0", "0,0,160,120"]
        parts = [client.part()[0] for _ in range(4)]
        now_ns = clock.now_ns()
    stamps = [int(headers["Timestamp"]) for headers in parts]
    ids = [int(headers["Frame-Id"]) for headers in parts]
    assert [headers["Content-Type"] for headers in parts] == ["image/png"] * 4
    assert 0 < now_ns - stamps[-1] < 10 * 10**9
    assert int(parts[0]["Timestamp-Uncertainty"]) == 100_000
    for i in range(1, 4):
        assert (stamps[i] - stamps[0]) / (ids[i] - ids[0]) == pytest.approx(20e6, rel=0.01)


@pytest.mark.parametrize(
    ("query", "accept", "media_type"),
    [
        ("", "text/html, */*", "image/png"),
        ("", "image/x-portable-graymap, image/png", "image/x-portable-graymap"),
        ("format=jpeg", "image/png", "image/jpeg"),
        ("format=pgm", "*/*", "image/x-portable-graymap"),
    ],
)
def test_the_viewer_chooses_the_coding(query, accept, media_type):
    with serving() as server, Client(server, query, accept=accept) as client:
        headers, body = client.part()
        assert headers["Content-Type"] == media_type
        assert cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_UNCHANGED).shape == (120, 160)


def test_lossless_codings_agree():
    with (
        serving() as server,
        Client(server, "format=png") as png,
        Client(server, "format=pgm") as pgm,
        Client(server, "format=png") as third,
    ):
        seen = [dict(client.image() for _ in range(6)) for client in (png, pgm, third)]
    common = set(seen[0]) & set(seen[1]) & set(seen[2])
    assert common
    for frame_id in common:
        assert (seen[0][frame_id] == seen[1][frame_id]).all()
        assert (seen[0][frame_id] == seen[2][frame_id]).all()


def test_settings_are_asked_for_and_the_ones_really_used_are_told():
    with serving() as server, Client(server, "rate_hz=100&exposure_ms=3.14159&roi=10,20,64,48") as client:
        assert [client.headers[key] for key in ("Rate-Hz", "Exposure-Ms", "Roi")] == ["100.0", "3.14", "10,20,64,48"]
        assert client.image()[1].shape == (48, 64)


def test_whoever_watches_keeps_his_settings_and_the_next_is_told_them():
    with serving() as server:
        with Client(server, "rate_hz=40") as first:
            first.part()
            with Client(server, "rate_hz=80&roi=0,0,20,20") as second:
                assert second.headers["Rate-Hz"] == "40.0"
                assert second.image()[1].shape == (120, 160)
            assert first.image()[1].shape == (120, 160)
        with Client(server, "rate_hz=80") as third:
            assert third.headers["Rate-Hz"] == "80.0"


def test_frame_numbers_go_on_from_viewer_to_viewer():
    with serving() as server:
        with Client(server) as first:
            number = first.image()[0]
        with Client(server, "roi=0,0,20,20") as second:
            assert second.image()[0] > number


def test_late_frames_of_earlier_settings_and_frames_out_of_order_are_not_shown():
    clock = SystemClock()
    sensor = _Sensor(make_source(clock), SETTINGS, clock)
    here, there = socket.socketpair()
    viewer = _Viewer(here, CODINGS["pgm"], clock)

    def show(run, frame_id):
        sensor._show(run, RawFrame(image=np.zeros((120, 160), np.uint8), frame_id=frame_id, t_ns=None, dt_ns=0))
        return viewer.frame_id

    with here, there:
        sensor.join(viewer, msgspec.structs.replace(SETTINGS, rate_hz=0.1))
        now = sensor._run
        assert [show(now, 7), show(now - 1, 8), show(now, 6), show(now, 9)] == [7, 7, 7, 9]
        sensor.leave(viewer)
    clock.close()


def test_a_slow_viewer_gets_new_frames_and_sees_what_it_missed():
    with serving() as server, Client(server, "format=pgm") as slow, Client(server) as quick:
        first = slow.image()[0]
        for _ in range(40):
            newest = quick.image()[0]
        # What fits into the sockets' buffers is old; then there is a gap up to the present.
        ids = [first]
        while ids[-1] < newest:
            ids.append(slow.image()[0])
        assert ids == sorted(set(ids))


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("rate_hz=0", "rate_hz must be a positive number"),
        ("rate_hz=nan", "rate_hz must be a positive number"),
        ("rate_hz=fast", "could not convert"),
        ("exposure_ms=30", "does not fit"),
        ("roi=0,0,161,120", "does not fit the sensor"),
        ("roi=0,0,10", "left,top,width,height"),
        ("format=gif", "format must be one of"),
        ("exposure=3", "unknown: exposure"),
        ("rate_hz", "bad query"),
    ],
)
def test_bad_requests_are_refused_with_words(query, words):
    with serving() as server, Client(server, query) as client:
        assert client.response.status == 400
        assert words in client.response.read().decode()


def test_other_paths_are_not_there():
    with serving() as server, Client(server, path="/other") as client:
        assert client.response.status == 404


def test_the_sensor_runs_only_while_somebody_watches():
    with serving() as server:
        source = server._sensor.source
        assert source._timer is None
        with Client(server) as client:
            client.part()
            assert source._timer is not None
        for _ in range(200):
            if source._timer is None:
                break
            server._clock.sleep(0.01)
        assert source._timer is None


def test_unplugging_ends_the_streams_and_plugging_in_brings_the_same_address_back():
    with serving() as server:
        url = server.url
        with Client(server) as client:
            client.part()
            server.unplug()
            while client.response.read(65536):
                pass
        with pytest.raises(ConnectionRefusedError):
            Client(server)
        server.plug_in()
        server.plug_in()
        assert server.url == url
        with Client(server) as client:
            client.part()


def test_a_sensor_that_is_disconnected_ends_the_streams_and_refuses_new_ones_until_it_is_back():
    with serving() as server:
        with Client(server) as client:
            client.part()
            server._sensor.source.connected = False
            while client.response.read(65536):
                pass
        with Client(server) as client:
            assert client.response.status == 503
        server._sensor.source.connected = True
        with Client(server) as client:
            client.part()


def test_opencv_reads_the_stream():
    with serving() as server:
        capture = cv2.VideoCapture(server.url.removeprefix("mjpeg+") + "?format=jpeg", cv2.CAP_FFMPEG)
        try:
            assert capture.isOpened()
            for _ in range(3):
                there, image = capture.read()
                assert there
                assert image.shape == (120, 160, 3)
        finally:
            capture.release()


def test_an_address_in_use_is_a_typed_error():
    clock = SystemClock()
    with serving() as server:
        port = urllib.parse.urlsplit(server.url).port
        with pytest.raises(LinkLost, match="cannot listen on"):
            MjpegServer("eye", make_source(clock), SETTINGS, clock=clock, port=port)


def test_a_simulated_clock_is_refused():
    clock = SimulatedClock()
    with pytest.raises(UnsupportedError, match="real time"):
        MjpegServer("eye", make_source(clock), SETTINGS, clock=clock)
