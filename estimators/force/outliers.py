"""Single samples that lie far off their neighbours: a glitch of the sensor, a frame that was tracked wrong."""

from __future__ import annotations

import numpy as np

from microdrivers.estimators.force.model import Array
from microdrivers.estimators.force.prepared import Indices, Prepared

_SIGMAS = 10.0
_SPREADS = 3.0
"""Times what the four neighbours differ among each other: at a contact or a reversal they differ themselves."""

_MOST_NAMED = 3


def outliers(values: Array, sigma: float) -> Indices:
    """Indices of samples that neither noise nor the motion seen in the two neighbours on either side explains.

    Args:
        values: of a record, evenly spaced.
        sigma: standard deviation of their noise.
    """
    if len(values) < 5:
        return np.zeros(0, dtype=np.int64)
    window = np.lib.stride_tricks.sliding_window_view(values, 5)
    beside = np.sort(window[:, [0, 1, 3, 4]], axis=1)
    off = np.abs(window[:, 2] - (beside[:, 1] + beside[:, 2]) / 2.0)
    found: Indices = 2 + np.flatnonzero(off > _SIGMAS * sigma + _SPREADS * (beside[:, 3] - beside[:, 0]))
    return found


def named_outliers(prepared: Prepared) -> list[str]:
    """Sentences that name the outliers of a record; nothing is left out for being one."""
    told = []
    for what, unit, values, sigma in (
        ("force", "µN", prepared.force_uN, prepared.force_sigma_uN),
        ("deformation", "µm", prepared.deformation_um, prepared.deformation_sigma_um),
    ):
        found = outliers(values, sigma)
        found = found[prepared.measured[found]]
        if not len(found):
            continue
        named = ", ".join(
            f"sample {at + 1} at {prepared.time_s[at]:.3f} s by "
            f"{values[at] - (values[at - 1] + values[at + 1]) / 2.0:+.3g} {unit}"
            for at in found[:_MOST_NAMED]
        )
        more = f" and {len(found) - _MOST_NAMED} more" if len(found) > _MOST_NAMED else ""
        told.append(
            f"the {what} is far off its neighbours in {named}{more}: it is used all the same; if that was no "
            "measurement, leave its cell empty in the CSV and analyse that again"
        )
    return told
