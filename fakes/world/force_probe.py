"""The output voltage of a capacitive force probe as a function of time: force, noise, drift and a zero of its own."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import numpy as np

from microdrivers.core.errors import UnsupportedError
from microdrivers.core.units import NS_PER_S
from microdrivers.devices.drivers import EmulationRequest
from microdrivers.fakes.world.settings import ForceWorld

_NS_PER_MIN = 60 * NS_PER_S


@runtime_checkable
class WorldWithForces(Protocol):
    """What a world must have for a probe. Noise, drift and zero are those of its `settings.force`, if any."""

    def force_uN(self, sensor: str, t_ns: int) -> float:
        """True force along a sensor's axis."""


class ForceProbe:
    """A probe and its amplifier, switched on at `start_ns`.

    The noise is white up to a first-order low-pass whose noise bandwidth is `bandwidth_hz`: its standard deviation is
    density · √bandwidth, as data sheets state it, and readings closer together than about 1/(4 · bandwidth) are alike.
    The force itself passes undelayed.

    Args:
        force_uN: true force at an instant.
        zero_V: output without force, were there neither drift nor a power-on zero.
        sensitivity_uN_per_V: not 0; negative if a push lowers the voltage.
        output_V: ends of the amplifier's output.
        noise_uN_per_sqrt_Hz: one-sided density.
        drift_uN_per_min: the rate is drawn, of either sign and between half and one and a half of it.
        zero_spread_uN: standard deviation of the power-on zero.
        seed: of noise, drift and zero.
    """

    def __init__(
        self,
        force_uN: Callable[[int], float],
        *,
        zero_V: float,
        sensitivity_uN_per_V: float,
        output_V: tuple[float, float],
        noise_uN_per_sqrt_Hz: float,
        bandwidth_hz: float,
        drift_uN_per_min: float,
        zero_spread_uN: float,
        seed: int,
        start_ns: int,
    ) -> None:
        self._force_uN = force_uN
        self._zero_V = zero_V
        self._sensitivity_uN_per_V = sensitivity_uN_per_V
        self._output_V = output_V
        self._random = np.random.default_rng((seed, 3))
        self._start_ns = start_ns
        self.power_on_uN = float(self._random.normal(0.0, zero_spread_uN))
        sign = 1.0 if self._random.random() < 0.5 else -1.0
        self.drift_uN_per_min = sign * float(self._random.uniform(0.5, 1.5)) * drift_uN_per_min
        self.noise_uN = noise_uN_per_sqrt_Hz * math.sqrt(bandwidth_hz)
        self._correlation_ns = NS_PER_S / (4.0 * bandwidth_hz)
        self._noise_at_ns = start_ns
        self._present_noise_uN = self.noise_uN * float(self._random.standard_normal())

    def voltage_at(self, t_ns: int) -> float:
        """The output, V; ask in the order of time, since noise has a memory."""
        drift_uN = self.drift_uN_per_min * (t_ns - self._start_ns) / _NS_PER_MIN
        total_uN = self._force_uN(t_ns) + self.power_on_uN + drift_uN + self._noise_uN_at(t_ns)
        low_V, high_V = self._output_V
        return min(max(self._zero_V + total_uN / self._sensitivity_uN_per_V, low_V), high_V)

    def _noise_uN_at(self, t_ns: int) -> float:
        kept = math.exp(-max(t_ns - self._noise_at_ns, 0) / self._correlation_ns)
        fresh = math.sqrt(1.0 - kept * kept) * self.noise_uN * float(self._random.standard_normal())
        self._present_noise_uN = kept * self._present_noise_uN + fresh
        self._noise_at_ns = t_ns
        return self._present_noise_uN


def probe_of(
    request: EmulationRequest,
    *,
    zero_V: float,
    sensitivity_uN_per_V: float,
    output_V: tuple[float, float],
    bandwidth_hz: float,
    delay_ns: int = 0,
) -> ForceProbe:
    """The probe of a device in its world, which feels what pressed on it `delay_ns` ago; otherwise see `ForceProbe`.

    Raises:
        UnsupportedError: the world has no forces.
    """
    world = request.world
    if not isinstance(world, WorldWithForces):
        raise UnsupportedError(
            f"the world {type(world).__name__} has no forces",
            remedy="choose a world with tools that can touch something, such as `microscope`",
            device=request.name,
        )
    own = getattr(getattr(world, "settings", None), "force", None)
    imperfections = own if isinstance(own, ForceWorld) else ForceWorld()
    return ForceProbe(
        lambda t_ns: world.force_uN(request.name, t_ns - delay_ns),
        zero_V=zero_V,
        sensitivity_uN_per_V=sensitivity_uN_per_V,
        output_V=output_V,
        noise_uN_per_sqrt_Hz=imperfections.noise_uN_per_sqrt_Hz.get(
            request.name, imperfections.default_noise_uN_per_sqrt_Hz
        ),
        bandwidth_hz=bandwidth_hz,
        drift_uN_per_min=imperfections.drift_uN_per_min,
        zero_spread_uN=imperfections.zero_spread_uN,
        seed=request.seed,
        start_ns=request.clock.now_ns(),
    )
