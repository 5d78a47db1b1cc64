"""The motor behind the drive: moves with separate starting and stopping rates on an axis of the world."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from microdrivers.core.units import NS_PER_MS
from microdrivers.fakes.world.axis import Axis, Encoder

_IN_POSITION_STEPS = 1.0
_ENCODER_NOISE_STEPS = 0.15
_START_DELAY_MS = (0.2, 2.0)
"""MOVE turns on at most 2 ms after the query has been processed (HP-5142E)."""


class Motor:
    """Steps in the drive's coordinates, on top of an axis whose unit is the motor step.

    Args:
        axis: the truth that the rest of the world sees.
        seed: of the encoder's noise and of the delay between a command and the start of motion.
    """

    def __init__(self, axis: Axis, *, seed: int) -> None:
        self._axis = axis
        self._zero_steps = 0
        self._encoder = Encoder(axis, resolution=1.0, noise=_ENCODER_NOISE_STEPS, seed=seed)
        self._random = np.random.default_rng(seed + 1)
        self._start_ns = -(10**18)

    # ------------------------------------------------------------------ monitors

    def command_steps(self, t_ns: int) -> int:
        """Command position."""
        return round(self._axis.setpoint_at(t_ns)[0]) - self._zero_steps

    def feedback_steps(self, t_ns: int) -> int:
        """Position from the absolute encoder, in whole steps."""
        return self._encoder.counts_at(t_ns) - self._zero_steps

    def command_speed_hz(self, t_ns: int) -> float:
        """Command speed, step/s, signed."""
        return self._axis.setpoint_at(t_ns)[1]

    def feedback_speed_hz(self, t_ns: int) -> float:
        """Speed of the shaft, step/s, signed."""
        return self._axis.speed_at(t_ns)

    def moving(self, t_ns: int) -> bool:
        """Whether a commanded motion is under way."""
        return t_ns >= self._start_ns and self._axis.moving_at(t_ns)

    def in_position(self, t_ns: int) -> bool:
        """Whether the commanded motion has ended and the shaft has settled."""
        deviation = self._axis.position_at(t_ns) - self._axis.setpoint_at(t_ns)[0]
        return not self.moving(t_ns) and abs(deviation) <= _IN_POSITION_STEPS

    # ------------------------------------------------------------------ commands

    def move(self, t_ns: int, target_steps: int, *, speed_hz: float, start_rate: float, stop_rate: float) -> None:
        """Go to a position; rates in step/s². A running motion is changed on the way."""
        delay_ms = self._random.uniform(*_START_DELAY_MS)
        self._start_ns = t_ns if self.moving(t_ns) else t_ns + round(delay_ms * NS_PER_MS)
        target = float(target_steps + self._zero_steps)
        self._axis.move(self._start_ns, target, speed=speed_hz, acceleration=start_rate, deceleration=stop_rate)

    def stop(self, t_ns: int, *, stop_rate: float) -> None:
        """Brake to a standstill."""
        self._axis.halt(t_ns, deceleration=stop_rate)

    def define_position(self, t_ns: int, steps: int) -> None:
        """Let the present command position be called `steps`."""
        self._zero_steps = round(self._axis.setpoint_at(t_ns)[0]) - steps

    def time_outside(self, lowest_steps: int, highest_steps: int) -> int | None:
        """When the motion under way first leaves the limits; None if it ends inside them."""
        low, high = lowest_steps + self._zero_steps, highest_steps + self._zero_steps

        def outside(t_ns: int) -> bool:
            return not low <= self._axis.setpoint_at(t_ns)[0] <= high

        end_ns = self._axis.profile_end_ns
        return first_time(outside, self._start_ns, end_ns) if outside(end_ns) else None


def first_time(condition: Callable[[int], bool], low_ns: int, high_ns: int) -> int:
    """When a condition begins to hold for good, found by bisection in [low_ns, high_ns]."""
    while low_ns < high_ns:
        middle_ns = (low_ns + high_ns) // 2
        if condition(middle_ns):
            high_ns = middle_ns
        else:
            low_ns = middle_ns + 1
    return low_ns
