from __future__ import annotations

import csv
import math
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.errors import DataError, OutOfRange
from microdrivers.core.samples import Frame, TrackedPoint
from microdrivers.estimators.vision import TextureTracker

DATA = Path(__file__).parents[2] / "data" / "micrograph_sequence"


class Microscope:
    """Frames of one analytic texture."""

    def __init__(self, scene: ModuleType, textures: ModuleType, *, seed: int = 0) -> None:
        self._scene = scene
        self._texture = textures.Texture(seed)
        self._rng = np.random.default_rng(seed)
        self._seq = -1

    def show(self, *, gain: float = 1.0, bias: float = 120.0, noise: float = 1.5, **view: Any) -> Frame:
        grey = bias + gain * self._texture.grey(**view)
        return self.frame(self._scene.digitise(grey, noise=noise, rng=self._rng))

    def blank(self, level: float = 120.0, noise: float = 2.0) -> Frame:
        return self.frame(self._scene.digitise(np.full((240, 320), level), noise=noise, rng=self._rng))

    def frame(self, image: npt.NDArray[Any], **more: Any) -> Frame:
        self._seq += 1
        frame = self._scene.frame(image, seq=self._seq, **more)
        assert isinstance(frame, Frame)
        return frame


@pytest.fixture
def microscope(scene: ModuleType, textures: ModuleType) -> Microscope:
    return Microscope(scene, textures)


def assert_lost(point: TrackedPoint, flag: str) -> None:
    assert not point.found
    assert point.flags == {flag}
    assert all(math.isnan(x) for x in (point.u_px, point.v_px, point.sigma_px))


def test_real_micrograph_to_a_hundredth_of_a_pixel(scene: ModuleType) -> None:
    with (DATA / "truth.csv").open() as file:
        truth = [(row["file"], float(row["u_px"]), float(row["v_px"])) for row in csv.DictReader(file)]
    tracker = TextureTracker()
    errors, sigmas = [], []
    for seq, (name, u, v) in enumerate(truth):
        image = cv2.imread(str(DATA / name), cv2.IMREAD_UNCHANGED)
        assert image is not None
        point = tracker.update(scene.frame(image, seq=seq))
        assert point.found, tracker.last_reason
        errors.append((point.u_px + 159.5 - u, point.v_px + 119.5 - v))
        sigmas.append(point.sigma_px)
    assert len(errors) == 30
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert rms.max() < 0.003
    assert np.mean(rms) == pytest.approx(np.mean(sigmas), rel=0.5)


@settings(deadline=None, max_examples=15, derandomize=True)
@given(u=st.floats(-60, 60), v=st.floats(-60, 60), seed=st.integers(0, 50))
def test_any_jump_within_60_px_is_found(scene: ModuleType, textures: ModuleType, u: float, v: float, seed: int) -> None:
    microscope = Microscope(scene, textures, seed=seed)
    tracker = TextureTracker()
    start = tracker.update(microscope.show())
    assert (start.u_px, start.v_px) == (0.0, 0.0)
    moved = tracker.update(microscope.show(shift=(u, v)))
    assert moved.found, tracker.last_reason
    # The noise of the one template frame enters too.
    assert (moved.u_px, moved.v_px) == pytest.approx((u, v), abs=8 * moved.sigma_px)
    assert moved.sigma_px < 0.01


def test_the_tracked_point_need_not_be_the_centre(microscope: Microscope) -> None:
    tracker = TextureTracker(point_px=(30.3, -21.6))
    start = tracker.update(microscope.show())
    moved = tracker.update(microscope.show(shift=(-12.5, 7.25)))
    assert (start.u_px, start.v_px) == pytest.approx((30.3, -21.6), abs=1e-3)
    assert (moved.u_px, moved.v_px) == pytest.approx((17.8, -14.35), abs=0.02)


def test_the_principal_point_of_each_frame_is_its_origin(
    scene: ModuleType, textures: ModuleType, microscope: Microscope
) -> None:
    image = microscope.show().image
    tracker = TextureTracker()
    first = tracker.update(microscope.frame(image, principal_point_px=(150.25, 100.5)))
    second = tracker.update(microscope.frame(image, principal_point_px=(155.25, 98.5)))
    assert (first.u_px, first.v_px) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert (second.u_px, second.v_px) == pytest.approx((-5.0, 2.0), abs=1e-6)


def test_errors_do_not_add_up_over_many_frames(microscope: Microscope) -> None:
    tracker = TextureTracker()
    errors = []
    for k in range(60):
        shift = (0.47 * k, -0.31 * k)
        point = tracker.update(microscope.show(shift=shift, noise=4.0))
        assert point.found
        errors.append((point.u_px - shift[0], point.v_px - shift[1]))
    # Frame to frame, errors of 0.006 px would grow to 0.05 px.
    assert np.abs(errors[1:]).max() < 0.025
    early, late = np.array(errors[1:21]), np.array(errors[-20:])
    assert np.abs(late.mean(axis=0) - early.mean(axis=0)).max() < 0.008


def test_the_template_is_never_renewed(microscope: Microscope) -> None:
    # A slow growth, small from frame to frame: an updated template would follow it without noticing.
    tracker = TextureTracker()
    outcomes = [tracker.update(microscope.show(scale=1.0 + 0.001 * k)) for k in range(12)]
    assert [point.found for point in outcomes[:4]] == [True] * 4
    assert_lost(outcomes[-1], "appearance_changed")


def test_light_may_change(microscope: Microscope) -> None:
    tracker = TextureTracker()
    tracker.update(microscope.show())
    for gain, bias in ((0.5, 60.0), (1.4, 110.0), (1.0, 150.0)):
        point = tracker.update(microscope.show(gain=gain, bias=bias, shift=(10.4, -5.7)))
        assert (point.u_px, point.v_px) == pytest.approx((10.4, -5.7), abs=0.03)


@pytest.mark.parametrize("view", [{"scale": 0.243 / 0.182}, {"scale": 1.05}, {"scale": 1.01}, {"angle_deg": 2.0}])
def test_a_change_of_zoom_or_angle_is_no_position(microscope: Microscope, view: dict[str, float]) -> None:
    tracker = TextureTracker()
    assert tracker.update(microscope.show()).found
    assert_lost(tracker.update(microscope.show(shift=(20.0, 10.0), **view)), "appearance_changed")
    assert tracker.last_match is None
    assert tracker.last_reason.startswith("appearance_changed: ")
    assert tracker.update(microscope.show(shift=(5.0, 5.0))).found
    tracker.reset()
    fresh = tracker.update(microscope.show(**view))
    assert (fresh.found, fresh.u_px, fresh.v_px) == (True, 0.0, 0.0)


def test_other_texture_is_not_mistaken(scene: ModuleType, textures: ModuleType, microscope: Microscope) -> None:
    tracker = TextureTracker()
    tracker.update(microscope.show())
    assert_lost(tracker.update(Microscope(scene, textures, seed=9).show()), "appearance_changed")
    assert_lost(tracker.update(microscope.blank()), "appearance_changed")
    assert_lost(tracker.update(microscope.blank(level=255.0, noise=0.0)), "appearance_changed")


def test_a_half_covered_texture_is_no_position(scene: ModuleType, textures: ModuleType, microscope: Microscope) -> None:
    tracker = TextureTracker()
    tracker.update(microscope.show())
    grey = 0.5 * textures.Texture(0).grey(shift=(6.3, 2.2)) + 0.8 * textures.Texture(9).grey()
    covered = scene.digitise(120.0 + grey, noise=1.5, rng=np.random.default_rng(0))
    assert_lost(tracker.update(microscope.frame(covered)), "appearance_changed")
    assert "correlation" in tracker.last_reason


def test_leaving_the_image(microscope: Microscope) -> None:
    tracker = TextureTracker()
    assert tracker.update(microscope.show()).found
    assert tracker.update(microscope.show(shift=(90.0, 0.0))).found
    assert_lost(tracker.update(microscope.show(shift=(110.0, 0.0))), "partly_in_view")
    assert_lost(tracker.update(microscope.show(shift=(200.0, 0.0))), "out_of_view")
    back = tracker.update(microscope.show(shift=(-40.0, 12.5)))
    assert (back.u_px, back.v_px) == pytest.approx((-40.0, 12.5), abs=0.02)


def test_a_view_without_texture_gives_no_template(microscope: Microscope) -> None:
    tracker = TextureTracker()
    assert_lost(tracker.update(microscope.blank(noise=0.0)), "no_texture")
    assert_lost(tracker.update(microscope.blank(noise=3.0)), "no_texture")
    v, u = np.mgrid[0:240, 0:320]
    rng = np.random.default_rng(0)
    for grey in (0.3 * u + 50.0, np.where(u + 0.2 * v < 180.0, 60.0, 160.0)):
        noisy = np.clip(grey + 2.0 * rng.standard_normal(grey.shape), 0, 255).astype(np.uint8)
        assert_lost(tracker.update(microscope.frame(noisy)), "no_texture")
    assert tracker.update(microscope.show()).found


def test_a_point_at_the_border_gives_no_template(microscope: Microscope) -> None:
    assert_lost(TextureTracker(point_px=(155.0, 0.0)).update(microscope.show()), "no_texture")
    assert_lost(TextureTracker(point_px=(400.0, 0.0)).update(microscope.show()), "no_texture")


@pytest.mark.parametrize("shape", [(480, 640), (700, 500)])
def test_larger_images(scene: ModuleType, textures: ModuleType, shape: tuple[int, int]) -> None:
    microscope = Microscope(scene, textures, seed=3)
    tracker = TextureTracker()
    tracker.update(microscope.show(shape=shape))
    for shift in ((-91.3, 55.8), (33.4, -101.7)):
        point = tracker.update(microscope.show(shape=shape, shift=shift))
        assert (point.u_px, point.v_px) == pytest.approx(shift, abs=0.01)


def test_a_smaller_image_later_is_a_loss_not_an_error(microscope: Microscope) -> None:
    tracker = TextureTracker()
    tracker.update(microscope.show())
    assert_lost(tracker.update(microscope.show(shape=(30, 40))), "appearance_changed")


def test_sixteen_bits(scene: ModuleType, textures: ModuleType, microscope: Microscope) -> None:
    texture, rng = textures.Texture(4), np.random.default_rng(4)
    tracker = TextureTracker()
    for shift in ((0.0, 0.0), (14.2, -8.9)):
        image = scene.digitise(2000.0 + 16.0 * texture.grey(shift=shift), noise=24.0, rng=rng, bits=12)
        assert image.dtype == np.uint16
        point = tracker.update(microscope.frame(image, bit_depth=12))
        assert (point.u_px, point.v_px) == pytest.approx(shift, abs=0.02)


def test_each_point_carries_its_frame_and_repeats_bit_for_bit(scene: ModuleType, textures: ModuleType) -> None:
    runs = []
    for _ in range(2):
        microscope, tracker = Microscope(scene, textures, seed=6), TextureTracker(device="cell")
        frames = [microscope.show(), microscope.show(shift=(3.3, 4.4)), microscope.blank()]
        points = [tracker.update(frame) for frame in frames]
        assert [(p.t_ns, p.frame_seq) for p in points] == [(f.t_ns, f.seq) for f in frames]
        assert [(p.device, p.seq, p.t_source) for p in points] == [("cell", k, "computed") for k in range(3)]
        runs.append(points[:2])
    assert runs[0] == runs[1]
    assert runs[0][0].sigma_px > 0.0


def test_colour_and_nonsense_are_refused(microscope: Microscope) -> None:
    with pytest.raises(DataError, match="grey image"):
        TextureTracker().update(microscope.frame(np.zeros((240, 320, 3), dtype=np.uint8)))
    with pytest.raises(OutOfRange, match="window"):
        TextureTracker(window=1.5)
    with pytest.raises(OutOfRange, match="min_correlation"):
        TextureTracker(min_correlation=2.0)
