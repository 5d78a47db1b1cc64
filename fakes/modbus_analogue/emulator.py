"""Puts an emulated analogue-input module, with a force probe on one of its inputs, at the other end of a port."""

from __future__ import annotations

import pydantic

from microdrivers.core.errors import ConfigError
from microdrivers.devices.drivers import Emulation, EmulationRequest, Emulator
from microdrivers.fakes.modbus import SlaveLine, attach_slave
from microdrivers.fakes.modbus_analogue.models import CHANNELS, MODELS
from microdrivers.fakes.modbus_analogue.module import AnalogueModule
from microdrivers.fakes.modbus_analogue.port import AnaloguePort
from microdrivers.fakes.rig_section import parse_settings
from microdrivers.fakes.world.force_probe import probe_of


class _Settings(pydantic.BaseModel, extra="ignore", frozen=True, allow_inf_nan=False):
    """The part of the rig file's section that module and probe themselves are set to."""

    connection: SlaveLine
    unit_id: int = pydantic.Field(default=1, ge=1, le=247)
    model: str = "waveshare-8ch"
    channel: int = pydantic.Field(default=1, ge=1, le=CHANNELS)
    range_V: tuple[float, float] = (0.0, 5.0)
    zero_V: float
    sensitivity_uN_per_V: float
    bandwidth_hz: float = pydantic.Field(gt=0)

    @pydantic.field_validator("sensitivity_uN_per_V")
    @classmethod
    def _not_zero(cls, value: float) -> float:
        if value == 0:
            raise ValueError("the probe would have to give out an infinite voltage")
        return value

    @pydantic.field_validator("model")
    @classmethod
    def _known(cls, value: str) -> str:
        if value not in MODELS:
            raise ValueError(f"the emulated modules are {', '.join(MODELS)}")
        return value


def _attach(request: EmulationRequest) -> Emulation:
    """Build probe and module and their wire `fake://NAME`; with framing `tcp`, a gateway stands in front.

    Raises:
        UnsupportedError: the world has no forces.
        ConfigError: a module cannot be set to what the rig file says.
    """
    settings = _parse(request)
    connection = settings.connection
    port = AnaloguePort(
        _build_module(request, settings),
        baudrate=connection.baudrate,
        bits_per_byte=connection.bits_per_byte,
        seed=request.seed,
    )
    return attach_slave(request, port, connection)


def _build_module(request: EmulationRequest, settings: _Settings) -> AnalogueModule:
    model = MODELS[settings.model]
    range_code = model.range_for(settings.range_V)
    if range_code is None:
        low_V, high_V = model.ranges[model.default_range].signal_V
        raise ConfigError(
            f"{request.name}: no range of the module {settings.model} takes {list(settings.range_V)} V",
            remedy=f"state a range within {low_V:g} to {high_V:g} V, or choose another module",
            key="range_V",
        )
    probe = probe_of(
        request,
        zero_V=settings.zero_V,
        sensitivity_uN_per_V=settings.sensitivity_uN_per_V,
        output_V=settings.range_V,
        bandwidth_hz=settings.bandwidth_hz,
    )
    return AnalogueModule(
        model,
        probe.voltage_at,
        unit_id=settings.unit_id,
        channel=settings.channel,
        range_code=range_code,
        seed=request.seed,
    )


def _parse(request: EmulationRequest) -> _Settings:
    parsed = parse_settings(
        request,
        _Settings,
        remedy="use what the module's manual allows: units 1 to 247, channels 1 to 8; and framing rtu or tcp",
    )
    baudrates = MODELS[parsed.model].baudrates
    if parsed.connection.baudrate not in baudrates:
        raise ConfigError(
            f"{request.name}: the module {parsed.model} has no baud rate {parsed.connection.baudrate}",
            remedy=f"choose one of {', '.join(map(str, sorted(baudrates)))}",
            key="connection.baudrate",
        )
    return parsed


EMULATOR = Emulator(attach=_attach)
