"""How the picture drifts: what the tip of a tool that has come back moved in the image though its encoder did not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from microdrivers.core.contact_samples import DeformationSample
from microdrivers.core.units import NS_PER_S

FEWEST_FRAMES = 5


class ImageDrift(NamedTuple):
    """Drift of the picture along the direction of probing, thermal for instance.

    Attributes:
        rate_um_s: positive where what rests seems to move into the specimen. sigma_um_s: its standard deviation.
        from_ns: the instant at which it counts as zero.
    """

    rate_um_s: float
    sigma_um_s: float
    from_ns: int

    def um_at(self, t_ns: int) -> float:
        """How far the picture has drifted at an instant."""
        return self.rate_um_s * (t_ns - self.from_ns) / NS_PER_S


def image_drift(
    before: Sequence[DeformationSample],
    after: Sequence[DeformationSample],
    *,
    travel_um: float,
    travel_sigma_um: float,
) -> ImageDrift | None:
    """The drift between two rests of the tool, out of contact both times.

    The tip itself is taken not to drift against the stage's encoder: only the encoder's noise and resolution tell
    otherwise.

    Args:
        before: frames of the first rest.
        after: frames of the second.
        travel_um: how much farther along the direction of probing the encoder says that the tip was in the second.
        travel_sigma_um: standard deviation of it.

    Returns:
        None if the tip was not seen in enough frames of either.
    """
    rests = [[sample for sample in rest if math.isfinite(sample.tip_um)] for rest in (before, after)]
    if min(map(len, rests)) < FEWEST_FRAMES:
        return None
    places, squares, times_ns = [], [travel_sigma_um**2], []
    for rest in rests:
        tips = np.array([sample.tip_um for sample in rest])
        places.append(float(tips.mean()))
        squares.append(float(tips.var(ddof=1)) / len(tips))
        times_ns.append(sum(sample.t_ns for sample in rest) // len(rest))
    elapsed_s = (times_ns[1] - times_ns[0]) / NS_PER_S
    return ImageDrift(
        (places[1] - places[0] - travel_um) / elapsed_s, math.sqrt(math.fsum(squares)) / elapsed_s, times_ns[0]
    )
