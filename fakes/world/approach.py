"""Where the tip of a tool is, seen from the specimen that it is to touch."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.fakes.world.axis import Axis

Array = npt.NDArray[np.float64]


class Place(NamedTuple):
    """A place relative to the undeformed surface at its nominal point of contact, or a change of it; µm.

    `along_um` leads into the specimen, `aside_um` and `up_um` across.
    """

    along_um: float
    aside_um: float
    up_um: float


class Term(NamedTuple):
    """One axis' part in a coordinate: its position times `share`. `still_um` is that part while it does not move."""

    axis: Axis
    share: float
    still_um: float | None = None


class Coordinate(NamedTuple):
    """A sum of axes' parts; `still_um` is the sum while none of them moves.

    The order of the terms never changes, so that sums are the same to the last bit, however they are worked out.
    """

    origin_um: float
    terms: tuple[Term, ...]
    still_um: float | None = None

    def from_instant(self, t_ns: int) -> Coordinate:
        """The same, quicker, for times from `t_ns` until the next command to an axis."""
        terms = tuple(
            term._replace(still_um=term.share * term.axis.position_at(t_ns))
            if term.axis.still_from_ns() <= t_ns
            else term
            for term in self.terms
        )
        still = all(term.still_um is not None for term in terms)
        known = self._replace(terms=terms)
        return known._replace(still_um=known.at(t_ns)) if still else known

    def at(self, t_ns: int) -> float:
        """Its value."""
        if self.still_um is not None:
            return self.still_um
        total = self.origin_um
        for axis, share, still_um in self.terms:
            total += share * axis.position_at(t_ns) if still_um is None else still_um
        return total

    def values_at(self, t_ns: npt.NDArray[np.int64]) -> Array:
        """Its values at rising instants."""
        total = np.full(len(t_ns), self.origin_um)
        for axis, share, still_um in self.terms:
            total += share * axis.positions_at(t_ns) if still_um is None else still_um
        return total


class Approach(NamedTuple):
    """A tip on a fine stage, and a specimen which another stage may carry; a function of time.

    Attributes:
        along, aside, up: the tip's coordinates, see `Place`, if its sensor's spring does not give in.
        radius_um: of the specimen, whose surface curves away.
        reach_um: so far aside or up the tip passes beside it.
    """

    along: Coordinate
    aside: Coordinate
    up: Coordinate
    radius_um: float
    reach_um: float

    def from_instant(self, t_ns: int) -> Approach:
        """The same, quicker, for times from `t_ns` until the next command to an axis."""
        return Approach(
            self.along.from_instant(t_ns),
            self.aside.from_instant(t_ns),
            self.up.from_instant(t_ns),
            self.radius_um,
            self.reach_um,
        )

    @property
    def still(self) -> bool:
        """Whether no axis moves."""
        return None not in (self.along.still_um, self.aside.still_um, self.up.still_um)

    @property
    def axes(self) -> set[Axis]:
        """Whatever moves the tip."""
        return {term.axis for coordinate in (self.along, self.aside, self.up) for term in coordinate.terms}

    def place_at(self, t_ns: int) -> Place:
        """Where the tip is if its sensor's spring does not give in."""
        return Place(self.along.at(t_ns), self.aside.at(t_ns), self.up.at(t_ns))

    def depth_at(self, t_ns: int) -> tuple[float, bool]:
        """How far the tip is beyond the undeformed surface, and whether it is where the specimen is at all."""
        aside, up = self.aside.at(t_ns), self.up.at(t_ns)
        # So much deeper than its nearest point the surface lies there.
        hollow = self.radius_um - math.sqrt(max(self.radius_um * self.radius_um - aside * aside - up * up, 0.0))
        return self.along.at(t_ns) - hollow, abs(aside) < self.reach_um and abs(up) < self.reach_um

    def depths_at(self, t_ns: npt.NDArray[np.int64]) -> tuple[Array, npt.NDArray[np.bool_]]:
        """The same at rising instants."""
        aside, up = self.aside.values_at(t_ns), self.up.values_at(t_ns)
        squares = np.maximum(self.radius_um * self.radius_um - aside * aside - up * up, 0.0)
        hollow = self.radius_um - np.sqrt(squares)
        return self.along.values_at(t_ns) - hollow, (np.abs(aside) < self.reach_um) & (np.abs(up) < self.reach_um)
