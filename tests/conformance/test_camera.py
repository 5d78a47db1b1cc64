"""The camera suite over its implementations, and over drivers with planted faults."""

import msgspec
import pytest

from microdrivers.backends.camera.source_camera import SourceCamera
from microdrivers.core.errors import LinkTimeout, MicrodriversError
from tests.conformance.bench import camera_bench
from tests.conformance.camera_suite import SUITE


@pytest.mark.parametrize("name", SUITE.checks)
def test_source_camera_in_process(name):
    with camera_bench() as bench:
        SUITE.checks[name](bench)


class StaleFrame(SourceCamera):
    """Hands out what lies in the buffer, as OpenCV's queue does."""

    def grab(self, *, timeout_s=1.0):
        return self.topic.latest or super().grab(timeout_s=timeout_s)


class ArrivalStamp(SourceCamera):
    def _take(self, raw):
        super()._take(msgspec.structs.replace(raw, t_ns=self.clock.now_ns()))


class RepeatsFrames(SourceCamera):
    def _take(self, raw):
        super()._take(raw)
        super()._take(raw)


class ForgetsTheRegion(SourceCamera):
    def _take(self, raw):
        left, top = self.settings.roi[:2]
        self.principal_point_px, kept = (
            (self.principal_point_px[0] + left, self.principal_point_px[1] + top),
            (self.principal_point_px),
        )
        super()._take(raw)
        self.principal_point_px = kept


FOUND_BY = {
    StaleFrame: "grabs_a_frame_whose_exposure_began_after_the_call",
    ArrivalStamp: "stamps_mid_exposure",
    RepeatsFrames: "loses_and_repeats_no_frame",
    ForgetsTheRegion: "a_region_moves_the_principal_point",
}


@pytest.mark.parametrize("fault", FOUND_BY, ids=lambda fault: fault.__name__)
def test_a_planted_fault_is_found_by_name(fault):
    found = (AssertionError, pytest.fail.Exception, MicrodriversError)
    with camera_bench(fault) as bench, pytest.raises(found):
        SUITE.checks[FOUND_BY[fault]](bench)


def test_the_sound_driver_has_no_fault():
    assert SUITE.failing(camera_bench) == {}


def test_a_truncated_image_is_refused_and_counted(caplog):
    with camera_bench() as bench:
        camera = bench.camera
        whole = camera._take
        camera._take = lambda raw: whole(msgspec.structs.replace(raw, image=raw.image[:200].copy()))
        with pytest.raises(LinkTimeout, match="no frame"):
            camera.grab(timeout_s=0.3)
        assert camera.bad_frames > 3


def test_a_source_that_cannot_tell_the_time_gets_an_arrival_stamp_with_its_stated_uncertainty():
    with camera_bench() as bench:
        camera = bench.camera
        whole = camera._take
        camera._take = lambda raw: whole(msgspec.structs.replace(raw, t_ns=None))
        frame = camera.grab(timeout_s=1.0)
        assert frame.t_source == "arrival"
        assert frame.dt_ns == 20_000_000
