"""Where a patch lies in an image: from a guess on, by a search, or along a line."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from microdrivers.estimators.vision.patch import Patch, PatchMatch
from microdrivers.estimators.vision.template import FloatArray

MIN_CORRELATION = 0.75
"""Below it, what was found is something else."""

_CANDIDATES = 5
_STEP_PX = 1.5


def locate(
    patch: Patch,
    image: npt.NDArray[Any],
    expected: FloatArray,
    *,
    radius_px: float,
    min_correlation: float = MIN_CORRELATION,
) -> PatchMatch | None:
    """Find `patch` in `image`: from the expected shift on, then by a search about it; None if it is not there."""
    match = patch.refine(image, expected)
    if match is not None and match.correlation >= min_correlation:
        return match
    place = patch.search(image, expected, radius_px)
    match = None if place is None else patch.refine(image, place.astype(np.float64))
    return match if match is not None and match.correlation >= min_correlation else None


def locate_along(
    patch: Patch,
    image: npt.NDArray[Any],
    direction: FloatArray,
    *,
    start: FloatArray,
    back_px: float,
    ahead_px: float,
    min_correlation: float = MIN_CORRELATION,
) -> PatchMatch | None:
    """Find `patch` on a line through the shift `start`, whatever lies ahead of it; None if it is not there."""
    shifts = [start + step * direction for step in np.arange(-back_px, ahead_px + _STEP_PX, _STEP_PX)]
    scores = np.array([patch.score(image, shift) for shift in shifts])
    matches = [patch.refine(image, shifts[k]) for k in np.argsort(scores)[-_CANDIDATES:].tolist()]
    found = [match for match in matches if match is not None and match.correlation >= min_correlation]
    return max(found, key=lambda match: match.correlation, default=None)
