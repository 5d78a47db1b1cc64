"""The only source of time and the only way to wait."""

from microdrivers.core.clock.base import Clock, ClockError, ClockEvent, Timer, utc_now
from microdrivers.core.clock.simulated import SimulatedClock
from microdrivers.core.clock.system import SystemClock

__all__ = ["Clock", "ClockError", "ClockEvent", "SimulatedClock", "SystemClock", "Timer", "utc_now"]
