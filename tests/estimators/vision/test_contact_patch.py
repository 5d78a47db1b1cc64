from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest

from microdrivers.core.errors import OutOfRange
from microdrivers.core.samples import Frame
from microdrivers.estimators.vision import NoContactPatch, TipView, contact_patch, find_moving_tip

CONTACT_PX = (100.0, 80.0)
LOOK: dict[str, Any] = {"shape": (160, 220), "contact_px": CONTACT_PX}


def see_tip(scene: Any) -> TipView:
    frames, travel_um = scene.approach(-140.0, -60.0, 4)
    return find_moving_tip(frames, travel_um, scale_hint_px_per_um=scene.look.scale_px_per_um)


@pytest.fixture  # one a test: its noise then does not depend on which tests ran before
def scene(contact_scenes: ModuleType) -> Any:
    return contact_scenes.ContactScene(3, **LOOK)


@pytest.fixture
def tip(scene: Any) -> TipView:
    return see_tip(scene)


def assert_refused(reason: str, frames: list[Frame], tip: TipView, **more: float) -> None:
    with pytest.raises(NoContactPatch) as caught:
        contact_patch(frames, tip, **more)
    assert caught.value.reason == reason
    assert caught.value.remedy


@pytest.mark.parametrize("gap_um", [0.0, 8.0, 20.0, 60.0])
def test_the_surface_is_found_ahead_of_the_tip(scene: Any, tip: TipView, gap_um: float) -> None:
    patch = contact_patch([scene.show(tip_um=-gap_um) for _ in range(10)], tip, depth_um=80.0)
    assert patch.contact_px == pytest.approx(CONTACT_PX, abs=2.0)
    assert patch.gap_px == pytest.approx(0.4 * gap_um, abs=2.0)
    assert patch.noise_levels == pytest.approx(2.0, rel=0.1)
    assert patch.reach_px == pytest.approx(40.0, rel=1e-2)
    assert 1500 < patch.patch.pixels < 2300


def test_a_gap_that_the_force_has_told_is_believed(scene: Any, tip: TipView) -> None:
    patch = contact_patch([scene.show(tip_um=-20.0)], tip, gap_um=25.0, depth_um=80.0)
    assert patch.gap_px == pytest.approx(25.0 * tip.scale_px_per_um)


def test_dust_before_the_surface_is_not_the_surface(contact_scenes: ModuleType) -> None:
    dusty = contact_scenes.ContactScene(3, **LOOK, specks=((114.0, 80.0, 1.5, -30.0),))
    patch = contact_patch([dusty.show(tip_um=-60.0)], see_tip(dusty), depth_um=80.0)
    assert patch.contact_px == pytest.approx(CONTACT_PX, abs=2.0)


def test_the_noise_of_the_patch_shrinks_with_its_frames(scene: Any, tip: TipView) -> None:
    one, many = (contact_patch([scene.show(tip_um=-20.0) for _ in range(n)], tip, depth_um=80.0) for n in (1, 8))
    assert one.sigma_px == pytest.approx(many.sigma_px * np.sqrt(2.0 / 1.125), rel=0.15)


def test_a_white_part_is_left_out(contact_scenes: ModuleType) -> None:
    glossy = contact_scenes.ContactScene(3, **LOOK, specks=((75.0, 70.0, 4.0, 400.0),))
    whole = contact_scenes.ContactScene(3, **LOOK)
    bright, plain = (contact_patch([s.show(tip_um=-30.0)], see_tip(s), depth_um=80.0) for s in (glossy, whole))
    assert bright.patch.pixels < plain.patch.pixels - 60


def test_no_specimen_ahead(contact_scenes: ModuleType) -> None:
    empty = contact_scenes.ContactScene(3, **LOOK, specimen=170.0, texture_levels=0.0, rim_levels=0.0)
    assert_refused("no_specimen", [empty.show(tip_um=-30.0)], see_tip(empty))


def test_too_little_texture(contact_scenes: ModuleType) -> None:
    faint = contact_scenes.ContactScene(3, **LOOK, texture_levels=1.0, rim_levels=0.0)
    assert_refused("no_texture", [faint.show(tip_um=-30.0) for _ in range(4)], see_tip(faint), gap_um=30.0)


def test_a_region_of_few_pixels(scene: Any, tip: TipView) -> None:
    assert_refused("too_small", [scene.show(tip_um=-20.0)], tip, rigid_um=20.0)
    assert_refused("too_small", [scene.show(tip_um=-20.0)], tip, rigid_um=28.0)


def test_no_room_to_be_pressed_in(scene: Any, tip: TipView) -> None:
    assert_refused("at_border", [scene.show(tip_um=-20.0)], tip, depth_um=300.0)
    assert_refused("at_border", [scene.show(tip_um=-20.0)], tip, gap_um=240.0)


def test_a_white_specimen(contact_scenes: ModuleType) -> None:
    white = contact_scenes.ContactScene(3, **LOOK)
    tip = see_tip(white)
    grey = white.grey(tip_um=-20.0)
    grey[:, :96] += 200.0
    assert_refused("saturated", [white.digitise(grey)], tip)


def test_a_specimen_that_moves_meanwhile(scene: Any, tip: TipView) -> None:
    frames = [scene.show(tip_um=-20.0, deformation_um=0.4 * k) for k in range(5)]
    assert_refused("unsteady", frames, tip, depth_um=80.0)


def test_a_tip_out_of_sight(scene: Any, tip: TipView) -> None:
    assert_refused("no_tip", [scene.show(tip_um=-400.0)], tip)


def test_parameters_must_make_sense(scene: Any, tip: TipView) -> None:
    with pytest.raises(OutOfRange, match="no frames"):
        contact_patch([], tip)
    with pytest.raises(OutOfRange, match="rigid_um"):
        contact_patch([scene.show(tip_um=-20.0)], tip, rigid_um=-1.0)
