"""What every camera must do, at the rate and with the sensor that its rig file states."""

from __future__ import annotations

import math

import pytest

from microdrivers.core.errors import OutOfRange
from microdrivers.core.samples import Frame
from microdrivers.core.units import NS_PER_MS, NS_PER_S
from tests.conformance.bench import CameraBench
from tests.conformance.checks import Suite

SUITE = Suite()


@SUITE.check
def grabs_a_frame_whose_exposure_began_after_the_call(bench: CameraBench) -> None:
    """No stale frame: by the true time of exposure, also with frames already under way."""
    with bench.camera.running():
        bench.clock.sleep(0.2)
        for pause_s in (0.0, 0.007, 0.013, 0.020, 0.031):
            bench.clock.sleep(pause_s)
            called_ns = bench.clock.now_ns()
            frame = bench.camera.grab()
            began_ns = bench.true_middle_ns(frame.frame_id) - round(frame.exposure_ms * NS_PER_MS / 2)
            assert began_ns >= called_ns


@SUITE.check
def stamps_mid_exposure(bench: CameraBench) -> None:
    """The stamp is that of mid-exposure within what is stated (three times the 95 % half-width)."""
    frames: list[Frame] = []
    bench.camera.topic.subscribe(frames.append)
    before_ns = bench.clock.now_ns() + 5 * NS_PER_S
    with bench.camera.running():
        while len(frames) < 12 and bench.clock.now_ns() < before_ns:
            bench.clock.sleep(0.1)
    assert len(frames) >= 12
    for frame in frames:
        assert abs(frame.t_ns - bench.true_middle_ns(frame.frame_id)) <= 3 * frame.dt_ns


@SUITE.check
def loses_and_repeats_no_frame(bench: CameraBench) -> None:
    frames: list[Frame] = []
    bench.camera.topic.subscribe(frames.append)
    with bench.camera.running():
        bench.clock.sleep(1.0)
    ids = [frame.frame_id for frame in frames]
    assert ids == list(range(ids[0], ids[0] + len(ids)))
    assert [frame.seq for frame in frames] == list(range(frames[0].seq, frames[0].seq + len(ids)))
    assert len(ids) == pytest.approx(bench.camera.settings.rate_hz, abs=2)


@SUITE.check
def delivers_read_only_images_of_the_stated_size(bench: CameraBench) -> None:
    frame = bench.camera.grab()
    width, height = bench.camera.sensor_size_px
    assert frame.image.shape == (height, width)
    with pytest.raises(ValueError, match="read-only"):
        frame.image[0, 0] = 0


@SUITE.check
def a_region_moves_the_principal_point(bench: CameraBench) -> None:
    whole = bench.camera.grab()
    settings = bench.camera.configure(roi=(100, 40, 400, 300))
    part = bench.camera.grab()
    assert settings.roi == (100, 40, 400, 300)
    assert part.image.shape == (300, 400)
    assert part.settings_id != whole.settings_id
    assert part.principal_point_px == pytest.approx(
        (whole.principal_point_px[0] - 100, whole.principal_point_px[1] - 40)
    )


@SUITE.check
def refuses_impossible_settings(bench: CameraBench) -> None:
    before = bench.camera.settings
    for bad in (
        {"exposure_ms": 1500.0 / bench.camera.settings.rate_hz},
        {"exposure_ms": -1.0},
        {"exposure_ms": math.nan},
        {"rate_hz": 0.0},
        {"roi": (bench.camera.sensor_size_px[0] - 40, 0, 100, 100)},
        {"roi": (0, 0, 0, 10)},
    ):
        with pytest.raises(OutOfRange):
            bench.camera.configure(**bad)
    assert bench.camera.settings == before


@SUITE.check
def iterates_over_new_frames(bench: CameraBench) -> None:
    stream = bench.camera.frames()
    first, second = next(stream), next(stream)
    stream.close()
    assert second.frame_id == first.frame_id + 1
