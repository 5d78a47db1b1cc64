"""Whether a tool that was taken away still presses: what it was taken away from may have come after it."""

from __future__ import annotations

import math

from microdrivers.core.clock import Clock
from microdrivers.core.samples import ForceSample
from microdrivers.core.units import NS_PER_S, seconds_to_ns
from microdrivers.devices.fine_stage import FineStage
from microdrivers.devices.force_sensor import ForceSensor
from microdrivers.rig.safety_section import ForceGuardSettings

_CLEAR_SHARE = 0.1
"""Of a guard's limit: a tool that was taken away and feels more still presses."""

_MEAN_NS, _FEWEST_READINGS = NS_PER_S // 4, 3
"""What is judged is the mean of so long: one reading may be noise."""

_SETTLES_PER_BANDWIDTH = 1.0
"""In s·Hz: a first-order sensor has then come to within 0.2 % of what it feels."""

_WATCH_NS = 20 * NS_PER_S
"""A soft specimen comes back within seconds; later forces are somebody else's."""

_PATIENCE_S = 0.5


class Aftermath:
    """Follows the force after a retraction, until the stage is commanded again or 20 s have passed.

    Args:
        guard: whose limit and zero count.
        clock: of the rig.
    """

    def __init__(self, guard: ForceGuardSettings, *, clock: Clock) -> None:
        self._guard = guard
        self._clock = clock
        self._judged = clock.event()
        self._watching = False
        self._commanded_ns = self._settle_ns = 0
        self._stands_ns: int | None = None
        self._begin_mean()

    def begin(self, stage: FineStage, sensor: ForceSensor) -> None:
        """The tool is on its way out, or there."""
        self._commanded_ns = stage.commanded_ns
        self._settle_ns = seconds_to_ns(_SETTLES_PER_BANDWIDTH / sensor.bandwidth_hz)
        self._stands_ns = None
        self._judged.clear()
        self._watching = True

    def wait(self) -> None:
        """Wait until the tool was judged once since it stands, if that is to be expected."""
        if self._watching:
            settle_s = (self._settle_ns + _MEAN_NS) / NS_PER_S
            self._judged.wait(settle_s + _PATIENCE_S)

    def take(self, stage: FineStage, sample: ForceSample, force_uN: float) -> float | None:
        """Take a reading; the mean force, µN, if by that the tool still presses, infinite if the sensor is saturated.

        Args:
            stage: that carries the tool.
            sample: the reading.
            force_uN: what the guard judges it to be; NaN if it is not known.
        """
        if not self._watching:
            return None
        if stage.retracting:  # by somebody else, perhaps, who has replaced the guard's
            self._commanded_ns = stage.commanded_ns
        elif stage.commanded_ns != self._commanded_ns:
            self._end()
            return None
        if stage.may_be_moving:
            self._stands_ns = None
            return None
        if self._stands_ns is None:
            self._stands_ns = self._clock.now_ns()
            self._begin_mean()
        if sample.t_ns < self._stands_ns + self._settle_ns:
            return None
        mean_uN = self._mean_uN(sample.t_ns, force_uN)
        if mean_uN is None:
            return None
        clear_uN = max(_CLEAR_SHARE * self._guard.max_force_uN, self._guard.zero_uN if sample.tare_uN == 0.0 else 0.0)
        presses = abs(mean_uN) > clear_uN
        self._judged.set()
        if presses or sample.t_ns > self._stands_ns + _WATCH_NS:
            self._end()
        return mean_uN if presses else None

    def _mean_uN(self, t_ns: int, force_uN: float) -> float | None:
        if math.isnan(force_uN):
            self._begin_mean()
            return None
        if not self._readings:
            self._since_ns = t_ns
        self._readings += 1
        self._sum_uN += force_uN
        if t_ns - self._since_ns < _MEAN_NS or self._readings < _FEWEST_READINGS:
            return None
        mean_uN = self._sum_uN / self._readings
        self._begin_mean()
        return mean_uN

    def _begin_mean(self) -> None:
        self._readings, self._sum_uN, self._since_ns = 0, 0.0, 0

    def _end(self) -> None:
        self._watching = False
        self._judged.set()
