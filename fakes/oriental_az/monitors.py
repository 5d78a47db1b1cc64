"""Monitor registers of an AZ drive that tell about its motor (Oriental Motor HP-5142E)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from microdrivers.fakes.oriental_az import register_map as reg
from microdrivers.fakes.oriental_az.motor import Motor

_STEPS_PER_REVOLUTION = 1000
_DRIVER_TEMPERATURE, _MOTOR_TEMPERATURE, _TEMPERATURE_SCATTER = 352, 301, 3


def motor_monitors(motor: Motor, *, seed: int) -> dict[int, Callable[[int], float]]:
    """What each monitor shows at a time in ns: steps, step/s, r/min, 0.1 °C."""
    random = np.random.default_rng(seed)

    def rpm(speed_hz: Callable[[int], float]) -> Callable[[int], float]:
        return lambda t_ns: speed_hz(t_ns) * 60 / _STEPS_PER_REVOLUTION

    def temperature(tenths_c: int) -> Callable[[int], float]:
        return lambda _: tenths_c + int(random.integers(-_TEMPERATURE_SCATTER, _TEMPERATURE_SCATTER + 1))

    return {
        reg.COMMAND_POSITION: motor.command_steps,
        reg.COMMAND_SPEED_RPM: rpm(motor.command_speed_hz),
        reg.COMMAND_SPEED_HZ: motor.command_speed_hz,
        reg.FEEDBACK_POSITION: motor.feedback_steps,
        reg.FEEDBACK_SPEED_RPM: rpm(motor.feedback_speed_hz),
        reg.FEEDBACK_SPEED_HZ: motor.feedback_speed_hz,
        reg.DRIVER_TEMPERATURE: temperature(_DRIVER_TEMPERATURE),
        reg.MOTOR_TEMPERATURE: temperature(_MOTOR_TEMPERATURE),
    }
