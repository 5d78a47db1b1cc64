"""The camera suite over HTTP, in real time; and cameras that are unplugged."""

from contextlib import contextmanager

import pytest

from microdrivers.core.errors import LinkLost, ProtocolError
from tests.conformance.camera_suite import SUITE
from tests.conformance.served_camera import served_camera

# One after the other: they run in real time.
pytestmark = pytest.mark.xdist_group("real_time")


@pytest.mark.parametrize("name", SUITE.checks)
def test_source_camera_over_http(name):
    @contextmanager
    def camera_alone():
        with served_camera() as (bench, _):
            yield bench

    SUITE.hold_in_real_time(name, camera_alone)


def test_an_unplugged_camera_wakes_who_waits_and_is_usable_when_it_is_back(record_property):
    with served_camera() as (bench, cable):
        camera, clock = bench.camera, bench.clock
        serial_number = camera.info.serial_number
        assert serial_number == "SIM-camera_fine"
        events = []
        camera.events.subscribe(lambda event: events.append((event.kind, event.t_ns)))
        pulled_ns = []

        def pull():
            pulled_ns.append(clock.now_ns())
            cable.unplug()

        stream = camera.frames(timeout_s=10.0)
        next(stream)
        clock.call_at(clock.now_ns(), pull)
        with pytest.raises(LinkLost, match="camera_fine"):
            for _ in stream:
                pass
        assert clock.now_ns() - pulled_ns[0] < 10 * 10**9  # not by the time-out
        assert camera.link == "lost"
        assert [kind for kind, _ in events] == ["link_lost"]
        record_property("noticed_ms", (events[0][1] - pulled_ns[0]) / 1e6)
        with pytest.raises(LinkLost, match="device is lost"):
            camera.grab()
        camera.close()
        clock.sleep(0.05)
        with pytest.raises((LinkLost, ProtocolError)):
            camera.open()
        cable.plug_in()
        camera.open()
        assert camera.info.serial_number == serial_number
        camera.grab()


def test_a_camera_that_comes_back_serves_who_still_waits():
    with served_camera() as (bench, cable):
        camera = bench.camera
        with camera.running():
            camera.grab()
            cable.unplug()
            camera.close()
            cable.plug_in()
            camera.open()
            camera.grab()


def test_two_programs_watch_the_same_camera():
    with served_camera() as (bench, _):
        from microdrivers.backends.camera.source_camera import SourceCamera

        second = SourceCamera("second", bench.camera._rig, clock=bench.clock, bus=bench.camera.bus)
        second.open()
        seen = {"camera_fine": {}, "second": {}}
        for camera in (bench.camera, second):
            camera.topic.subscribe(lambda frame: seen[frame.device].update({frame.frame_id: frame}))
        with bench.camera.running(), second.running():
            bench.clock.sleep(0.4)
        second.close()
        common = set(seen["camera_fine"]) & set(seen["second"])
        assert len(common) >= 5
        for frame_id in common:
            first, other = seen["camera_fine"][frame_id], seen["second"][frame_id]
            assert first.t_ns == other.t_ns
            assert (first.image == other.image).all()


def test_gain_and_settings_are_those_that_the_server_uses():
    with served_camera() as (bench, _):
        settings = bench.camera.configure(exposure_ms=3.14159, gain=5.0, rate_hz=20.0)
        assert (settings.exposure_ms, settings.gain, settings.rate_hz) == (3.14, 1.0, 20.0)
