"""A glance at a whole image: it sees a lone square where the full search sees it, and passes where it might not."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.estimators.vision import SquareFit, locate_square
from microdrivers.estimators.vision import locate as locating
from microdrivers.estimators.vision.quadrilateral import find_quadrilaterals, glance

SHAPE = (240, 320)
PLACE = {"centre": (160.0, 120.0), "side_px": 70.0, "angle_deg": 20.0}


def image_of(scene: ModuleType, added: npt.NDArray[np.float64] | float = 0.0, **place: Any) -> npt.NDArray[Any]:
    grey = 60.0 + 100.0 * scene.square_coverage(SHAPE, **PLACE | place, blur_px=1.2) + added
    return scene.digitise(grey, noise=2.0, rng=np.random.default_rng(3))


@given(
    u=st.floats(120.0, 200.0),
    v=st.floats(90.0, 150.0),
    side_px=st.floats(40.0, 110.0),
    angle_deg=st.floats(0.0, 360.0),
    blur_px=st.floats(0.7, 3.0),
    contrast=st.sampled_from([-55.0, 60.0, 120.0]),
)
@settings(deadline=None, max_examples=25)
def test_a_lone_square_is_seen_where_the_full_search_finds_it(
    scene: ModuleType, u: float, v: float, side_px: float, angle_deg: float, blur_px: float, contrast: float
) -> None:
    place = {"centre": (u, v), "side_px": side_px, "angle_deg": angle_deg}
    rng = np.random.default_rng(1)
    image = scene.square_image(rng, **place, blur_px=blur_px, contrast=contrast, noise=2.0, shape=SHAPE)
    seen = glance(image, min_side_px=20.0)
    assert seen is not None
    searched = find_quadrilaterals(image, min_side_px=20.0)
    assert len(searched.quads) == 1
    from_seen = np.abs(searched.quads[0][:, None] - seen).max(axis=2)
    assert sorted(from_seen.argmin(axis=1)) == [0, 1, 2, 3]
    assert from_seen.min(axis=1).max() < 3.0
    # Both are clockwise.
    assert (np.diff(from_seen.argmin(axis=1)) % 4 == 1).all()


def test_the_fit_is_the_same_from_a_glance_and_from_the_full_search(
    scene: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = image_of(scene)
    glanced = locate_square(image)
    monkeypatch.setattr(locating, "glance", lambda _image, *, min_side_px: None)
    searched = locate_square(image)
    assert isinstance(glanced, SquareFit)
    assert isinstance(searched, SquareFit)
    # A few of the pixels at the ends of the bands differ: a tenth of the error.
    assert glanced.corners_px == pytest.approx(searched.corners_px, abs=2e-3)
    assert glanced.rivals == searched.rivals == 0


def test_it_looks_closer_where_it_might_be_wrong(scene: ModuleType) -> None:
    slope = np.linspace(-60.0, 60.0, SHAPE[1]) * np.ones(SHAPE)
    beside = {"side_px": 50.0, "angle_deg": 0.0, "blur_px": 1.2}
    rival = 100.0 * scene.square_coverage(SHAPE, centre=(270.0, 120.0), **beside)
    at_border = 100.0 * scene.square_coverage(SHAPE, centre=(310.0, 120.0), **beside)
    assert glance(image_of(scene), min_side_px=20.0) is not None
    for doubtful in (
        image_of(scene, slope),
        image_of(scene, rival),
        image_of(scene, at_border),
        image_of(scene, centre=(160.0, 38.0), angle_deg=0.0),
        image_of(scene, side_px=24.0),
        image_of(scene)[80:160],
        np.full(SHAPE, 77, dtype=np.uint8),
    ):
        assert glance(doubtful, min_side_px=20.0) is None
    assert glance(image_of(scene), min_side_px=75.0) is None


def test_large_images_of_any_depth_and_shape_are_glanced_at(scene: ModuleType) -> None:
    shape = (999, 1001)
    place = {"centre": (480.0, 520.0), "side_px": 200.0, "angle_deg": 33.0}
    grey = 600.0 + 2000.0 * scene.square_coverage(shape, **place, blur_px=2.0)
    image = np.rint(grey + np.random.default_rng(2).normal(0.0, 20.0, shape)).astype(np.uint16)
    seen = glance(image, min_side_px=20.0)
    assert seen is not None
    truth = scene.square_corners(**place)
    assert min(np.abs(np.roll(seen, k, axis=0) - truth).max() for k in range(4)) < 6.0
