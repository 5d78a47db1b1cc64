"""What a specimen answers when a tool presses on it: a nonlinear mass–spring–damper, Bilen et al., eq. (21), and more.

This is the simulation's own model; the estimators have theirs.
"""

from __future__ import annotations

import math
from typing import NamedTuple

_NEWTON_STEPS = 60
_CONVERGED_UM = 1e-11
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


class Contact:
    """Steps the memory of one specimen that is pressed by a tip on a spring, the sensor's own.

    Implicit Euler: right for b = 0, stable for any step, exact for a compression that grows at a constant speed.

    Args:
        stiffness_uN_per_um: of the sensor; infinite if its tip does not give in.
    """

    def __init__(self, mechanics: Mechanics, *, stiffness_uN_per_um: float) -> None:
        self.mechanics = mechanics
        self._stiffness = stiffness_uN_per_um
        self._rigid = math.isinf(stiffness_uN_per_um)

    def step(self, memory: Memory, duration_s: float, depth_um: float, reachable: bool) -> tuple[Memory, float]:
        """What it remembers `duration_s` (> 0) later, and the force on the tip then, µN.

        Args:
            memory: at the step's beginning.
            duration_s: of the step.
            depth_um: at its end, how far beyond the undeformed surface the tip would be if its spring did not give in.
            reachable: whether the tip is where the specimen is at all.
        """
        own = self.mechanics
        before_um, rate_um_s, slip_um, branch_uN, touched = memory
        if touched and own.slip_um:
            slip_um -= (own.slip_um - slip_um) * math.expm1(-own.slip_rate_per_s * duration_s)
        # The force is b·c′ + stiff·c + k2·c³ − known, where c is the compression at the step's end.
        stiff, known, kept, coupling = own.k1_uN_per_um, 0.0, 0.0, 0.0
        if own.branch_uN_per_um:
            kept = math.exp(-duration_s / own.branch_s)
            coupling = own.branch_uN_per_um * (1.0 - kept) * own.branch_s / duration_s
            stiff += coupling
            known += coupling * before_um - kept * branch_uN
        if own.m_kg:
            inertia = own.m_kg / (duration_s * duration_s)
            stiff += inertia
            known += inertia * (before_um + rate_um_s * duration_s)
        touches = False
        if reachable:
            after_um, force_uN = self._pressed(stiff, known, before_um, depth_um - slip_um, duration_s)
            touches = force_uN > (-own.adhesion_uN if touched else 0.0)
        if not touches:
            after_um, force_uN = self._solve(stiff, known, before_um, duration_s), 0.0
        branch_uN = kept * branch_uN + coupling * (after_um - before_um)
        rate_um_s = (after_um - before_um) / duration_s
        if not touches and abs(after_um) + abs(branch_uN) + abs(rate_um_s) < _NEGLIGIBLE:
            return AT_REST._replace(slip_um=slip_um), 0.0
        return Memory(after_um, rate_um_s, slip_um, branch_uN, touches), force_uN

    def _pressed(
        self, stiff: float, known: float, before_um: float, depth_um: float, duration_s: float
    ) -> tuple[float, float]:
        """Compression and force if the tip is at the membrane; `depth_um` is the stage's, less the slip."""
        if not self._rigid:
            spring = self._stiffness
            after_um = self._solve(stiff + spring, known + spring * depth_um, before_um, duration_s)
            return after_um, spring * (depth_um - after_um)
        own, growth_um = self.mechanics, depth_um - before_um
        damper = own.b_loading_uN_s_per_um if growth_um > 0.0 else own.b_unloading_uN_s_per_um
        cubic = own.k2_uN_per_um3 * depth_um * depth_um
        return depth_um, damper * growth_um / duration_s + (stiff + cubic) * depth_um - known

    def _solve(self, stiff: float, known: float, before_um: float, duration_s: float) -> float:
        """The root of b·c′ + stiff·c + k2·c³ = known, whose left-hand side rises with c: there is one."""
        own = self.mechanics
        k2 = own.k2_uN_per_um3
        grows = (stiff + k2 * before_um * before_um) * before_um < known
        damper = (own.b_loading_uN_s_per_um if grows else own.b_unloading_uN_s_per_um) / duration_s
        stiff += damper
        known += damper * before_um
        after_um = before_um
        for _ in range(_NEWTON_STEPS):
            bend = k2 * after_um * after_um
            correction = ((stiff + bend) * after_um - known) / (stiff + 3.0 * bend)
            after_um -= correction
            if abs(correction) < _CONVERGED_UM:
                break
        return after_um
