from __future__ import annotations

import math
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from microdrivers.core.contact_samples import DeformationSample
from microdrivers.core.errors import DataError, IllConditioned, OutOfRange
from microdrivers.estimators.vision import (
    ContactPatch,
    DeformationTracker,
    ImageScale,
    TipView,
    contact_patch,
    find_moving_tip,
)

LOOK: dict[str, Any] = {
    "shape": (170, 230),
    "contact_px": (120.0, 85.0),
    "angle_deg": 188.0,
    "rod_texture_levels": 10.0,
}
FAR_UM, NEAR_UM = -110.0, -20.0


class Bench:
    """A scene and what a tracker needs of it; the scale is exact, so that errors are the tracking's own."""

    def __init__(
        self, scenes: ModuleType, *, seed: int = 3, within_um: float = 100.0, count: int = 4, **look: Any
    ) -> None:
        self.scene = scenes.ContactScene(seed, **(LOOK | look))
        frames, travel_um = self.scene.approach(FAR_UM, -40.0, count)
        self.tip: TipView = find_moving_tip(frames, travel_um, scale_hint_px_per_um=self.px_per_um)
        rest = [self.scene.press(NEAR_UM - 0.3 * k) for k in range(8, 0, -1)]
        self.patch: ContactPatch = contact_patch(rest, self.tip, rigid_um=within_um, depth_um=100.0)

    @property
    def px_per_um(self) -> float:
        return float(self.scene.look.scale_px_per_um)

    def tracker(self, **more: Any) -> DeformationTracker:
        scale = ImageScale.from_projection(self.px_per_um * np.eye(2), self.scene.direction)
        return DeformationTracker("camera_fine", tip=self.tip, patch=self.patch, **({"scale": scale} | more))

    def touched(self, **more: Any) -> DeformationTracker:
        """A tracker that knows where the surface was, as a force sensor can tell."""
        tracker = self.tracker(**more)
        sample = tracker.update(self.scene.press(NEAR_UM))
        tracker.set_contact(tip_um=sample.tip_um - NEAR_UM)
        return tracker


@pytest.fixture  # one a test: its noise then does not depend on which tests ran before
def bench(contact_scenes: ModuleType) -> Bench:
    return Bench(contact_scenes, count=9)


def assert_lost(sample: DeformationSample, flag: str) -> None:
    assert not sample.found
    assert flag in sample.flags
    assert all(math.isnan(x) for x in (sample.deformation_um, sample.sigma_um, sample.u_px, sample.v_px))


@pytest.mark.parametrize("blur_px", [0.9, 1.6])
def test_no_bias_at_any_phase_nor_after_40_px(contact_scenes: ModuleType, blur_px: float) -> None:
    bench = Bench(contact_scenes, noise=0.3, blur_px=blur_px)
    tracker = bench.touched()
    tracker.update(bench.scene.press(0.0))
    errors = []
    for px in (0.1, 0.3, 0.5, 0.7, 0.9, 3.4, 7.25, 12.6, 17.85, 22.15, 27.5, 32.75, 37.2, 40.4):
        sample = tracker.update(bench.scene.press(px / bench.px_per_um))
        errors.append(sample.deformation_um * bench.px_per_um - px)
        assert sample.flags == frozenset()
    assert np.abs(errors).max() < 0.01
    assert abs(np.mean(errors)) < 0.005


def test_as_precise_as_it_says(bench: Bench) -> None:
    tracker = bench.touched()
    errors, deformation_z, tip_z = [], [], []
    tracker.update(bench.scene.press(5.0))
    greys = [(um, bench.scene.grey(tip_um=um, deformation_um=um)) for um in (30.0, 30.4, 30.9, 31.5, 32.2, 32.6)]
    for _ in range(50):
        for um, grey in greys:
            sample = tracker.update(bench.scene.digitise(grey))
            errors.append((sample.deformation_um - um) * bench.px_per_um)
            deformation_z.append((sample.deformation_um - um) / sample.sigma_um)
            tip_z.append((sample.tip_um - um) / sample.tip_sigma_um)
    assert np.sqrt(np.mean(np.square(errors))) < 0.015
    assert 0.7 < np.var(deformation_z) < 1.4
    assert 0.7 < np.var(tip_z) < 1.4
    # The zeros are those of eight frames and of one.
    assert abs(np.mean(deformation_z)) < 1.0
    assert abs(np.mean(tip_z)) < 3.0


def test_the_contact_point_is_told_from_the_principal_point(bench: Bench) -> None:
    tracker = bench.touched()
    sample = tracker.update(bench.scene.press(20.0))
    expected = np.array(bench.scene.look.contact_px) + 8.0 * bench.scene.direction - np.array([114.5, 84.5])
    assert (sample.u_px, sample.v_px) == pytest.approx(expected.tolist(), abs=2.0)


@pytest.mark.parametrize("px_per_um", [0.2, 0.4])
def test_shear_beyond_the_rigid_region_matters_less_than_1_percent(
    contact_scenes: ModuleType, px_per_um: float
) -> None:
    bench = Bench(contact_scenes, noise=0.5, within_um=90.0, scale_px_per_um=px_per_um)
    sheared = contact_scenes.ContactScene(3, noise=0.5, **(LOOK | {"scale_px_per_um": px_per_um, "rigid_um": 80.0}))
    tracker = bench.touched()
    for um in (20.0, 45.0, 70.0, 100.0):
        sample = tracker.update(bench.scene.digitise(sheared.grey(tip_um=um, deformation_um=um)))
        assert sample.deformation_um == pytest.approx(um, rel=0.01)


def test_a_soft_surrounding_biases_as_documented_and_is_flagged(contact_scenes: ModuleType) -> None:
    soft: dict[str, Any] = {"rigid_um": 0.0, "shear_um": 400.0}
    bench = Bench(contact_scenes, noise=0.5, **soft)
    tracker = bench.touched()
    for um in (20.0, 40.0, 60.0):
        sample = tracker.update(bench.scene.press(um))
        # −0.5·(rigid_um/L)² = −3 %
        assert -0.045 < sample.deformation_um / um - 1.0 < -0.02
    assert "NOT_RIGID" in sample.flags
    smaller = Bench(contact_scenes, noise=0.5, within_um=50.0, **soft).touched()
    for um in (20.0, 40.0, 60.0):
        sample = smaller.update(bench.scene.press(um))
        assert sample.deformation_um == pytest.approx(um, rel=0.013)


def test_light_may_change(bench: Bench) -> None:
    tracker = bench.touched()
    for um, gain, bias in ((5.0, 1.2, 0.0), (10.0, 0.6, 40.0), (15.0, 1.0, -30.0)):
        sample = tracker.update(bench.scene.show(tip_um=um, deformation_um=um, gain=gain, bias=bias))
        assert sample.deformation_um == pytest.approx(um, abs=6.0 * sample.sigma_um)
        assert sample.tip_um == pytest.approx(um, abs=6.0 * sample.tip_sigma_um)


def test_the_tip_may_leave_the_surface(bench: Bench) -> None:
    tracker = bench.touched()
    for tip_um, deformation_um in ((20.0, 20.0), (5.0, 12.0), (-15.0, 8.0), (-35.0, 5.0), (-60.0, 3.0)):
        sample = tracker.update(bench.scene.show(tip_um=tip_um, deformation_um=deformation_um))
        assert sample.deformation_um == pytest.approx(deformation_um, abs=6.0 * sample.sigma_um)
        assert sample.tip_um == pytest.approx(tip_um, abs=7.0 * sample.tip_sigma_um)


def test_a_probe_without_marks_is_known_by_its_front(contact_scenes: ModuleType) -> None:
    bench = Bench(contact_scenes, rod_texture_levels=0.0)
    tracker = bench.touched()
    errors = []
    for tip_um in (-10.0, 0.0, 10.0, 20.0, 33.0, 15.0, -8.0, -30.0):
        sample = tracker.update(bench.scene.press(tip_um))
        errors.append(sample.tip_um - tip_um)
    # At its front a dark membrane cannot be told from a dark probe: half a pixel, the same as long as they touch.
    assert np.abs(errors[1:6]).max() < 1.5
    assert np.std(errors[1:6]) < 0.15
    assert abs(errors[-1]) < 0.15


def test_what_is_covered_is_lost_and_found_again(bench: Bench) -> None:
    tracker = bench.touched()
    assert tracker.update(bench.scene.press(10.0)).found
    assert tracker.last_reason == ""
    hidden = bench.scene.grey(tip_um=10.0, deformation_um=10.0)
    hidden[:, :115] = 90.0
    for _ in range(3):
        sample = tracker.update(bench.scene.digitise(hidden))
        assert_lost(sample, "MISMATCH")
        assert sample.tip_um == pytest.approx(10.0, abs=1.0)
    assert "covered" in tracker.last_reason
    blank = tracker.update(bench.scene.digitise(np.full(bench.scene.look.shape, 120.0)))
    assert_lost(blank, "TIP_LOST")
    assert math.isnan(blank.tip_um)
    assert math.isnan(blank.tip_sigma_um)
    back = tracker.update(bench.scene.press(35.0))
    assert back.deformation_um == pytest.approx(35.0, abs=6.0 * back.sigma_um)
    assert back.tip_um == pytest.approx(35.0, abs=1.0)


def test_a_jump_too_fast_to_be_true_is_not_believed(bench: Bench) -> None:
    tracker = bench.touched(max_speed_um_s=20.0)
    assert tracker.update(bench.scene.press(0.0)).found
    grey = bench.scene.grey(tip_um=30.0, deformation_um=30.0)
    outcomes = [tracker.update(bench.scene.digitise(grey)) for _ in range(45)]
    assert_lost(outcomes[0], "MISMATCH")
    # 30 µm take 1.5 s at 20 µm/s; 4 px are always allowed.
    found = [sample.found for sample in outcomes]
    assert 25 < found.index(True) < 44
    assert outcomes[-1].deformation_um == pytest.approx(30.0, abs=6.0 * outcomes[-1].sigma_um)


def test_leaving_the_image(bench: Bench) -> None:
    tracker = bench.touched()
    grey = bench.scene.grey(tip_um=0.0)
    samples = [tracker.update(bench.scene.digitise(np.roll(grey, -11 * k, axis=1))) for k in range(10)]
    found = [sample.found for sample in samples]
    assert found == sorted(found, reverse=True)
    assert found[0]
    assert_lost(samples[-1], "OUT_OF_VIEW")
    assert "left the image" in tracker.last_reason
    small = tracker.update(bench.scene.digitise(grey[:60, :60]))
    assert_lost(small, "OUT_OF_VIEW")
    assert_lost(small, "TIP_LOST")
    for _ in range(8):
        back = tracker.update(bench.scene.digitise(grey))
    assert back.found


def test_scale_from_travel_and_from_a_calibration(bench: Bench) -> None:
    travel = ImageScale.from_travel(bench.tip)
    assert travel.px_per_um == pytest.approx(0.4, rel=2e-3)
    assert 0.0 < travel.relative_sigma < 2e-3
    angle = math.radians(31.0)
    turned = 0.4 * np.array([[math.cos(angle), math.sin(angle)], [math.sin(angle), -math.cos(angle)]])
    probing = np.linalg.inv(turned) @ bench.scene.direction
    scale = ImageScale.from_projection(turned, probing, relative_sigma=1e-4)
    assert scale.um_per_px == pytest.approx((bench.scene.direction / 0.4).tolist())
    # Pixels that are not square: the direction is the stage's, and lengths along it count.
    skewed = ImageScale.from_projection([[0.4, 0.1], [0.0, 0.5]], (3.0, 4.0, 0.0))
    displacement = np.array([[0.4, 0.1], [0.0, 0.5]]) @ (0.6, 0.8)
    assert float(np.dot(skewed.um_per_px, displacement)) == pytest.approx(1.0)
    with pytest.raises(IllConditioned):
        ImageScale.from_projection([[1.0, 2.0], [0.5, 1.0]], (1.0, 0.0))
    with pytest.raises(IllConditioned):
        ImageScale.from_projection(np.eye(2), (0.0, 0.0, 1.0))


def test_the_touch_sets_the_zero(contact_scenes: ModuleType) -> None:
    bench = Bench(contact_scenes, seed=6)
    tracker = bench.tracker(scale=None)
    places_um = [-8.0 + 0.5 * k for k in range(44)]
    samples = [tracker.update(bench.scene.press(um)) for um in places_um]
    assert "ZERO_BY_SIGHT" in samples[0].flags
    assert samples[0].tip_um == pytest.approx(-8.0, abs=6.0)
    event = tracker.contact.event
    assert event is not None
    first_ns = samples[0].t_ns
    assert (event.t_ns - first_ns) / 1e9 == pytest.approx(16 / 30, abs=5.0 * event.sigma_s)
    assert event.sigma_s < 0.01
    late = [k for k, sample in enumerate(samples) if not sample.flags]
    assert 16 < late[0] < 16 + 12
    for k in late:
        assert samples[k].deformation_um == pytest.approx(places_um[k], abs=5.0 * samples[k].sigma_um)
        assert samples[k].tip_um == pytest.approx(places_um[k], abs=5.0 * samples[k].tip_sigma_um)


def test_each_sample_carries_its_frame_and_repeats_bit_for_bit(contact_scenes: ModuleType) -> None:
    runs = []
    for _ in range(2):
        bench = Bench(contact_scenes, seed=4)
        tracker = bench.tracker()
        frames = [bench.scene.press(um) for um in (-10.0, -5.0, 3.0, 9.0)]
        samples = [tracker.update(frame) for frame in frames]
        assert [(s.t_ns, s.dt_ns, s.frame_seq, s.exposure_ms) for s in samples] == [
            (f.t_ns, f.dt_ns, f.seq, f.exposure_ms) for f in frames
        ]
        assert [(s.device, s.seq, s.t_source) for s in samples] == [("camera_fine", k, "computed") for k in range(4)]
        runs.append(samples)
    assert runs[0] == runs[1]


def test_colour_and_nonsense_are_refused(bench: Bench) -> None:
    with pytest.raises(DataError, match="grey image"):
        bench.tracker().update(bench.scene.frame(np.zeros((170, 230, 3), dtype=np.uint8)))
    with pytest.raises(OutOfRange, match="max_speed_um_s"):
        bench.tracker(max_speed_um_s=0.0)
    with pytest.raises(OutOfRange, match="min_correlation"):
        bench.tracker(min_correlation=2.0)
