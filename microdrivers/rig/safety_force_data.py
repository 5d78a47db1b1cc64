"""Whether the forces that come are valid, and fresh."""

from __future__ import annotations

import math

from microdrivers.core.clock import Clock, ClockError
from microdrivers.core.samples import ForceSample
from microdrivers.core.units import NS_PER_MS, NS_PER_S, seconds_to_ns
from microdrivers.devices.force_sensor import DISCONNECTED, SATURATED, STALE


class ForceData:
    """Judges the readings of a sensor; a saturated one is valid, for it shows that the force is large.

    Args:
        sensor: its name.
        clock: of the rig.
        stale_after_ns: readings that are older are no use.

    Attributes:
        invalid: what is wrong with the newest reading; empty if it is valid.
    """

    def __init__(self, sensor: str, *, clock: Clock, stale_after_ns: int) -> None:
        self.invalid = ""
        self._name = sensor
        self._clock = clock
        self._stale_after_ns = stale_after_ns
        self._heard_ns = -NS_PER_S
        self._awaited = False
        self._arrived = clock.event()

    def take(self, sample: ForceSample) -> None:
        """Take a reading; one flagged STALE is none: the age of the last one decides."""
        if STALE in sample.flags:
            return
        if DISCONNECTED in sample.flags:
            self.invalid = f"{self._name} reports {DISCONNECTED}"
        elif math.isnan(sample.raw_uN) and SATURATED not in sample.flags:
            self.invalid = f"{self._name} delivers no valid number"
        else:
            self._heard_ns = min(sample.t_ns, self._clock.now_ns())
            self.invalid = ""
            if self._awaited:
                self._arrived.set()

    @property
    def complaint(self) -> str:
        """What is wrong with the data now; empty if they are valid and fresh."""
        if self.invalid:
            return self.invalid
        age_ns = self._clock.now_ns() - self._heard_ns
        if age_ns <= self._stale_after_ns:
            return ""
        age = f" for {age_ns / NS_PER_MS:.0f} ms" if self._heard_ns >= 0 else ""
        return f"no reading has come from {self._name}{age}"

    def wait(self, timeout_s: float) -> None:
        """Wait until there is nothing to complain of, at most so long; a clock's callback does not wait."""
        deadline_ns = self._clock.now_ns() + seconds_to_ns(timeout_s)
        self._awaited = True
        try:
            while self.complaint and (left_ns := deadline_ns - self._clock.now_ns()) > 0:
                self._arrived.clear()
                if not self._arrived.wait(left_ns / NS_PER_S):
                    break
        except ClockError:
            pass  # a callback on a simulated clock cannot wait for what comes later
        finally:
            self._awaited = False
