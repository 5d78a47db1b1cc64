"""Puts an emulated measuring amplifier with a force probe on a force sensor's CAN bus."""

from __future__ import annotations

import math

import pydantic

from microdrivers.core.units import seconds_to_ns
from microdrivers.devices.drivers import Emulation, EmulationRequest, Emulator
from microdrivers.fakes.canopen.attachment import Connection, attach_nodes
from microdrivers.fakes.cia404.amplifier import Amplifier, InputSpec
from microdrivers.fakes.rig_section import parse_settings
from microdrivers.fakes.world.force_probe import probe_of

_ZERO_V, _SWING_V = 2.25, 2.0
"""A probe's output without force, and how far its range moves it."""

_OVERRANGE = 0.05
"""How far beyond the range the input goes, as a share of the range."""


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
    probe = probe_of(
        request,
        zero_V=spec.zero_V,
        sensitivity_uN_per_V=spec.sensitivity_uN_per_V,
        output_V=spec.input_V,
        bandwidth_hz=settings.bandwidth_hz,
        # What a first-order low-pass does to a force that changes slowly.
        delay_ns=seconds_to_ns(1.0 / (2.0 * math.pi * settings.bandwidth_hz)),
    )
    amplifier = Amplifier(probe.voltage_at, spec, node_id=settings.node_id, seed=request.seed + 1)
    return attach_nodes(request, settings.connection, [amplifier.node], {"amplifier": amplifier})


EMULATOR = Emulator(attach=_attach)
