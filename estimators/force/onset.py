"""Where the force leaves its baseline: the contact, from a cumulative sum that noise does not carry away."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from microdrivers.core.units import NS_PER_S
from microdrivers.estimators.force.line_fit import Point, fit
from microdrivers.estimators.force.scatter import RunningScatter

_ALLOWANCE, _ALARM = 2.0, 12.0
"""Of the sum, in standard deviations of a reading: what a sample may exceed the baseline by without adding to it, and
what is a contact."""

_FEWEST, _REMEMBERED = 15, 90
"""Samples before the contact that tell the baseline: so many at least, and the newest so many; 0.5 and 3 s at 30 Hz."""

_MOVES_SIGMAS = 4.0
"""Of the deformation's slope before the contact: what moves by more follows the tool."""


class Onset(NamedTuple):
    """Where and when the tool met the specimen.

    Attributes:
        t_ns: half-way between the last instant without a force and the first with one.
        contact_um: deformation there.
        baseline_uN, sigma_uN: mean force before it, and the standard deviation of one reading.
    """

    t_ns: int
    contact_um: float
    baseline_uN: float
    sigma_uN: float


class ForceOnset:
    """Detects the contact by a cumulative sum (CUSUM, Page 1954) of the force above its own baseline.

    The zero of the compression is the mean deformation before it; where the deformation moved during the approach,
    as a coordinate of the tool does, its straight line at the instant of contact.

    Args:
        least_sigma_uN: the baseline is taken to scatter by this at least; a drift of that size is no contact.
    """

    def __init__(self, *, least_sigma_uN: float = 0.01) -> None:
        self._least_sigma_uN = least_sigma_uN
        self._scatter = RunningScatter()
        self._before: deque[tuple[int, float, float]] = deque(maxlen=_REMEMBERED)
        self._rising: list[tuple[int, float, float]] = []
        self._sum = 0.0

    def update(self, t_ns: int, deformation_um: float, deformation_sigma_um: float, force_uN: float) -> Onset | None:
        """Take one instant; the contact as soon as it is certain."""
        self._scatter.add(t_ns / NS_PER_S, force_uN)
        sample = (t_ns, deformation_um, force_uN)
        if len(self._before) < _FEWEST:
            self._before.append(sample)
            return None
        baseline_uN = sum(force for _, _, force in self._before) / len(self._before)
        sigma_uN = max(self._scatter.sigma, self._least_sigma_uN)
        self._sum = max(0.0, self._sum + (force_uN - baseline_uN) / sigma_uN - _ALLOWANCE)
        if self._sum == 0.0:
            self._before.extend(self._rising)
            self._before.append(sample)
            self._rising.clear()
            return None
        self._rising.append(sample)
        if self._sum <= _ALARM:
            return None
        at_ns = (self._before[-1][0] + self._rising[0][0]) // 2
        contact_um = self._zero_um(at_ns, deformation_sigma_um)
        return Onset(at_ns, contact_um, baseline_uN, sigma_uN)

    def _zero_um(self, at_ns: int, sigma_um: float) -> float:
        line = fit([Point((t_ns - at_ns) / NS_PER_S, x_um) for t_ns, x_um, _ in self._before])
        if math.isnan(sigma_um):
            sigma_um = math.sqrt(max(line.left_um2, 0.0) / (line.norm0 - 2.0))
        moved = abs(line.slope) > _MOVES_SIGMAS * sigma_um / math.sqrt(line.norm1)
        return line.position_um(0.0) if moved else line.level_um
