"""One axis of motion as a function of time: closed-form profiles, servo lag, lost motion at reversals."""

from __future__ import annotations

import bisect
import math
import threading
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.core.units import NS_PER_S

_KEPT_SEGMENTS = 4096
_DRAWN_AT_ONCE = 64
_ARRIVED_LAGS = 12.0
_STILL_LAGS = 40.0
"""After so many time constants what is left of any lag is lost in rounding."""
_NEGLIGIBLE = 1e-7
"""Distance (µm or degrees) that is no motion: a rounding error must not look like a reversal."""


class _Segment(NamedTuple):
    """Set-point with constant acceleration from `t_ns` on, and the decaying lag of what follows it.

    `play` is where the drive stands in its lost motion: −1 and +1 push the table, between them it is free.
    """

    t_ns: int
    position: float
    speed: float
    acceleration: float
    lag: float
    play: float
    play_rate: float


class Axis:
    """Position of a closed-loop axis at any instant; length unit µm or degrees.

    The set-point follows trapezoidal profiles; the axis follows the set-point with a first-order lag, which
    is also how it settles. After a change of direction the table rests until the drive has crossed the lost
    motion; at the beginning the drive stands in the middle of it. One thread may command while others look.

    Args:
        position: where it is at the beginning.
        lag_s: time constant of the servo, ≥ 0.
        lost_motion: play of the drive, in the axis' unit.
    """

    def __init__(self, position: float, *, lag_s: float, lost_motion: float = 0.0) -> None:
        self._lag_s = lag_s
        self._lost_motion = lost_motion
        self._segments = [_Segment(-(10**18), position, 0.0, 0.0, 0.0, 0.0, 0.0)]
        self._times = [self._segments[0].t_ns]
        self._commanded_ns: list[int] = []
        self._listeners: list[Callable[[int], None]] = []
        self._lock = threading.RLock()

    # ------------------------------------------------------------------ state at an instant

    def setpoint_at(self, t_ns: int) -> tuple[float, float]:
        """Commanded position and speed."""
        segment, s = self._segment_at(t_ns)
        position = segment.position + segment.speed * s + 0.5 * segment.acceleration * s * s
        return position, segment.speed + segment.acceleration * s

    def position_at(self, t_ns: int) -> float:
        """Where the table is."""
        segment, s = self._segment_at(t_ns)
        tau = self._lag_s
        speed = segment.speed + segment.acceleration * s
        setpoint = segment.position + segment.speed * s + 0.5 * segment.acceleration * s * s
        steady = setpoint - tau * speed + tau * tau * segment.acceleration
        return steady + (segment.lag * math.exp(-s / tau) if segment.lag else 0.0)

    def positions_at(self, t_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """Where the table is at many rising instants."""
        with self._lock:
            first = max(bisect.bisect_right(self._times, int(t_ns[0])) - 1, 0)
            last = max(bisect.bisect_right(self._times, int(t_ns[-1])), first + 1)
            segments = self._segments[first:last]
        begins = [0, *np.searchsorted(t_ns, [segment.t_ns for segment in segments[1:]]).tolist(), len(t_ns)]
        positions = np.empty(len(t_ns))
        tau = self._lag_s
        for segment, begin, end in zip(segments, begins, begins[1:], strict=False):
            s = np.maximum(t_ns[begin:end] - segment.t_ns, 0) / NS_PER_S
            speed = segment.speed + segment.acceleration * s
            setpoint = segment.position + segment.speed * s + 0.5 * segment.acceleration * s * s
            positions[begin:end] = setpoint - tau * speed + tau * tau * segment.acceleration
            if segment.lag:
                positions[begin:end] += segment.lag * np.exp(-s / tau)
        return positions

    def speed_at(self, t_ns: int) -> float:
        """How fast the table moves."""
        segment, s = self._segment_at(t_ns)
        tau = self._lag_s
        decay = -segment.lag / tau * math.exp(-s / tau) if segment.lag else 0.0
        return segment.speed + segment.acceleration * (s - tau) + decay

    def moving_at(self, t_ns: int) -> bool:
        """Whether the set-point's profile is still running."""
        return t_ns < self.profile_end_ns

    @property
    def profile_end_ns(self) -> int:
        """When the last profile ends (or ended)."""
        with self._lock:  # not in the middle of a command
            return self._times[-1]

    def still_from_ns(self) -> int:
        """From when on, unless it is commanded again, the position is one and the same number."""
        return self.profile_end_ns + round(_STILL_LAGS * self._lag_s * NS_PER_S)

    def commanded_ns(self, t_ns: int) -> int | None:
        """When it was last told to go somewhere, up to `t_ns`; None if never."""
        with self._lock:
            i = bisect.bisect_right(self._commanded_ns, t_ns)
            return self._commanded_ns[i - 1] if i else None

    # ------------------------------------------------------------------ commands

    def on_change(self, listener: Callable[[int], None]) -> None:
        """Call `listener` with the instant from which on a command has changed the plans; it must not ask back."""
        self._listeners.append(listener)

    def move(
        self,
        t_ns: int,
        target: float,
        *,
        speed: float,
        acceleration: float,
        deceleration: float | None = None,
    ) -> int:
        """Begin a profile to `target` at `t_ns`, from whatever the set-point is doing; returns when it ends.

        `deceleration` is the rate of braking, by default `acceleration`.
        """
        with self._lock:
            bisect.insort(self._commanded_ns, t_ns)
            del self._commanded_ns[: -2 * _KEPT_SEGMENTS]
            braking = acceleration if deceleration is None else deceleration
            end_ns = self._plan(t_ns, target, speed, acceleration, braking)
            self._tell(t_ns)
            return end_ns

    def halt(self, t_ns: int, *, deceleration: float) -> int:
        """Brake to a standstill from `t_ns` on; returns when the set-point stands."""
        with self._lock:
            position, velocity = self._cut(t_ns)
            end_ns, position = self._brake(t_ns, position, velocity, deceleration)
            self._add(end_ns, position, 0.0, 0.0)
            self._tell(t_ns)
            return end_ns

    def _tell(self, t_ns: int) -> None:
        """Of a change, once it is whole: what others work out meanwhile they work out again."""
        for listener in self._listeners:
            listener(t_ns)

    def within_from_ns(self, window: float) -> int:
        """From when on the table stays within `window` (> 0) of its target; never before the profile ends."""
        with self._lock:
            last = self._segments[-1]
        if abs(last.lag) <= window:
            return last.t_ns
        return last.t_ns + math.ceil(self._lag_s * math.log(abs(last.lag) / window) * NS_PER_S)

    def knots_until(self, t_ns: int) -> list[float]:
        """Set-points where profiles changed, up to `t_ns`; between two of them the motion is monotone."""
        with self._lock:
            return [segment.position for segment in self._segments[: bisect.bisect_right(self._times, t_ns)]]

    def settled_by_ns(self) -> int:
        """When the lag after the last profile has died out for any practical purpose."""
        return self.profile_end_ns + round(_ARRIVED_LAGS * self._lag_s * NS_PER_S)

    # ------------------------------------------------------------------ segments

    def _segment_at(self, t_ns: int) -> tuple[_Segment, float]:
        with self._lock:
            i = bisect.bisect_right(self._times, t_ns)
            segment = self._segments[i - 1 if i else 0]
        # Before the oldest segment that is kept, the axis stands where that one begins.
        return segment, (t_ns - segment.t_ns) / NS_PER_S if i else 0.0

    def _plan(self, t_ns: int, target: float, speed: float, acceleration: float, braking: float) -> int:
        position, velocity = self._cut(t_ns)
        beyond = target - (position + velocity * abs(velocity) / (2.0 * braking))
        if beyond * velocity < 0.0:
            t_ns, position = self._brake(t_ns, position, velocity, braking)
            velocity = 0.0
        if velocity == 0.0:
            if abs(target - position) <= _NEGLIGIBLE:
                self._add(t_ns, target, 0.0, 0.0)
                return t_ns
            t_ns = self._cross_lost_motion(t_ns, position, target, acceleration)
        return self._profile(t_ns, position, abs(velocity), target, speed, acceleration, braking)

    def _cut(self, t_ns: int) -> tuple[float, float]:
        """Forget what was planned after `t_ns`; returns the set-point there."""
        state = self.setpoint_at(t_ns)
        keep = max(bisect.bisect_left(self._times, t_ns), 1)
        del self._segments[keep:], self._times[keep:]
        return state

    def _brake(self, t_ns: int, position: float, velocity: float, deceleration: float) -> tuple[int, float]:
        if velocity == 0.0:
            return t_ns, position
        sign = math.copysign(1.0, velocity)
        self._add(t_ns, position, velocity, -sign * deceleration)
        duration_s = abs(velocity) / deceleration
        return t_ns + round(duration_s * NS_PER_S), position + 0.5 * velocity * duration_s

    def _cross_lost_motion(self, t_ns: int, position: float, target: float, acceleration: float) -> int:
        side = math.copysign(1.0, target - position)
        to_cross = side - self._play_at(t_ns)
        length = 0.5 * abs(to_cross) * self._lost_motion
        duration_ns = round(math.sqrt(2.0 * length / acceleration) * NS_PER_S)
        if duration_ns:
            self._add(t_ns, position, 0.0, 0.0, play_rate=to_cross * NS_PER_S / duration_ns)
        return t_ns + duration_ns

    def _profile(
        self,
        t_ns: int,
        position: float,
        start_speed: float,
        target: float,
        speed: float,
        acceleration: float,
        braking: float,
    ) -> int:
        distance = abs(target - position)
        sign = math.copysign(1.0, target - position)
        # Without a cruise, (peak² − start²)/(2·acceleration) + peak²/(2·braking) is the distance.
        inverse_rates = 1.0 / acceleration + 1.0 / braking
        peak = min(speed, math.sqrt((2.0 * distance + start_speed**2 / acceleration) / inverse_rates))
        ramp = acceleration if peak >= start_speed else -braking
        ramp_s = (peak - start_speed) / ramp
        ramp_length = 0.5 * (start_speed + peak) * ramp_s
        brake_s = peak / braking
        cruise_s = max(0.0, (distance - ramp_length - 0.5 * peak * brake_s) / peak)
        for duration_s, from_speed, rate in (
            (ramp_s, start_speed, ramp), (cruise_s, peak, 0.0), (brake_s, peak, -braking),
        ):  # fmt: skip
            self._add(t_ns, position, sign * from_speed, sign * rate)
            position += sign * (from_speed * duration_s + 0.5 * rate * duration_s**2)
            t_ns += round(duration_s * NS_PER_S)
        self._add(t_ns, target, 0.0, 0.0)
        return t_ns

    def _play_at(self, t_ns: int) -> float:
        segment, s = self._segment_at(t_ns)
        return segment.play + segment.play_rate * s

    def _add(self, t_ns: int, position: float, speed: float, acceleration: float, *, play_rate: float = 0.0) -> None:
        tau = self._lag_s
        steady = position - tau * speed + tau * tau * acceleration
        lag = self.position_at(t_ns) - steady if tau > 0.0 else 0.0
        play = self._play_at(t_ns)
        if self._times[-1] == t_ns:
            self._segments.pop()
            self._times.pop()
        self._segments.append(_Segment(t_ns, position, speed, acceleration, lag, play, play_rate))
        self._times.append(t_ns)
        if len(self._segments) > 2 * _KEPT_SEGMENTS:
            del self._segments[:_KEPT_SEGMENTS], self._times[:_KEPT_SEGMENTS]


class Encoder:
    """A quantised, noisy reading of an axis.

    Args:
        resolution: size of one count, µm or degrees.
        noise: standard deviation of the reading before quantisation, same unit.
        offset: what an incremental encoder adds until its reference is known.
    """

    def __init__(self, axis: Axis, *, resolution: float, noise: float, seed: int, offset: float = 0.0) -> None:
        self.axis = axis
        self.resolution = resolution
        self.noise = noise
        self.offset = offset
        self._next_normal = _standard_normals(seed).__next__

    def counts_at(self, t_ns: int) -> int:
        """Whole counts read at an instant; each call draws new noise."""
        true = self.axis.position_at(t_ns) + self.offset
        return round((true + self.noise * self._next_normal()) / self.resolution)

    def position_at(self, t_ns: int) -> float:
        """The reading in µm or degrees."""
        return self.counts_at(t_ns) * self.resolution


def _standard_normals(seed: int) -> Iterator[float]:
    """Normally distributed numbers without end; many at once cost a tenth of one at a time."""
    random = np.random.default_rng(seed)
    while True:
        yield from random.standard_normal(_DRAWN_AT_ONCE).tolist()
