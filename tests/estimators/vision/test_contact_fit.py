from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest

from microdrivers.estimators.vision.patch import Patch, take_patch
from microdrivers.estimators.vision.patch_location import locate, locate_along

NOISE = 2.0


class Half:
    """A half-disc behind a contact point, as in `contact_patch`, of one image or a mean of some."""

    def __init__(self, scenes: ModuleType, **look: float) -> None:
        self.scene = scenes.ContactScene(5, noise=NOISE, shape=(130, 150), contact_px=(95.0, 64.0), **look)
        v, u = np.mgrid[0:130, 0:150]
        self.mask = ((u - 95) ** 2 + (v - 64) ** 2 < 36**2) & (u < 90)
        self._grey = self.scene.grey(tip_um=-60.0)

    def patch(self, *, frames: int) -> Patch:
        images = [self.scene.digitise(self._grey).image.astype(np.float32) for _ in range(frames)]
        mean = np.asarray(np.mean(images, axis=0), dtype=np.float32)
        patch = take_patch(mean, self.mask, noise_levels=NOISE, noise_share=1.0 / frames)
        assert patch is not None
        return patch


@pytest.mark.parametrize("frames", [1, 5])
def test_neither_noise_of_the_patch_nor_of_the_frame_biases(contact_scenes: ModuleType, frames: int) -> None:
    half = Half(contact_scenes, texture_levels=9.0)
    grey = half.scene.grey(tip_um=30.9, deformation_um=30.9)
    true_px = np.array([-30.9 * 0.4, 0.0])
    errors, z = [], []
    for _ in range(80):
        match = half.patch(frames=frames).refine(half.scene.digitise(grey).image, np.rint(true_px))
        assert match is not None
        errors.append(match.shift - true_px)
        z.append(errors[-1] / np.sqrt(np.diag(match.covariance)))
    scatter = np.std(errors, axis=0) / np.sqrt(len(errors))
    assert np.abs(np.mean(errors, axis=0) / scatter).max() < 3.5
    assert 0.7 < np.var(z) < 1.4


def test_the_predicted_precision_is_the_found_one(contact_scenes: ModuleType) -> None:
    half = Half(contact_scenes)
    patch = half.patch(frames=8)
    match = patch.refine(half.scene.press(-50.0).image, np.zeros(2))
    assert match is not None
    for axis in range(2):
        direction = np.eye(2)[axis]
        assert np.sqrt(match.covariance[axis, axis]) == pytest.approx(patch.sigma_px(NOISE, direction), rel=0.06)


def test_searches_agree(contact_scenes: ModuleType) -> None:
    half = Half(contact_scenes)
    patch = half.patch(frames=4)
    image = half.scene.press(60.0).image
    found = locate(patch, image, np.zeros(2), radius_px=30.0)
    along = locate_along(patch, image, np.array([-1.0, 0.0]), start=np.zeros(2), back_px=10.0, ahead_px=40.0)
    assert found is not None
    assert along is not None
    assert found.shift == pytest.approx([-24.0, 0.0], abs=0.05)
    assert along.shift == pytest.approx(found.shift, abs=2e-3)
    assert locate(patch, image, np.zeros(2), radius_px=12.0) is None
    assert locate_along(patch, image, np.array([0.0, 1.0]), start=np.zeros(2), back_px=9.0, ahead_px=9.0) is None


def test_what_cannot_be_tracked_makes_no_patch(contact_scenes: ModuleType) -> None:
    half = Half(contact_scenes)
    image = half.scene.press(-60.0).image.astype(np.float32)
    few = np.zeros_like(half.mask)
    few[60:65, 70:80] = True
    border = np.zeros_like(half.mask)
    border[0:40, 60:100] = True
    v, u = np.mgrid[0:130, 0:150]
    ramp = np.asarray(u, dtype=np.float32)
    for picture, mask in ((image, few), (image, border), (ramp, half.mask), (np.ones_like(ramp), half.mask)):
        assert take_patch(picture, mask, noise_levels=NOISE, noise_share=1.0) is None
    edge = (110.0 + 50.0 * np.tanh((u + 0.3 * v - 90.0) / 2.0)).astype(np.float32)
    assert take_patch(edge, half.mask, noise_levels=NOISE, noise_share=1.0) is None
    noise = np.random.default_rng(0).normal(120.0, NOISE, ramp.shape).astype(np.float32)
    assert take_patch(noise, half.mask, noise_levels=NOISE, noise_share=1.0) is None
