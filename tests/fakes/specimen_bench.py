"""Worlds with a specimen, built from a small rig file of their own."""

from __future__ import annotations

from typing import Any

import numpy as np

from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.units import NS_PER_S
from microdrivers.devices.drivers import WorldRequest
from microdrivers.fakes.world import MicroscopeWorld, WorldSettings
from microdrivers.fakes.world.scene import Renderer

SIZE = (640, 480)
MIDDLE = (319.5, 239.5)
EXPOSURE_NS = 2_000_000
ZOOM_STEPS = 10_000 * np.log(1.2 / 0.75) / np.log(15.0)


def fine_stage(origin_um: list[float] | None) -> dict[str, Any]:
    return {"axes": {axis: {"travel_um": [-625, 625]} for axis in "xyz"}, "origin_um": origin_um}


def probe_rig(**changes: Any) -> dict[str, Any]:
    """Probe, gripper, zoom and cameras; `changes` by device, None removes one."""
    devices: dict[str, Any] = {
        "zoom": {"curve": [[0, 0.75], [10_000, 11.25]]},
        "camera": {"pixel_pitch_um": 7.4},
        "camera_lateral": {"view": "lateral"},
        "camera_coarse": {},
        "probe_stage": fine_stage([7950, 7500, 0]),
        "gripper_stage": fine_stage([6200, 7500, 0]),
        "probe_force": {
            "range_uN": [-2000, 2000],
            "carried_by": "probe_stage",
            "axis": [1, 0, 0],
            "stiffness_uN_per_um": 1000.0,
        },
        "gripper_force": {"range_uN": [-100, 100], "carried_by": "gripper_stage", "axis": [1, 0, 0]},
    }
    devices = {name: section for name, section in (devices | changes).items() if section is not None}
    microscope = {"sample_stage": "sample_stage", "zoom": "zoom", "camera": "camera", "objective": 1.5}
    return {"microscope": microscope, "devices": devices}


def build(
    rig: dict[str, Any] | None = None, *, seed: int = 3, bus: Bus | None = None, **settings: Any
) -> MicroscopeWorld:
    """A world; `settings` as in a world file."""
    return MicroscopeWorld(
        WorldRequest(
            settings=WorldSettings.model_validate(settings),
            rig=probe_rig() if rig is None else rig,
            seed=seed,
            clock=SimulatedClock(),
            bus=bus or Bus(),
        )
    )


def go(world: MicroscopeWorld, t_ns: int, *, speed: float = 1000.0, stage: str = "probe_stage", **to_um: float) -> int:
    """Command a tool; when it is there."""
    axes = world.fine_stage_axes[stage]
    ends = [axes[axis].move(t_ns, place, speed=speed, acceleration=1e5) for axis, place in to_um.items()]
    return max(ends) + NS_PER_S // 10


def ready(world: MicroscopeWorld) -> int:
    """Bring the tip before the specimen, and the zoom to 1.2; when they are there."""
    zoomed_ns = world.zoom_axis.move(0, float(ZOOM_STEPS), speed=20_000, acceleration=1e6)
    return max(zoomed_ns + NS_PER_S // 10, go(world, 0, x=-380.0, y=0.0, z=0.0))


def picture(world: MicroscopeWorld, t_ns: int, camera: str = "camera", *, frame_id: int = 0) -> np.ndarray:
    view = world.view(camera)
    renderer = Renderer(*SIZE, view.look)
    return view.render(
        t_ns, exposure_ns=EXPOSURE_NS, renderer=renderer, principal_point_px=MIDDLE, frame_id=frame_id
    )  # fmt: skip


def seen_px(world: MicroscopeWorld, t_ns: int, along_um: float, aside_um: float = 0.0) -> np.ndarray:
    """Where a place, seen from the undeformed surface, is in the microscope's picture."""
    specimen = world.specimen
    assert specimen is not None
    place = specimen.in_rig(np.array([[along_um, aside_um, 0.0]]), t_ns)[:, :2]
    seconds = (t_ns - world.origin_ns) / NS_PER_S
    return world.microscope.project(place, zoom=world.zoom_at(t_ns), time_s=seconds)[0] + np.array(MIDDLE)
