"""Puts an emulated measuring amplifier with a force probe on a force sensor's CAN bus."""

from __future__ import annotations

import math
from typing import Protocol, runtime_checkable

import pydantic

from microdrivers.core.errors import UnsupportedError
from microdrivers.core.units import seconds_to_ns
from microdrivers.devices.drivers import Emulation, EmulationRequest, Emulator
from microdrivers.fakes.canopen.attachment import Connection, attach_nodes, parse_settings
from microdrivers.fakes.cia404.amplifier import Amplifier, InputSpec
from microdrivers.fakes.modbus_analogue.probe import ForceProbe
from microdrivers.fakes.world.settings import ForceWorld

_ZERO_V, _SWING_V = 2.25, 2.0
"""A probe's output without force, and how far its range moves it."""

_OVERRANGE = 0.05
"""How far beyond the range the input goes, as a share of the range."""


@runtime_checkable
class WorldWithForces(Protocol):
    """What a world must have for this emulator. Noise, drift and zero are those of its `settings.force`, if any."""

    def force_uN(self, sensor: str, t_ns: int) -> float:
        """True force along a sensor's axis."""


class _Settings(pydantic.BaseModel, extra="ignore", frozen=True, allow_inf_nan=False):
    """The part of the rig file's section that probe and amplifier are built or set to."""

    connection: Connection
    node_id: int = pydantic.Field(ge=1, le=127)
    range_uN: tuple[float, float] = (-2000.0, 2000.0)
    bandwidth_hz: float = pydantic.Field(default=500.0, gt=0)
    resolution_uN: float = pydantic.Field(default=0.01, gt=0)

    @pydantic.field_validator("range_uN")
    @classmethod
    def _rising(cls, value: tuple[float, float]) -> tuple[float, float]:
        if not value[0] < value[1]:
            raise ValueError("a range is [smaller, larger]")
        return value


def _attach(request: EmulationRequest) -> Emulation:
    """Build probe and amplifier and put them on their bus; the emulation's only device is the `Amplifier`.

    Raises:
        UnsupportedError: the world has no forces.
        ConfigError: the amplifier cannot be set to what the rig file says.
    """
    world = request.world
    if not isinstance(world, WorldWithForces):
        raise UnsupportedError(
            f"the world {type(world).__name__} has no forces",
            remedy="choose a world with tools that can touch something, such as `microscope`",
            device=request.name,
        )
    settings = parse_settings(
        request,
        _Settings,
        remedy="give a node id from 1 to 127, range_uN as [smaller, larger], and a positive bandwidth and resolution",
    )
    low_uN, high_uN = settings.range_uN
    sensitivity_uN_per_V = max(abs(low_uN), abs(high_uN)) / _SWING_V
    margin_uN = _OVERRANGE * (high_uN - low_uN)
    spec = InputSpec(
        zero_V=_ZERO_V,
        sensitivity_uN_per_V=sensitivity_uN_per_V,
        input_V=(
            _ZERO_V + (low_uN - margin_uN) / sensitivity_uN_per_V,
            _ZERO_V + (high_uN + margin_uN) / sensitivity_uN_per_V,
        ),
        resolution_V=settings.resolution_uN / sensitivity_uN_per_V,
    )
    probe = _build_probe(request, world, settings, spec)
    amplifier = Amplifier(probe.voltage_at, spec, node_id=settings.node_id, seed=request.seed + 1)
    return attach_nodes(request, settings.connection, [amplifier.node], {"amplifier": amplifier})


def _build_probe(request: EmulationRequest, world: WorldWithForces, settings: _Settings, spec: InputSpec) -> ForceProbe:
    own = getattr(getattr(world, "settings", None), "force", None)
    imperfections = own if isinstance(own, ForceWorld) else ForceWorld()
    # What a first-order low-pass does to a force that changes slowly.
    delay_ns = seconds_to_ns(1.0 / (2.0 * math.pi * settings.bandwidth_hz))
    return ForceProbe(
        lambda t_ns: world.force_uN(request.name, t_ns - delay_ns),
        zero_V=spec.zero_V,
        sensitivity_uN_per_V=spec.sensitivity_uN_per_V,
        output_V=spec.input_V,
        noise_uN_per_sqrt_Hz=imperfections.noise_uN_per_sqrt_Hz.get(
            request.name, imperfections.default_noise_uN_per_sqrt_Hz
        ),
        bandwidth_hz=settings.bandwidth_hz,
        drift_uN_per_min=imperfections.drift_uN_per_min,
        zero_spread_uN=imperfections.zero_spread_uN,
        seed=request.seed,
        start_ns=request.clock.now_ns(),
    )


EMULATOR = Emulator(attach=_attach)
