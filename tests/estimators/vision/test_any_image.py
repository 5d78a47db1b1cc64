from __future__ import annotations

from types import ModuleType
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from microdrivers.estimators.vision import SquareFit, SquareTracker, TextureTracker, locate_square


def random_picture(rng: np.random.Generator) -> npt.NDArray[Any]:
    """Boxes, discs and lines of any level in an image of any small size, sharp or blurred, clean or noisy."""
    rows, columns = (int(n) for n in rng.integers(1, 200, 2))
    image = np.full((rows, columns), int(rng.integers(0, 256)), dtype=np.uint8)
    for _ in range(rng.integers(0, 6)):
        u, v, size, level = (int(n) for n in rng.integers((0, 0, 1, 0), (columns, rows, 80, 256)))
        match int(rng.integers(0, 4)):
            case 0 | 1:
                box = cv2.boxPoints(((u, v), (size, size), float(rng.uniform(0, 90))))
                cv2.fillPoly(image, [box.astype(np.int32)], level)
            case 2:
                cv2.circle(image, (u, v), size, level, -1)
            case _:
                cv2.line(image, (u, v), (int(rng.integers(0, columns)), 0), level, int(rng.integers(1, 9)))
    if rng.random() < 0.5:
        image = cv2.GaussianBlur(image, (0, 0), float(rng.uniform(0.5, 3.0))).astype(np.uint8)
    if rng.random() < 0.7:
        noisy = image + rng.uniform(0, 20) * rng.standard_normal(image.shape)
        image = np.clip(noisy, 0, 255).astype(np.uint8)
    return image.astype(np.uint16) * 256 if rng.random() < 0.2 else image


def test_any_image_has_an_outcome_and_never_an_error(scene: ModuleType) -> None:
    rng = np.random.default_rng(0)
    square, texture = SquareTracker(), TextureTracker()
    outcomes = {"square": 0, "no square": 0}
    for seq in range(400):
        image = random_picture(rng)
        fit = locate_square(image)
        outcomes["square" if isinstance(fit, SquareFit) else "no square"] += 1
        if isinstance(fit, SquareFit):
            assert np.isfinite(fit.corners_px).all()
            assert np.all(fit.sigma_px >= 0)
        for tracker in (square, texture):
            if rng.random() < 0.1:
                tracker.reset()
            point = tracker.update(scene.frame(image, seq=seq, bit_depth=8 * image.dtype.itemsize))
            assert point.found == bool(np.isfinite([point.u_px, point.v_px, point.sigma_px]).all())
            assert bool(tracker.last_reason) != point.found
    assert min(outcomes.values()) > 0
