"""What a specimen answers when a tool presses on it: a nonlinear mass–spring–damper, Bilen et al., eq. (21), and more.

This is the simulation's own model; the estimators have theirs.
"""

from __future__ import annotations

import math
from typing import NamedTuple

_NEWTON_STEPS = 60
_CONVERGED_UM = 1e-12
_NEGLIGIBLE = 1e-3
"""µm, µN and µm/s: what is left of a relaxation that counts as over."""


class Mechanics(NamedTuple):
    """A specimen's parameters; its force is m·c″ + b·c′ + k1·c + k2·c³ + branch, c being the compression.

    The compression is how far the contact point has moved less how far the whole specimen has slipped in its holder,
    which is x* of eq. (26). `b_loading` holds while the compression grows, `b_unloading` while it shrinks.

    Attributes:
        m_kg: 1 kg·µm/s² is 1 µN.
        slip_um, slip_rate_per_s: where the slip tends to during contact, and how fast: s′ = rate·(slip_um − s).
        branch_uN_per_um, branch_s: a spring and a damper in series, beside the rest (a Maxwell element): its
            stiffness and its relaxation time. No part of eq. (21).
        adhesion_uN: the pull at which the tip comes off; 0 lets the specimen push only.
    """

    k1_uN_per_um: float
    k2_uN_per_um3: float
    b_loading_uN_s_per_um: float
    b_unloading_uN_s_per_um: float
    m_kg: float = 0.0
    slip_um: float = 0.0
    slip_rate_per_s: float = 0.0
    branch_uN_per_um: float = 0.0
    branch_s: float = 1.0
    adhesion_uN: float = 0.0


PRESETS = {
    "single": Mechanics(4.5161, 1e-4, 27.72, 27.72),
    "unloading_springs": Mechanics(2.9577, 1e-4, 51.3317, 0.0),
    "slip_corrected": Mechanics(5.8781, 3.8346e-5, 1.1834, 0.0, slip_um=25.0, slip_rate_per_s=0.1),
    "viscoelastic": Mechanics(4.5161, 1e-4, 5.0, 5.0, branch_uN_per_um=2.0, branch_s=3.0),
}
"""The three parameter sets of Bilen et al., section III.C, and one that their model does not cover.

Without mass, as there: that of an embryo is a milligram, whose inertia is far below what the sensor can tell.
"""


class Memory(NamedTuple):
    """All that a specimen remembers of its past."""

    compression_um: float
    rate_um_s: float
    slip_um: float
    branch_uN: float
    touched: bool


AT_REST = Memory(0.0, 0.0, 0.0, 0.0, False)
"""Of a specimen that has never been touched."""


class Pace(NamedTuple):
    """What a step of a certain length has in common with all others of that length; made by `Contact.pace`."""

    duration_s: float
    kept: float
    coupling: float
    inertia: float
    slip_share: float
    b_loading: float
    b_unloading: float


class Contact:
    """Steps the memory of one specimen that is pressed by a tip on a spring, the sensor's own.

    Implicit Euler: right for b = 0, stable for any step, exact for a compression that grows at a constant speed.

    Args:
        stiffness_uN_per_um: of the sensor; infinite if its tip does not give in.
    """

    def __init__(self, mechanics: Mechanics, *, stiffness_uN_per_um: float) -> None:
        self.mechanics = mechanics
        self._k1 = mechanics.k1_uN_per_um
        self._k2 = mechanics.k2_uN_per_um3
        self._slip_um = mechanics.slip_um
        self._adhesion_uN = mechanics.adhesion_uN
        self._spring = stiffness_uN_per_um
        self._rigid = math.isinf(stiffness_uN_per_um)

    def pace(self, duration_s: float) -> Pace:
        """For steps of `duration_s` (> 0)."""
        own = self.mechanics
        kept = math.exp(-duration_s / own.branch_s)
        return Pace(
            duration_s=duration_s,
            kept=kept,
            coupling=own.branch_uN_per_um * (1.0 - kept) * own.branch_s / duration_s,
            inertia=own.m_kg / (duration_s * duration_s),
            slip_share=-math.expm1(-own.slip_rate_per_s * duration_s),
            b_loading=own.b_loading_uN_s_per_um / duration_s,
            b_unloading=own.b_unloading_uN_s_per_um / duration_s,
        )

    def step(self, memory: Memory, pace: Pace, depth_um: float, reachable: bool) -> tuple[Memory, float]:
        """What it remembers a step later, and the force on the tip then, µN.

        Args:
            memory: at the step's beginning.
            pace: of the step.
            depth_um: at its end, how far beyond the undeformed surface the tip would be if its spring did not give in.
            reachable: whether the tip is where the specimen is at all.
        """
        before_um, rate_um_s, slip_um, branch_uN, touched = memory
        duration_s, kept, coupling, inertia, slip_share, b_loading, b_unloading = pace
        if touched:
            slip_um += (self._slip_um - slip_um) * slip_share
        # The force is b·c′ + stiff·c + k2·c³ − known, where c is the compression at the step's end.
        stiff = self._k1 + coupling + inertia
        known = coupling * before_um - kept * branch_uN + inertia * (before_um + rate_um_s * duration_s)
        touches, after_um, force_uN = False, before_um, 0.0
        if reachable:
            depth_um -= slip_um
            if self._rigid:
                after_um = depth_um
                damper = b_loading if after_um > before_um else b_unloading
                force_uN = damper * (after_um - before_um) + (stiff + self._k2 * after_um * after_um) * after_um - known
            else:
                spring = self._spring
                pushed = known + spring * depth_um
                after_um = _solve(self._k2, stiff + spring, pushed, before_um, b_loading, b_unloading)
                force_uN = spring * (depth_um - after_um)
            touches = force_uN > (-self._adhesion_uN if touched else 0.0)
        if not touches:
            after_um, force_uN = _solve(self._k2, stiff, known, before_um, b_loading, b_unloading), 0.0
        branch_uN = kept * branch_uN + coupling * (after_um - before_um)
        rate_um_s = (after_um - before_um) / duration_s
        if not touches and abs(after_um) + abs(branch_uN) + abs(rate_um_s) < _NEGLIGIBLE:
            return AT_REST._replace(slip_um=slip_um), 0.0
        return Memory(after_um, rate_um_s, slip_um, branch_uN, touches), force_uN


def _solve(k2: float, stiff: float, known: float, before_um: float, b_loading: float, b_unloading: float) -> float:
    """The c with b·(c − before) + stiff·c + k2·c³ = known, by Newton's method; the left-hand side rises with c."""
    grows = (stiff + k2 * before_um * before_um) * before_um < known
    damper = b_loading if grows else b_unloading
    stiff += damper
    known += damper * before_um
    after_um = before_um
    for _ in range(_NEWTON_STEPS):
        bend = k2 * after_um * after_um
        slope = stiff + 3.0 * bend
        correction = (known - (stiff + bend) * after_um) / slope
        after_um += correction
        # What is still missing is the square of the correction times half the curvature.
        if 3.0 * k2 * (abs(after_um) + abs(correction)) * correction * correction < _CONVERGED_UM * slope:
            break
    return after_um
