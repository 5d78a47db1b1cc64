"""Puts the controller at the other end of the driver's serial line."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import pydantic
from pydantic import AliasChoices

from microdrivers.core.errors import UnsupportedError
from microdrivers.core.units import UM_PER_MM, Range
from microdrivers.devices.drivers import Emulation, EmulationRequest, Emulator
from microdrivers.fakes.pi_gcs.axis_channel import AxisChannel, AxisSpec
from microdrivers.fakes.pi_gcs.controller import GcsController
from microdrivers.fakes.pi_gcs.state import ControllerState
from microdrivers.fakes.wire import Wire, forget_wire, register_wire, serve_wire
from microdrivers.fakes.world.axis import Axis, Encoder

_BITS_PER_BYTE = 10
_DEFAULT_SERIAL_NUMBER = "116012345"
_FIRMWARE = "1.2.0.5"
_TRUE_PER_UNIT = {"x": UM_PER_MM, "y": UM_PER_MM, "theta": 1.0}
_DEFAULT_STAGE = {"x": "M-111.1DG", "y": "M-111.1DG", "theta": "M-116.DG"}


@runtime_checkable
class StageWorld(Protocol):
    """What a world offers to this controller; keys x, y (µm) and theta (degrees).

    `power_on_offset` is what the encoders show beyond the truth before they are referenced;
    `reference_position` is where the reference switches are; `pose_latch_delay_s` is when POS? samples the
    encoders, after the last byte of the request.
    """

    stage_axes: dict[str, Axis]
    encoder_noise: dict[str, float]
    power_on_offset: dict[str, float]
    reference_position: dict[str, float]
    pose_latch_delay_s: float


class _Settings(pydantic.BaseModel):
    """The part of the rig file that a controller could know; the rest is the driver's."""

    model_config = pydantic.ConfigDict(extra="ignore", frozen=True)


class _Axis(_Settings):
    """Numbers in µm for x and y, in degrees for theta."""

    id: str
    stage: str | None = None
    direction: Literal[1, -1] = 1
    travel: Range = pydantic.Field(validation_alias=AliasChoices("travel_um", "travel_deg"))
    max_speed: float = pydantic.Field(validation_alias=AliasChoices("max_speed_um_s", "max_speed_deg_s"))
    acceleration: float = pydantic.Field(validation_alias=AliasChoices("acceleration_um_s2", "acceleration_deg_s2"))
    resolution: float = pydantic.Field(validation_alias=AliasChoices("resolution_um", "resolution_deg"))
    tolerance: float = pydantic.Field(validation_alias=AliasChoices("tolerance_um", "tolerance_deg"))

    def spec(self, key: str, reference_position: float) -> AxisSpec:
        return AxisSpec(
            identifier=self.id,
            key=key,
            stage=self.stage or _DEFAULT_STAGE[key],
            direction=self.direction,
            true_per_unit=_TRUE_PER_UNIT[key],
            travel=self.travel,
            max_speed=self.max_speed,
            acceleration=self.acceleration,
            resolution=self.resolution,
            tolerance=self.tolerance,
            reference_position=reference_position,
        )


class _Axes(_Settings):
    x: _Axis
    y: _Axis
    theta: _Axis

    def by_key(self) -> Mapping[str, _Axis]:
        return {"x": self.x, "y": self.y, "theta": self.theta}


class _Connection(_Settings):
    baudrate: int = 115200


class StageSettings(_Settings):
    """The section of the rig file."""

    connection: _Connection
    controller: str = "C-884"
    serial_number: str | None = None
    axes: _Axes

    def identification(self) -> str:
        """The reply to *IDN?."""
        model = self.controller if "." in self.controller else f"{self.controller}.4DC"
        serial_number = self.serial_number or _DEFAULT_SERIAL_NUMBER
        return f"(c)2016 Physik Instrumente (PI) GmbH & Co. KG, {model}, {serial_number}, {_FIRMWARE}"


def build_controller(stage: StageSettings, world: StageWorld, *, seed: int) -> GcsController:
    """The controller of a rig file's stage section, on a world's axes."""
    random = np.random.default_rng(seed)
    channels = []
    for key, axis in stage.axes.by_key().items():
        spec = axis.spec(key, world.reference_position[key])
        encoder = Encoder(
            world.stage_axes[key],
            resolution=spec.resolution,
            noise=world.encoder_noise[key],
            seed=int(random.integers(2**31)),
            offset=world.power_on_offset[key],
        )
        channels.append(AxisChannel(spec, world.stage_axes[key], encoder))
    state = ControllerState(
        channels, identification=stage.identification(), pose_latch_delay_s=world.pose_latch_delay_s
    )
    return GcsController(state, seed=int(random.integers(2**31)))


def attach(request: EmulationRequest) -> Emulation:
    """Put a controller behind `fake://NAME`.

    Raises:
        UnsupportedError: the world has no XYθ stage.
    """
    if not isinstance(request.world, StageWorld):
        raise UnsupportedError(
            f"a world of type {type(request.world).__name__} has no XYθ stage",
            device=request.name,
            remedy="choose a world with a stage, for example world: microscope",
        )
    stage = StageSettings.model_validate(request.settings)
    controller = build_controller(stage, request.world, seed=request.seed)
    wire = Wire(
        controller,
        clock=request.clock,
        seed=request.seed + 1,
        baudrate=stage.connection.baudrate,
        bits_per_byte=_BITS_PER_BYTE,
    )
    url = register_wire(request.name, wire)
    return Emulation(
        overrides={"connection": {"port": url}},
        close=lambda: forget_wire(request.name, wire),
        wire_log=wire.log,
        serve=partial(serve_wire, request.name, wire, request.clock, overrides=_ON_A_REAL_PORT),
    )


# How late the operating system hands a request over, the emulator cannot know and the host must allow for.
_ON_A_REAL_PORT = {"latch": {"delay_ms": 0.2, "uncertainty_ms": 0.5}}

EMULATOR = Emulator(attach=attach)
