from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from microdrivers.core.errors import DataError, OutOfRange
from microdrivers.core.samples import Frame
from microdrivers.estimators.vision import NoMovingTip, TipView, find_moving_tip

PHASES = (Phase.explicit, Phase.generate)
"""Renders too much to be shrunk."""

SMALL: dict[str, Any] = {"shape": (180, 240), "contact_px": (95.0, 90.0)}


def find(scene: Any, frames: list[Frame], travel_um: list[float], **more: Any) -> TipView:
    options = {"scale_hint_px_per_um": scene.look.scale_px_per_um, "travel_sigma_um": 0.0} | more
    return find_moving_tip(frames, travel_um, **options)


@settings(deadline=None, max_examples=6, derandomize=True, phases=PHASES)
@given(
    angle_deg=st.floats(-180.0, 180.0),
    scale=st.floats(0.2, 0.5),
    blur_px=st.sampled_from([0.9, 1.6]),
    grain=st.sampled_from([0.0, 10.0]),
    hint=st.floats(0.75, 1.35),
)
def test_the_tip_is_found_whatever_its_direction(
    contact_scenes: ModuleType, angle_deg: float, scale: float, blur_px: float, grain: float, hint: float
) -> None:
    scene = contact_scenes.ContactScene(
        1, angle_deg=angle_deg, scale_px_per_um=scale, blur_px=blur_px, rod_texture_levels=grain,
        shape=(220, 220), contact_px=(110.0, 110.0),
    )  # fmt: skip
    frames, travel_um = scene.approach(-150.0, -60.0, 5)
    tip = find(scene, frames, travel_um, scale_hint_px_per_um=hint * scale)
    assert tip.scale_px_per_um == pytest.approx(scale, abs=5.0 * tip.scale_sigma_px_per_um)
    assert tip.scale_sigma_px_per_um < 2e-3 * scale
    across = float(scene.direction @ (-tip.direction[1], tip.direction[0]))
    assert abs(across) < 0.005
    error = tip.front_px - (110.0 - 60.0 * scale * scene.direction)
    assert np.hypot(*error) < 0.9
    assert tip.width_px == pytest.approx(60.0 * scale, abs=2.5)
    assert tip.travel_um == pytest.approx(travel_um[-1], abs=0.3)


def test_the_scale_is_as_uncertain_as_it_says(contact_scenes: ModuleType) -> None:
    scene = contact_scenes.ContactScene(5, **SMALL)
    travel_um = [0.0, 14.0, 33.0, 61.3, 80.0]
    greys = [scene.grey(tip_um=x - 130.0) for x in travel_um]
    z = []
    for _ in range(18):
        tip = find(scene, [scene.digitise(grey) for grey in greys], travel_um)
        z.append((tip.scale_px_per_um - scene.look.scale_px_per_um) / tip.scale_sigma_px_per_um)
    # Residuals widen the sigma where chance makes them large, and never narrow it.
    assert 0.4 < np.mean(np.square(z)) < 1.5


def test_dust_and_flicker_do_not_matter(contact_scenes: ModuleType) -> None:
    specks = tuple((20.0 + 23.0 * k, 30.0 + (37 * k) % 130, 2.0 + k % 3, -40.0) for k in range(9))
    scene = contact_scenes.ContactScene(7, **SMALL, specks=(*specks, (135.0, 92.0, 2.5, -45.0)))
    travel_um = [0.0, 20.0, 40.0, 60.0, 80.0]
    frames = [
        scene.show(tip_um=x - 130.0, gain=gain) for x, gain in zip(travel_um, (1.0, 1.1, 0.9, 1.05, 0.95), strict=True)
    ]
    tip = find(scene, frames, travel_um)
    assert tip.scale_px_per_um == pytest.approx(0.4, rel=2e-3)
    assert tip.front_px == pytest.approx((95.0 + 20.0, 90.0), abs=0.8)


def test_a_bright_tapered_probe(contact_scenes: ModuleType) -> None:
    scene = contact_scenes.ContactScene(8, **SMALL, background=60.0, rod=160.0, rod_tilt=0.4, angle_deg=165.0)
    frames, travel_um = scene.approach(-130.0, -50.0, 5)
    tip = find(scene, frames, travel_um)
    assert tip.scale_px_per_um == pytest.approx(0.4, rel=2e-3)


def test_repeats_bit_for_bit(contact_scenes: ModuleType) -> None:
    scene = contact_scenes.ContactScene(9, **SMALL)
    frames, travel_um = scene.approach(-130.0, -50.0, 5)
    first, second = (find(scene, frames, travel_um) for _ in range(2))
    assert first.scale_px_per_um == second.scale_px_per_um
    assert first.front_px.tolist() == second.front_px.tolist()


def assert_refused(reason: str, scene: Any, frames: list[Frame], travel_um: list[float], **more: Any) -> None:
    with pytest.raises(NoMovingTip) as caught:
        find(scene, frames, travel_um, **more)
    assert caught.value.reason == reason
    assert caught.value.remedy


def test_nothing_moved(contact_scenes: ModuleType) -> None:
    scene = contact_scenes.ContactScene(1, **SMALL)
    frames = [scene.show(tip_um=-60.0, gain=gain) for gain in (1.0, 0.9, 1.05)]
    assert_refused("nothing_moved", scene, frames, [0.0, 40.0, 80.0])


def test_what_appeared_is_not_the_probe(contact_scenes: ModuleType) -> None:
    scene = contact_scenes.ContactScene(1, **SMALL)
    frames = [scene.show(tip_um=-60.0) for _ in range(3)]
    image = frames[-1].image.copy()
    image[120:150, 170:200] = np.random.default_rng(3).integers(40, 200, (30, 30))
    assert_refused("not_the_probe", scene, [*frames[:2], scene.frame(image)], [0.0, 40.0, 80.0])


def test_a_wrong_hint_gives_no_wrong_scale(contact_scenes: ModuleType) -> None:
    scene = contact_scenes.ContactScene(1, **SMALL)
    frames, travel_um = scene.approach(-130.0, -70.0, 4)
    for hint in (0.12, 1.3):
        try:
            tip = find(scene, frames, travel_um, scale_hint_px_per_um=hint)
        except NoMovingTip:
            continue
        assert tip.scale_px_per_um == pytest.approx(0.4, rel=3e-3)


def test_a_tip_that_does_not_follow_its_encoder(contact_scenes: ModuleType) -> None:
    scene = contact_scenes.ContactScene(1, **SMALL)
    places = (-130.0, -113.0, -93.0, -73.0, -50.0)
    frames = [scene.show(tip_um=x) for x in places]
    assert_refused("does_not_follow", scene, frames, [0.0, 20.0, 40.0, 60.0, 80.0])


def test_a_tip_that_has_hardly_come_into_view(contact_scenes: ModuleType) -> None:
    scene = contact_scenes.ContactScene(1, **SMALL)
    frames, travel_um = scene.approach(-350.0, -330.0, 4)
    assert_refused("at_border", scene, frames, travel_um)


def test_travel_must_make_sense(contact_scenes: ModuleType) -> None:
    scene = contact_scenes.ContactScene(1, **SMALL)
    frames, travel_um = scene.approach(-130.0, -50.0, 3)
    with pytest.raises(OutOfRange, match="at least 3"):
        find(scene, frames[:2], travel_um[:2])
    with pytest.raises(OutOfRange, match="rise"):
        find(scene, frames, travel_um[::-1])
    with pytest.raises(OutOfRange, match="px only"):
        find(scene, frames, [0.0, 1.0, 2.0])
    with pytest.raises(DataError, match="differ in size"):
        find(scene, [*frames[:2], scene.frame(frames[2].image[:150])], travel_um)
    with pytest.raises(DataError, match="grey image"):
        find(scene, [scene.frame(np.zeros((180, 240, 3), dtype=np.uint8))] * 3, travel_um)
