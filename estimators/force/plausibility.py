"""Whether a record's units are what they should be, where no figure can prove that they are not."""

from __future__ import annotations

import numpy as np

from microdrivers.estimators.force.prepared import Prepared

SOFT_UN_PER_UM = 0.1
"""Force over depth of a loading below which a force in mN is the likelier explanation.

The specimens of Bilen et al., section III.C, have k1 of 2.96 to 5.88 µN/µm, thirty times as much; in mN they would have
0.003 to 0.006. Only indenters for cells and gels (10⁻⁴ to 10⁻² µN/µm) measure what is as soft: that is why such a
record is doubted and not refused.
"""

SLOW_UM_S, FAST_UM_S = 0.05, 200.0
"""Loading speeds outside which the unit of the time is doubted; the paper loads at 5 µm/s, this package at 0.1 to 100.

5 µm/s with the time in ms is 0.005 µm/s, in min 300 µm/s.
"""


def doubts(prepared: Prepared) -> list[str]:
    """Sentences on units that look wrong, each with what to do if they are.

    Args:
        prepared: a record that `record.check` has accepted.
    """
    loading = prepared.branches.loading
    first, last = loading.start, loading.stop - 1
    time_s = prepared.time_s[loading.start : loading.stop]
    depth_um = float(prepared.deformation_um[last] - prepared.deformation_um[first])
    rise_uN = float(np.ptp(prepared.force_uN[loading.start : loading.stop]))
    speed_um_s = float(np.polynomial.polynomial.polyfit(
        time_s - time_s[0], prepared.deformation_um[loading.start : loading.stop], 1)[1])  # fmt: skip
    found = []
    if rise_uN < SOFT_UN_PER_UM * depth_um:
        found.append(
            f"units in doubt: {rise_uN:.3g} µN over {depth_um:.3g} µm, from the loading's first sample to its last, is "
            f"{rise_uN / depth_um:.2g} µN/µm, and held embryos have 3 to 6 µN/µm; if the forces were in mN, "
            "multiply them by 1000 (a table's column, or the sensor's scale in the rig file) and start again"
        )
    if speed_um_s > FAST_UM_S:
        found.append(
            f"units in doubt: the loading is at {speed_um_s:.3g} µm/s, one sample every {prepared.frame_s:.2g} s; if "
            "the time column was in minutes, multiply it by 60 and start again"
        )
    elif 0.0 < speed_um_s < SLOW_UM_S:
        found.append(
            f"units in doubt: the loading is at {speed_um_s:.3g} µm/s, one sample every {prepared.frame_s:.2g} s; if "
            "the time column was in ms, divide it by 1000, if the deformation was in mm, multiply it by 1000 (and the "
            "force, if it was in mN), and start again"
        )
    return found
