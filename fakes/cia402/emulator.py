"""Puts three emulated servo drives, one for each axis of a fine stage, on the stage's CAN bus."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, Protocol, runtime_checkable

import pydantic

from microdrivers.core.errors import UnsupportedError
from microdrivers.devices.drivers import Emulation, EmulationRequest, Emulator
from microdrivers.fakes.canopen.attachment import Connection, attach_nodes
from microdrivers.fakes.cia402.drive import ServoDrive
from microdrivers.fakes.cia402.motion import AxisSpec, Motion
from microdrivers.fakes.cia402.objects import HOMING_METHODS
from microdrivers.fakes.rig_section import parse_settings
from microdrivers.fakes.world.axis import Axis
from microdrivers.fakes.world.settings import ToolsWorld

_SEEDS_A_DRIVE = 10
_HERE = 37

_SERVED_HEARTBEAT_MS = 500
"""Of drives that run as a program among others, watched by another one: a busy computer lets both wait."""


@runtime_checkable
class FineStageWorld(Protocol):
    """What a world must have for this emulator; the encoders' noise is that of its `settings.tools`, if any.

    Attributes:
        fine_stage_axes: by device and x, y, z: the truth, µm in stage coordinates.
        fine_stage_home_um: home switches and index marks; limit switches are at the ends of the rig file's travel.
        fine_stage_power_on_offset_um: what encoders show beyond the truth before they are referenced.
    """

    fine_stage_axes: Mapping[str, Mapping[str, Axis]]
    fine_stage_home_um: Mapping[str, Mapping[str, float]]
    fine_stage_power_on_offset_um: Mapping[str, Mapping[str, float]]


class _AxisSettings(pydantic.BaseModel, extra="ignore", frozen=True, allow_inf_nan=False):
    node_id: int = pydantic.Field(ge=1, le=127)
    counts_per_um: float = pydantic.Field(default=20.0, gt=0)
    travel_um: tuple[float, float] = (-625.0, 625.0)
    max_speed_um_s: float = pydantic.Field(default=1000.0, gt=0)
    acceleration_um_s2: float = pydantic.Field(default=10_000.0, gt=0)
    direction: Literal[1, -1] = 1
    homing_method: int = 17


class _Settings(pydantic.BaseModel, extra="ignore", frozen=True):
    """The part of the rig file's section that the drives are built or set to."""

    connection: Connection
    axes: dict[Literal["x", "y", "z"], _AxisSettings]
    heartbeat_ms: int = pydantic.Field(default=100, ge=1)


def _attach(request: EmulationRequest) -> Emulation:
    """Build the drives and put them on their bus; `devices` of the emulation are the `ServoDrive`s by axis.

    The drives have been set up for the stage: the homing method is the rig file's, and after it their zero is the
    stage's.

    Raises:
        UnsupportedError: the world has no such stage.
        ConfigError: a drive cannot be set to what the rig file says.
    """
    world = request.world
    if not isinstance(world, FineStageWorld) or request.name not in world.fine_stage_axes:
        raise UnsupportedError(
            f"the world {type(world).__name__} has no fine stage {request.name}",
            remedy="choose a world with fine stages, such as `microscope`",
            device=request.name,
        )
    settings = parse_settings(
        request,
        _Settings,
        remedy="give axes x, y and z node ids from 1 to 127, direction 1 or -1, and positive counts_per_um, speeds and "
        "accelerations",
    )
    drives: dict[str, ServoDrive] = {
        name: _build_drive(request, world, name, axis, number)
        for number, (name, axis) in enumerate(settings.axes.items())
    }
    return attach_nodes(
        request,
        settings.connection,
        [drive.node for drive in drives.values()],
        drives,
        served={"heartbeat_ms": max(settings.heartbeat_ms, _SERVED_HEARTBEAT_MS)},
    )


def _build_drive(
    request: EmulationRequest, world: FineStageWorld, name: str, settings: _AxisSettings, number: int
) -> ServoDrive:
    seed = request.seed + _SEEDS_A_DRIVE * number
    spec = AxisSpec(
        counts_per_um=settings.counts_per_um,
        travel_um=settings.travel_um,
        max_speed_um_s=settings.max_speed_um_s,
        acceleration_um_s2=settings.acceleration_um_s2,
        home_um=world.fine_stage_home_um[request.name][name],
        direction=settings.direction,
    )
    motion = Motion(
        world.fine_stage_axes[request.name][name],
        spec,
        seed=seed,
        offset_um=world.fine_stage_power_on_offset_um[request.name][name],
        noise_um=_encoder_noise_um(world),
    )
    method = settings.homing_method if settings.homing_method in HOMING_METHODS else _HERE
    limits_um = {17: motion.negative_um, 18: motion.positive_um, _HERE: 0.0, 35: 0.0}
    return ServoDrive(
        motion,
        node_id=settings.node_id,
        seed=seed + 1,
        homing_method=method,
        home_offset=-round(limits_um.get(method, motion.home_um) * settings.counts_per_um),
    )


def _encoder_noise_um(world: object) -> float:
    tools = getattr(getattr(world, "settings", None), "tools", None)
    return (tools if isinstance(tools, ToolsWorld) else ToolsWorld()).encoder_noise_um


EMULATOR = Emulator(attach=_attach)
