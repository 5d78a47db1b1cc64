"""Benches: a device, its clock, and the truth behind it."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import yaml

from microdrivers.configs import shipped_rig
from microdrivers.core.clock import Clock, SimulatedClock
from microdrivers.devices.camera import Camera
from microdrivers.devices.xytheta_stage import XYThetaStage
from microdrivers.devices.zoom_motor import ZoomMotor
from microdrivers.rig import Rig, build_rig, load_rig_file, open_rig
from microdrivers.rig.serving import ServedRig


@dataclass
class StageBench:
    """`truth(axis, t_ns)` is where the table is, µm or degrees; `noise` bounds encoder noise and quantisation."""

    stage: XYThetaStage
    clock: Clock
    truth: Callable[[str, int], float]
    noise_um: float = 0.1


@dataclass
class ZoomBench:
    """`true_steps(t_ns)` is where the motor is."""

    zoom: ZoomMotor
    clock: Clock
    true_steps: Callable[[int], float]


@dataclass
class CameraBench:
    """`true_middle_ns(frame_id)` is when the middle of that exposure really was."""

    camera: Camera
    clock: Clock
    true_middle_ns: Callable[[int], int]


def _replace(rig: Rig, name: str, driver: type[Any] | None) -> None:
    """Put another driver, such as one with a planted fault, in front of the same emulator."""
    if driver is not None:
        assert rig.simulation is not None
        rig.devices[name] = driver(name, rig.simulation.settings_of(name), clock=rig.clock, bus=rig.bus)


def _emulated(seed: int) -> Rig:
    return build_rig(shipped_rig(), fake=True, seed=seed, clock=SimulatedClock())


@contextmanager
def stage_bench(driver: type[Any] | None = None, *, referenced: bool = True, seed: int = 3) -> Iterator[StageBench]:
    """The GCS stage on its emulator."""
    rig = _emulated(seed)
    _replace(rig, "sample_stage", driver)
    with rig:
        stage = rig.device("sample_stage", XYThetaStage)
        world: Any = rig.simulation.world
        if referenced:
            stage.reference(["x", "y", "theta"])
        yield StageBench(stage, rig.clock, lambda axis, t_ns: world.stage_axes[axis].position_at(t_ns))


@contextmanager
def zoom_bench(driver: type[Any] | None = None, *, seed: int = 3) -> Iterator[ZoomBench]:
    """The AZ zoom on its emulator."""
    rig = _emulated(seed)
    _replace(rig, "zoom", driver)
    with rig:
        world: Any = rig.simulation.world
        yield ZoomBench(rig.device("zoom", ZoomMotor), rig.clock, world.zoom_axis.position_at)


@contextmanager
def served(transport: Literal["pty", "tcp"], *devices: str, seed: int = 3) -> Iterator[tuple[Rig, ServedRig]]:
    """Some devices of the workstation in real time, on ports of the operating system."""
    data = yaml.safe_load(shipped_rig().read_text(encoding="utf-8"))
    data.pop("microscope")
    data["devices"] = {name: data["devices"][name] for name in devices}
    with tempfile.TemporaryDirectory() as folder:
        part, pointing = Path(folder) / "part.yaml", Path(folder) / "served.yaml"
        part.write_text(yaml.safe_dump(data), encoding="utf-8")
        world = Path(folder) / "world.yaml"
        world.write_text("stage: {power_on_spread_um: 30}\n", encoding="utf-8")  # a short way to the reference
        with ServedRig(load_rig_file(part), transport=transport, seed=seed, world=world) as serving:
            serving.write(pointing)
            with open_rig(pointing) as rig:
                yield rig, serving


@contextmanager
def served_stage_bench(transport: Literal["pty", "tcp"]) -> Iterator[StageBench]:
    """The GCS stage on a port of the operating system."""
    with served(transport, "sample_stage") as (rig, serving):
        stage = rig.device("sample_stage", XYThetaStage)
        world: Any = serving.simulation.world
        stage.reference(["x", "y", "theta"])
        yield StageBench(stage, rig.clock, lambda axis, t_ns: world.stage_axes[axis].position_at(t_ns))


@contextmanager
def served_zoom_bench(transport: Literal["pty", "tcp"]) -> Iterator[ZoomBench]:
    """The AZ zoom on a port of the operating system."""
    with served(transport, "zoom") as (rig, serving):
        world: Any = serving.simulation.world
        yield ZoomBench(rig.device("zoom", ZoomMotor), rig.clock, world.zoom_axis.position_at)


@contextmanager
def camera_bench(driver: type[Any] | None = None, *, seed: int = 3) -> Iterator[CameraBench]:
    """The camera on the simulated microscope."""
    from microdrivers.core.samples import OpticsTruth

    rig = _emulated(seed)
    _replace(rig, "camera_fine", driver)
    middles: dict[int, int] = {}
    rig.bus.topic("truth/optics", OpticsTruth).subscribe(lambda truth: middles.update({truth.frame_seq: truth.t_ns}))
    with rig:
        yield CameraBench(rig.device("camera_fine", Camera), rig.clock, middles.__getitem__)
