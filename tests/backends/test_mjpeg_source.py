"""Streams as the world sends them: with and without lengths, stamps and sense; from servers that die."""

import http.server
import threading
from contextlib import contextmanager, suppress

import cv2
import numpy as np
import pytest

from microdrivers.backends.camera import CameraDeviceSettings
from microdrivers.backends.camera.source_camera import SourceCamera
from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock, SystemClock
from microdrivers.core.errors import LinkLost, LinkTimeout, ProtocolError, UnsupportedError

# One after the other: they run in real time.
pytestmark = pytest.mark.xdist_group("real_time")

BOUNDARY = "multipart/x-mixed-replace; boundary=here"


def coded(image, suffix=".png"):
    return cv2.imencode(suffix, image)[1].tobytes()


def part(body, *headers, length=True):
    lines = ["--here", *headers, *([f"Content-Length: {len(body)}"] if length else [])]
    return "\r\n".join(lines).encode() + b"\r\n\r\n" + body + b"\r\n"


IMAGE = np.arange(48 * 64, dtype=np.uint32).reshape(48, 64).astype(np.uint8)


@contextmanager
def answering(answer):
    """A server that answers each request by `answer(handler, write)`."""
    ending = threading.Event()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            with suppress(ConnectionError):
                answer(self, ending)

        def log_message(self, *arguments):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield f"127.0.0.1:{server.server_address[1]}/x"
    finally:
        ending.set()
        server.shutdown()
        thread.join()
        server.server_close()


def stream_of(make_part, *, content_type=BOUNDARY, period_s=0.01, end=False):
    def answer(handler, ending):
        handler.send_response(200)
        handler.send_header("Content-Type", content_type)
        handler.end_headers()
        for number in range(1000):
            data = make_part(number)
            if data is None:
                break
            handler.wfile.write(data)
            if ending.wait(period_s):
                return
        if not end:
            ending.wait(10)

    return answer


@contextmanager
def camera_at(address, *, size=(64, 48), **settings):
    clock = SystemClock()
    rig = CameraDeviceSettings(
        source=f"mjpeg+http://{address}", sensor_size_px=size, pixel_pitch_um=5.0, **settings
    )  # fmt: skip
    camera = SourceCamera("eye", rig, clock=clock, bus=Bus())
    try:
        yield camera
    finally:
        camera.close()
        clock.close()
        clock.check()


@contextmanager
def watching(answer, **settings):
    with answering(answer) as address, camera_at(address, **settings) as camera:
        camera.open()
        yield camera


@pytest.mark.parametrize("length", [True, False])
@pytest.mark.parametrize("suffix", [".png", ".pgm"])
def test_lossless_images_arrive_bit_for_bit(length, suffix):
    with watching(stream_of(lambda _: part(coded(IMAGE, suffix), length=length))) as camera:
        assert (camera.grab().image == IMAGE).all()


def test_a_colour_jpeg_arrives_grey():
    colour = np.full((48, 64, 3), 77, np.uint8)
    with watching(stream_of(lambda _: part(coded(colour, ".jpg"), "Content-Type: image/jpeg"))) as camera:
        image = camera.grab().image
    assert image.shape == (48, 64)
    assert np.abs(image.astype(int) - 77).max() <= 1


@pytest.mark.parametrize("suffix", [".png", ".pgm"])
def test_sixteen_bits_are_kept(suffix):
    deep = IMAGE.astype(np.uint16) * 257
    with watching(stream_of(lambda _: part(coded(deep, suffix)))) as camera:
        frame = camera.grab()
        assert camera.settings.pixel_format == "mono16"
    assert frame.bit_depth == 16
    assert (frame.image == deep).all()


def test_stamps_of_this_computer_are_used():
    clock = SystemClock()

    def stamped(number):
        frame_id = 500 + number
        stamp_ns = (clock.now_ns() - 5_000_000) // 1000 * 1000 + frame_id
        return part(
            coded(IMAGE), f"Frame-Id: {frame_id}", f"timestamp: {stamp_ns}", "Timestamp-Uncertainty: 100000"
        )  # fmt: skip

    with watching(stream_of(stamped)) as camera:
        frame = camera.grab()
    assert frame.t_source == "device"
    assert 500 <= frame.frame_id < 1000
    assert frame.t_ns % 1000 == frame.frame_id
    assert frame.dt_ns == 100_000


@pytest.mark.parametrize(
    "headers",
    [
        lambda now: [],
        lambda now: [f"Timestamp: {now}"],  # how good it is remains unsaid
        lambda now: [f"Timestamp: {now + 3600 * 10**9}", "Timestamp-Uncertainty: 100"],
        lambda now: [f"Timestamp: {now - 3600 * 10**9}", "Timestamp-Uncertainty: 100"],
        lambda now: ["Timestamp: 1700000000.5", "Timestamp-Uncertainty: 100"],
    ],
    ids=["none", "uncertain", "future", "past", "other unit"],
)
def test_other_stamps_are_not_and_arrival_has_its_stated_uncertainty(headers):
    clock = SystemClock()
    answer = stream_of(lambda _: part(coded(IMAGE), *headers(clock.now_ns())))
    with watching(answer, arrival_delay_ms=8.0, arrival_uncertainty_ms=9.0) as camera:
        frame = camera.grab()
    assert frame.t_source == "arrival"
    assert frame.dt_ns == 9_000_000


def test_frames_that_a_slow_subscriber_kept_waiting_are_stamped_when_they_arrived():
    """Two frames arrive at nearly the same time, while a subscriber sleeps over the first."""
    with watching(stream_of(lambda number: part(coded(IMAGE)) if number < 3 else None)) as camera:
        frames = []

        def slow(frame):
            frames.append(frame)
            camera.clock.sleep(0.2)

        camera.topic.subscribe(slow)
        with camera.running():
            camera.clock.sleep(0.5)
    assert len(frames) >= 2
    assert frames[1].t_ns - frames[0].t_ns < 150_000_000


def test_damaged_images_are_left_out_and_counted_as_dropped():
    with watching(stream_of(lambda number: part(b"no image" if number in (2, 3) else coded(IMAGE)))) as camera:
        frames = []
        for frame in camera.frames():
            frames.append(frame)
            if frame.dropped_before:
                break
    assert frames[-1].dropped_before == 2


def test_the_end_of_the_stream_is_noticed_at_once():
    with watching(stream_of(lambda number: part(coded(IMAGE)) if number < 5 else None, end=True)) as camera:
        events = []
        camera.events.subscribe(events.append)
        began_ns = camera.clock.now_ns()
        with pytest.raises(LinkLost, match="eye: the stream ended"):
            for _ in camera.frames(timeout_s=20.0):
                pass
        assert camera.clock.now_ns() - began_ns < 10 * 10**9  # long before the time-out
        assert [event.kind for event in events] == ["link_lost"]
        assert camera.link == "lost"
        with pytest.raises(LinkLost, match="device is lost"):
            camera.grab()
        camera.close()
        camera.open()
        assert camera.grab().image.shape == (48, 64)


def test_a_stream_that_ends_inside_a_frame_is_lost():
    torn = part(coded(IMAGE))[:-40]
    with (
        watching(stream_of(lambda number: [part(coded(IMAGE)), torn, None][number], end=True)) as camera,
        pytest.raises(LinkLost, match="inside a frame"),
    ):
        list(camera.frames(timeout_s=20.0))


def test_garbage_is_a_lost_link():
    garbage = b"--here\r\nContent-Length: -7\r\n\r\n"
    with (
        watching(stream_of(lambda number: part(coded(IMAGE)) if number < 3 else garbage)) as camera,
        pytest.raises(LinkLost, match=r"garbled.*impossible length"),
    ):
        list(camera.frames(timeout_s=20.0))


def test_a_stream_that_stands_still_is_a_timeout_not_an_old_frame():
    with watching(stream_of(lambda number: part(coded(IMAGE)) if number < 2 else None)) as camera, camera.running():
        camera.clock.sleep(0.1)
        with pytest.raises(LinkTimeout, match="no frame exposed after the call"):
            camera.grab(timeout_s=0.2)


def test_a_stream_offers_neither_regions_nor_binning():
    with watching(stream_of(lambda _: part(coded(IMAGE)))) as camera:
        before = camera.settings
        with pytest.raises(UnsupportedError, match="whole images"):
            camera.configure(roi=(0, 0, 10, 10))
        with pytest.raises(UnsupportedError, match="binning"):
            camera.configure(binning=2)
        with camera.running(), pytest.raises(UnsupportedError):
            camera.configure(binning=2)
        assert camera.settings == before
        assert camera.grab().image.shape == (48, 64)


def test_nobody_there():
    with answering(stream_of(lambda _: None)) as address:
        pass
    with camera_at(address) as camera, pytest.raises(LinkLost, match=r"eye: nobody answers at 127\.0\.0\.1") as caught:
        camera.open()
    assert "microdrivers serve" in caught.value.remedy


@pytest.mark.parametrize(
    ("answer", "error", "words"),
    [
        (lambda handler, _: handler.send_error(404), ProtocolError, "404"),
        (stream_of(lambda _: b"<html>", content_type="text/html", end=True), ProtocolError, "sends text/html"),
        (stream_of(lambda _: part(b"no image"), end=True), ProtocolError, "no images"),
        (lambda handler, _: handler.wfile.write(b"SSH-2.0-OpenSSH_9.2\r\n"), LinkLost, "does not answer in HTTP"),
        (stream_of(lambda _: None, end=True), LinkLost, "ended"),
    ],
    ids=["404", "web page", "no image", "no HTTP", "empty"],
)
def test_other_servers_are_refused(answer, error, words):
    with answering(answer) as address, camera_at(address) as camera:
        with pytest.raises(error, match=words):
            camera.open()
        assert camera.link == "closed"


def test_a_wrong_size_is_refused():
    with (
        answering(stream_of(lambda _: part(coded(IMAGE)))) as address,
        camera_at(address, size=(640, 480)) as camera,
        pytest.raises(UnsupportedError, match=r"\(64, 48\) px, the rig file says \(640, 480\)"),
    ):
        camera.open()


def test_another_camera_in_its_place_is_refused():
    numbers = iter(["A1", "A1", "B2", "A1"])

    def answer(handler, ending):
        handler.send_response(200)
        handler.send_header("Content-Type", BOUNDARY)
        handler.send_header("Serial-Number", next(numbers))
        handler.end_headers()
        handler.wfile.write(part(coded(IMAGE)))

    with watching(answer) as camera:
        camera.close()
        camera.open()
        camera.close()
        with pytest.raises(UnsupportedError, match="camera B2 answers in the place of A1"):
            camera.open()
        camera.open()


def test_a_simulated_clock_is_refused():
    rig = CameraDeviceSettings(source="mjpeg+http://127.0.0.1:9/x", sensor_size_px=(64, 48), pixel_pitch_um=5.0)
    camera = SourceCamera("eye", rig, clock=SimulatedClock(), bus=Bus())
    with pytest.raises(UnsupportedError, match="simulated clock"):
        camera.open()
