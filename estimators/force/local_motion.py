"""Velocity on line that does not smear corners: short straight fits which never reach across one.

A corner is where the motion reverses, starts or ends. It is looked for as the broken line that explains the newest
positions so much better than a straight one that noise does not, and with slopes that differ.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from numbers import Integral
from typing import NamedTuple

from microdrivers.core.errors import OutOfRange
from microdrivers.core.units import NS_PER_S
from microdrivers.estimators.force.line_fit import LineFit, Point, broken_line_gains, fit, shape_gain
from microdrivers.estimators.force.scatter import RunningScatter

SHORTEST_LAG = 4
"""Positions that must follow one so that a corner right before it is seen: two more, and one to screen those."""

_MOST_BEYOND = 5
_BEFORE = 3
_LOOK_BACK = 10
_CORNER = 30.0
"""A corner explains as much as this many variances of one position; noise does so once in some 1e7 positions."""

_LEAST_TURN = 0.4
"""Of the faster of two speeds: what differs by less is one motion that slows down or gathers speed."""

_SPIKE_SIGMAS = 5.0
_ANCHOR_WEIGHT = 2
_LATE_SIGMAS = 3.0
_NEAR_CORNER = 0.25
"""Of the time between two positions: so well is the instant of a corner known."""

_REFINED = 8
_LEAST_SIGMA_UM = 1e-3
_FAR = 1_000_000


class MotionSettings(NamedTuple):
    """How positions become velocities.

    Attributes:
        lag: positions that must follow one before its velocity is told, ≥ 4.
        window: positions in a fit. 2·lag − 1 makes it symmetric, so that the velocity is that of its own instant; with
            a shorter lag it is that of `(window + 1)/2 − lag` positions before.
        with_acceleration: fit parabolas.
        with_lateness: find `late_um_s`, which is 0 otherwise.
        max_gap_s: positions further apart than this belong to different motions; > 0.
    """

    lag: int = 9
    window: int = 17
    with_acceleration: bool = False
    with_lateness: bool = False
    max_gap_s: float = 0.25

    def check(self) -> None:
        """Refuse a lag and a window that tell no velocity, and a gap that is none.

        Raises:
            OutOfRange: the lag is shorter than `SHORTEST_LAG`, the window not longer than the lag, or the gap not > 0.
        """
        given: tuple[object, ...] = (self.lag, self.window)  # callers from notebooks have no type checker
        if not all(isinstance(number, Integral) for number in given) or not SHORTEST_LAG <= self.lag < self.window:
            raise OutOfRange(
                f"a lag of {self.lag} in a window of {self.window} tells no velocity",
                remedy=f"give whole numbers with {SHORTEST_LAG} ≤ lag < window",
            )
        if not self.max_gap_s > 0.0:
            raise OutOfRange(
                f"max_gap_s is {self.max_gap_s}", remedy="give a time above 0 s, longer than from one frame to the next"
            )


class InstantMotion(NamedTuple):
    """The motion at one instant.

    Attributes:
        t_ns: the position's instant.
        position_um: as measured; as fitted where the measured one is a spike.
        sigma_um: standard deviation of one measured position.
        velocity_um_s, velocity_sigma_um_s: slope of the fit at that instant.
        velocity_age_s: how long before that instant lies the middle of the positions fitted; negative if after.
        late_um_s: by how much the newer half of these positions is faster or slower, beyond what their noise explains.
        corner_um_s: by how much the speed changes at a corner so near that it may lie on either side; 0 if none does.
        acceleration_um_s2: 0 unless it was asked for.
        begin_ns: beginning of the stretch without a corner that it belongs to.
        after_corner: whether that began with a corner rather than with the first position, a gap or a jump.
        clearance: positions between this one and the nearest corner.
        spike: the position lies far off both its neighbours, on the same side.
    """

    t_ns: int
    position_um: float
    sigma_um: float
    velocity_um_s: float
    velocity_sigma_um_s: float
    velocity_age_s: float
    late_um_s: float
    corner_um_s: float
    acceleration_um_s2: float
    begin_ns: int
    after_corner: bool
    clearance: int
    spike: bool


class _Position(NamedTuple):
    t_ns: int
    t_s: float
    x_um: float
    sigma_um: float
    rank: int = 0
    spike: bool = False
    corner_um_s: float = 0.0


class LocalMotion:
    """Positions in, motions out, `lag` positions later and one for each.

    A position that lies far off both neighbours, on the same side, is a spike: no fit uses it.

    Raises:
        OutOfRange: the settings make no sense; see `MotionSettings.check`.
    """

    def __init__(self, settings: MotionSettings | None = None) -> None:
        self.settings = settings or MotionSettings()
        self.settings.check()
        self._beyond = min(self.settings.lag - 1, _MOST_BEYOND)
        self._scatter = RunningScatter()
        self._zero_ns: int | None = None
        self._newest: deque[_Position] = deque(maxlen=2)
        self._unscreened = False
        self._points: deque[Point] = deque(maxlen=int(self.settings.window))
        self._pending: deque[_Position] = deque()
        self._count = 0
        self._begin_ns = 0
        self._after_corner = False
        self._speed_um_s = 0.0

    def update(self, t_ns: int, x_um: float, sigma_um: float) -> list[InstantMotion]:
        """Take a position, newer than all before.

        Returns:
            The motions that are now certain, oldest first.
        """
        motions: list[InstantMotion] = []
        newest = self._newest
        if newest and t_ns - newest[-1].t_ns > self.settings.max_gap_s * NS_PER_S:
            motions = self.tell_now()
            self._begin_anew()
        if self._zero_ns is None:
            self._zero_ns = t_ns
        t_s = (t_ns - self._zero_ns) / NS_PER_S
        self._scatter.add(t_s, x_um)
        if self._unscreened:
            motions += self._push(newest[-1], spike=self._is_spike(t_s, x_um))
        if not newest:
            self._begin_ns = t_ns
        newest.append(_Position(t_ns, t_s, x_um, self._sigma_um(sigma_um)))
        self._unscreened = True
        return motions

    def tell_now(self) -> list[InstantMotion]:
        """Tell what has not been told yet, from what is known; the motion goes on."""
        motions = self._push(self._newest[-1], spike=False) if self._unscreened else []
        self._unscreened = False
        if self._pending:
            motions += self._settle(len(self._pending), self._fit(self._points), self._points, self._count + _FAR)
        return motions

    def _begin_anew(self) -> None:
        self._newest.clear()
        self._points.clear()
        self._count = 0
        self._after_corner = False

    # ------------------------------------------------------------------ one position

    def _sigma_um(self, stated_um: float) -> float:
        """What the positions scatter by; what is said of them until that is known, and at least half of it."""
        seen_um = self._scatter.sigma
        if math.isnan(seen_um):
            return max(stated_um, _LEAST_SIGMA_UM)
        return max(seen_um, 0.5 * stated_um, _LEAST_SIGMA_UM)

    def _is_spike(self, t_s: float, x_um: float) -> bool:
        """Whether the newest position sticks out between its neighbours, further than the peak of a reversal."""
        if len(self._newest) < 2:
            return False
        before, middle = self._newest
        beyond_um = max(min(before.x_um, x_um) - middle.x_um, middle.x_um - max(before.x_um, x_um))
        return beyond_um > _SPIKE_SIGMAS * middle.sigma_um + self._speed_um_s * (t_s - before.t_s)

    def _push(self, position: _Position, *, spike: bool) -> list[InstantMotion]:
        motions: list[InstantMotion] = []
        t_ns, t_s, x_um, sigma_um, _, _, _ = position
        self._pending.append(_Position(t_ns, t_s, x_um, sigma_um, self._count, spike))
        self._count += 1
        if not spike:
            self._points.append(Point(t_s, x_um))
        if not self._points:
            return motions
        fitted: Sequence[Point] = self._points
        line = self._fit(fitted)
        least_um2 = _CORNER * sigma_um * sigma_um
        if line.left_um2 >= least_um2 and len(self._points) >= _BEFORE + self._beyond:
            at = self._suspect(line, least_um2)
            if at < len(self._points) - self._beyond:
                motions = self._turn_near(line, at, least_um2)
                line = self._fit(fitted)
            elif at < len(self._points) and self._bends(at):
                fitted = [*self._points][: at + 1]
                line = self._fit(fitted)
        self._speed_um_s = abs(line.slope)
        surplus = len(self._pending) - (self.settings.lag - 1)
        if surplus > 0:
            motions += self._settle(surplus, line, fitted, self._count + _FAR)
        return motions

    def _fit(self, points: Sequence[Point]) -> LineFit:
        return fit(points, parabola=self.settings.with_acceleration)

    def _settle(self, count: int, line: LineFit, points: Sequence[Point], corner_rank: int) -> list[InstantMotion]:
        """Tell the oldest pending positions by the line through these points; the next corner has `corner_rank`."""
        motions = []
        half = fit([*points][-max(2, len(points) // 2) :]) if self.settings.with_lateness else line
        for _ in range(count):
            t_ns, t_s, x_um, sigma_um, rank, spike, corner_um_s = self._pending.popleft()
            clearance = corner_rank - 1 - rank
            motions.append(
                InstantMotion(
                    t_ns,
                    line.position_um(t_s) if spike else x_um,
                    sigma_um,
                    line.velocity_um_s(t_s),
                    sigma_um * line.velocity_spread_per_s(t_s),
                    t_s - line.middle_s,
                    _beyond_noise_um_s(half, line, sigma_um),
                    corner_um_s,
                    2.0 * line.bend,
                    self._begin_ns,
                    self._after_corner,
                    min(clearance, rank) if self._after_corner else clearance,
                    spike,
                )
            )
        return motions

    # ------------------------------------------------------------------ corners

    def _suspect(self, line: LineFit, least_um2: float) -> int:
        """Index of the point before a corner, if one explains as much as `least_um2`; else the number of points."""
        points = self._points
        newest = len(points) - 2
        gains = broken_line_gains(points, line, newest=newest, oldest=max(_BEFORE - 1, newest - _LOOK_BACK))
        best = max(gains)
        return newest - gains.index(best) if best >= least_um2 else len(points)

    def _bends(self, at: int) -> bool:
        """Whether the slopes on either side of a point differ as at a reversal, a start or a stop."""
        points = [*self._points]
        before, after = fit(points[: at + 1]).slope, fit(points[at:]).slope
        return abs(after - before) >= _LEAST_TURN * max(abs(after), abs(before))

    def _turn_near(self, line: LineFit, at: int, least_um2: float) -> list[InstantMotion]:
        """Turn at the corner near a point, or at a jump if that explains clearly more; there may be neither."""
        points = self._points
        begin_s, end_s = points[at - 1].t_s, points[at + 1].t_s
        instants = [begin_s + (end_s - begin_s) * step / _REFINED for step in range(_REFINED + 1)]
        gains = [shape_gain(points, line, [max(t_s - instant, 0.0) for t_s, _ in points]) for instant in instants]
        jumps = [
            shape_gain(points, line, [1.0 if i > j else 0.0 for i in range(len(points))]) for j in (at - 1, at, at + 1)
        ]
        if max(jumps) > max(gains) + least_um2:
            return self._turn(points[at - 1 + jumps.index(max(jumps))].t_s, jump=True)
        return self._turn(instants[gains.index(max(gains))], jump=False) if self._bends(at) else []

    def _turn(self, corner_s: float, *, jump: bool) -> list[InstantMotion]:
        """Tell what lies before a corner, and begin a new motion there."""
        assert self._zero_ns is not None
        old = [point for point in self._points if point.t_s <= corner_s]
        new = [point for point in self._points if point.t_s > corner_s]
        line = self._fit(old)
        self._points.clear()
        if not jump:
            self._points.extend([Point(corner_s, line.position_um(corner_s))] * _ANCHOR_WEIGHT)
            near_s = _NEAR_CORNER * (new[0].t_s - old[-1].t_s)
            turn_um_s = abs(fit([*self._points, *new]).slope - line.slope)
            self._pending = deque(
                p._replace(corner_um_s=turn_um_s) if abs(p.t_s - corner_s) <= near_s else p for p in self._pending
            )
        self._points.extend(new)
        past = sum(position.t_s <= corner_s for position in self._pending)
        corner_rank = self._pending[past].rank
        motions = self._settle(past, line, old, corner_rank)
        self._pending = deque(p._replace(rank=p.rank - corner_rank) for p in self._pending)
        self._count -= corner_rank
        self._begin_ns = self._zero_ns + round((new[0].t_s if jump else corner_s) * NS_PER_S)
        self._after_corner = not jump
        return motions


def _beyond_noise_um_s(part: LineFit, whole: LineFit, sigma_um: float) -> float:
    """By how much the slope of a part of some positions differs from that of all, less what noise explains."""
    if not part.norm1 > 0.0:
        return 0.0
    noise_um_s = _LATE_SIGMAS * sigma_um * math.sqrt(max(1.0 / part.norm1 - 1.0 / whole.norm1, 0.0))
    return math.sqrt(max((part.slope - whole.slope) ** 2 - noise_um_s**2, 0.0))
