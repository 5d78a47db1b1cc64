"""What the touch by which a tool found the specimen means for the indentation after it."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from microdrivers.core.contact_samples import DeformationSample
from microdrivers.estimators.force.model import SpecimenModel

_NEARLY_DEEPEST, _FEWEST = 0.8, 5
"""Frames in which the contact point is deeper than this share of the deepest, at least so many."""

_ROUNDS = 60


def surface_ahead_um(deformations: Iterable[DeformationSample]) -> float | None:
    """How far beyond the contact that was felt the camera shows the specimen's surface; negative before it.

    While the tool presses, tip and contact point move as one: their distance is that of the two zeros. On its way back
    the tip may leave a specimen that recovers more slowly, so that only frames until then count. None if too few frames
    show both.
    """
    seen = [sample for sample in deformations if sample.found and math.isfinite(sample.tip_um)]
    turn = max(range(len(seen)), key=lambda k: seen[k].tip_um, default=-1)
    seen = seen[: turn + 1]
    least_um = _NEARLY_DEEPEST * max((sample.deformation_um for sample in seen), default=0.0)
    pressed = [sample for sample in seen if sample.deformation_um > max(least_um, 1.0)]
    if len(pressed) < _FEWEST:
        return None
    return float(np.median([sample.tip_um - sample.deformation_um for sample in pressed]))


def slip_used_up_um(model: SpecimenModel, *, speed_um_s: float, touch_uN: float, touched_s: float) -> float:
    """How much of a slip was over before the indentation that shows `model`; infinite if any part of it may have been.

    A specimen slips from the first touch on, α·s µm/s while s µm are left by eq. (26): from a tool that comes hardly
    faster it withdraws unfelt. Looked back from what was left, as long as it takes until nothing is compressed.

    Args:
        model: with what was left of the slip.
        speed_um_s: of the approach.
        touch_uN: the force by which it ended; the springs explain it all at most.
        touched_s: how long it was felt.
    """
    rate_per_s, left_um = model.slip_rate_per_s, model.slip_um
    at_touch_um = left_um * math.exp(rate_per_s * touched_s)
    withdraws_um_s = rate_per_s * at_touch_um
    if withdraws_um_s <= 0.0:
        return 0.0
    if model.k1_uN_per_um <= 0.0 or withdraws_um_s >= speed_um_s:
        return math.inf

    def compressed_um(before_s: float) -> float:
        gone_um = at_touch_um * math.expm1(rate_per_s * before_s)
        return touch_uN / model.k1_uN_per_um - speed_um_s * before_s + gone_um

    least, most = 0.0, math.log(speed_um_s / withdraws_um_s) / rate_per_s
    if compressed_um(most) > 0.0:
        return math.inf
    for _ in range(_ROUNDS):
        middle = 0.5 * (least + most)
        least, most = (middle, most) if compressed_um(middle) > 0.0 else (least, middle)
    return at_touch_um * math.exp(rate_per_s * most) - left_um
