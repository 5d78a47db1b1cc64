"""Puts an emulated analogue-input module, with a force probe on one of its inputs, at the other end of a port."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Literal, Protocol, runtime_checkable

import pydantic

from microdrivers.core.errors import ConfigError, UnsupportedError
from microdrivers.devices.drivers import Emulation, EmulationRequest, Emulator, Endpoint, ServeRequest
from microdrivers.fakes.modbus import TcpGateway
from microdrivers.fakes.modbus_analogue.models import CHANNELS, MODELS
from microdrivers.fakes.modbus_analogue.module import AnalogueModule
from microdrivers.fakes.modbus_analogue.port import AnaloguePort
from microdrivers.fakes.modbus_analogue.probe import ForceProbe
from microdrivers.fakes.wire import Wire, WireEmulator, forget_wire, register_wire, serve_wire
from microdrivers.fakes.world.settings import ForceWorld

_NETWORK_BAUDRATE, _NETWORK_BITS_PER_BYTE = 10**9, 8
"""Next to the line behind the gateway, bytes on a network take no time."""


@runtime_checkable
class WorldWithForces(Protocol):
    """What a world must have for this emulator. Noise, drift and zero are those of its `settings.force`, if any."""

    def force_uN(self, sensor: str, t_ns: int) -> float:
        """True force along a sensor's axis."""


class _Connection(pydantic.BaseModel, extra="ignore", frozen=True):
    """The RS-485 line; with framing `tcp`, the one behind the gateway."""

    framing: Literal["rtu", "tcp"] = "rtu"
    baudrate: int = 9600
    parity: Literal["N", "E", "O"] = "N"
    stopbits: Literal[1, 2] = 1

    @property
    def bits_per_byte(self) -> int:
        return 9 + self.stopbits + (self.parity != "N")


class _Settings(pydantic.BaseModel, extra="ignore", frozen=True, allow_inf_nan=False):
    """The part of the rig file's section that module and probe themselves are set to."""

    connection: _Connection
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
    settings = _parse(request.name, request.settings)
    connection = settings.connection
    port = AnaloguePort(
        _build_module(request, settings),
        baudrate=connection.baudrate,
        bits_per_byte=connection.bits_per_byte,
        seed=request.seed,
    )
    network = connection.framing == "tcp"
    emulator: WireEmulator = TcpGateway(port) if network else port
    wire = Wire(
        emulator,
        clock=request.clock,
        seed=request.seed,
        baudrate=_NETWORK_BAUDRATE if network else connection.baudrate,
        bits_per_byte=_NETWORK_BITS_PER_BYTE if network else connection.bits_per_byte,
    )
    url = register_wire(request.name, wire)

    def serve(where: ServeRequest) -> Endpoint:
        return serve_wire(request.name, wire, request.clock, replace(where, transport="tcp") if network else where)

    return Emulation(
        overrides={"connection": {"port": url}},
        close=lambda: forget_wire(request.name, wire),
        wire_log=wire.log,
        serve=serve,
    )


def _build_module(request: EmulationRequest, settings: _Settings) -> AnalogueModule:
    if not isinstance(request.world, WorldWithForces):
        raise UnsupportedError(
            f"the world {type(request.world).__name__} has no forces",
            remedy="choose a world with tools that can touch something, such as `microscope`",
            device=request.name,
        )
    model = MODELS[settings.model]
    range_code = model.range_for(settings.range_V)
    if range_code is None:
        low_V, high_V = model.ranges[model.default_range].signal_V
        raise ConfigError(
            f"{request.name}: no range of the module {settings.model} takes {list(settings.range_V)} V",
            remedy=f"state a range within {low_V:g} to {high_V:g} V, or choose another module",
            key="range_V",
        )
    imperfections = _imperfections(request.world)
    probe = ForceProbe(
        partial(request.world.force_uN, request.name),
        zero_V=settings.zero_V,
        sensitivity_uN_per_V=settings.sensitivity_uN_per_V,
        output_V=settings.range_V,
        noise_uN_per_sqrt_Hz=imperfections.noise_uN_per_sqrt_Hz.get(
            request.name, imperfections.default_noise_uN_per_sqrt_Hz
        ),
        bandwidth_hz=settings.bandwidth_hz,
        drift_uN_per_min=imperfections.drift_uN_per_min,
        zero_spread_uN=imperfections.zero_spread_uN,
        seed=request.seed,
        start_ns=request.clock.now_ns(),
    )
    return AnalogueModule(
        model,
        probe.voltage_at,
        unit_id=settings.unit_id,
        channel=settings.channel,
        range_code=range_code,
        seed=request.seed,
    )


def _imperfections(world: object) -> ForceWorld:
    settings = getattr(getattr(world, "settings", None), "force", None)
    return settings if isinstance(settings, ForceWorld) else ForceWorld()


def _parse(name: str, settings: Mapping[str, Any]) -> _Settings:
    try:
        parsed = _Settings.model_validate(dict(settings))
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        raise ConfigError(
            f"{name}: the module cannot be set to {first['input']!r}: {first['msg']}",
            remedy="use what the module's manual allows: units 1 to 247, channels 1 to 8; and framing rtu or tcp",
            key=".".join(str(part) for part in first["loc"]),
        ) from error
    baudrates = MODELS[parsed.model].baudrates
    if parsed.connection.baudrate not in baudrates:
        raise ConfigError(
            f"{name}: the module {parsed.model} has no baud rate {parsed.connection.baudrate}",
            remedy=f"choose one of {', '.join(map(str, sorted(baudrates)))}",
            key="connection.baudrate",
        )
    return parsed


EMULATOR = Emulator(attach=_attach)
