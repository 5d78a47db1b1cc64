"""Puts the controller, or a chain of controllers, at the other end of the driver's serial line."""

from __future__ import annotations

from functools import partial
from typing import Protocol, runtime_checkable

import numpy as np

from microdrivers.core.errors import UnsupportedError
from microdrivers.devices.drivers import Emulation, EmulationRequest, Emulator
from microdrivers.fakes.pi_gcs.axis_channel import AxisChannel
from microdrivers.fakes.pi_gcs.controller import FIRST_ADDRESS, GcsController
from microdrivers.fakes.pi_gcs.daisy_chain import DaisyChain
from microdrivers.fakes.pi_gcs.settings import AxisSettings, StageSettings
from microdrivers.fakes.pi_gcs.state import ControllerState
from microdrivers.fakes.wire import Wire, forget_wire, register_wire, serve_wire
from microdrivers.fakes.world.axis import Axis, Encoder

_BITS_PER_BYTE = 10


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


def build_emulator(stage: StageSettings, world: StageWorld, *, seed: int) -> GcsController | DaisyChain:
    """What a rig file's stage section describes, on a world's axes: a controller, or a chain of controllers."""
    random = np.random.default_rng(seed)
    return _build_chain(stage, world, random) if stage.chained else _build_controller(stage, world, random)


def _build_controller(stage: StageSettings, world: StageWorld, random: np.random.Generator) -> GcsController:
    channels = [_build_channel(key, axis, world, random) for key, axis in stage.by_key().items()]
    state = ControllerState(
        channels, identification=stage.identification(), pose_latch_delay_s=world.pose_latch_delay_s
    )
    return GcsController(state, seed=_draw_seed(random))


def _build_chain(stage: StageSettings, world: StageWorld, random: np.random.Generator) -> DaisyChain:
    boxes = {}
    for key, axis in stage.by_key().items():
        state = ControllerState(
            [_build_channel(key, axis, world, random)],
            identification=stage.identification_of(axis),
            pose_latch_delay_s=world.pose_latch_delay_s,
            one_element_per_line=True,
        )
        boxes[key] = GcsController(state, seed=_draw_seed(random), address=axis.address or FIRST_ADDRESS)
    return DaisyChain(boxes)


def _build_channel(key: str, axis: AxisSettings, world: StageWorld, random: np.random.Generator) -> AxisChannel:
    spec = axis.spec(key, world.reference_position[key])
    encoder = Encoder(
        world.stage_axes[key],
        resolution=spec.resolution,
        noise=world.encoder_noise[key],
        seed=_draw_seed(random),
        offset=world.power_on_offset[key],
    )
    return AxisChannel(spec, world.stage_axes[key], encoder)


def _draw_seed(random: np.random.Generator) -> int:
    return int(random.integers(2**31))


def attach(request: EmulationRequest) -> Emulation:
    """Put a controller, or a chain of them, behind `fake://NAME`.

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
    wire = Wire(
        build_emulator(stage, request.world, seed=request.seed),
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
