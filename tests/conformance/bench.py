"""Benches: a device, its clock, and the truth behind it."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import pytest
import yaml

from microdrivers.configs import shipped_rig
from microdrivers.core.clock import Clock, SimulatedClock
from microdrivers.devices.camera import Camera
from microdrivers.devices.xytheta_stage import XYThetaStage
from microdrivers.devices.zoom_motor import ZoomMotor
from microdrivers.fakes.wire import Reply, Wire, wire_named
from microdrivers.rig import Rig, build_rig, load_rig_file
from microdrivers.rig.serving import ServedRig

CHAINED = Path(__file__).parents[1] / "data" / "chained_workstation.yaml"
"""The workstation with three single-axis controllers on one line in place of one for three axes."""

CABLES = {"can1": "can0"}
"""Controllers on one bus: what is served at the one is seen at the other."""

Given = TypeVar("Given")


class Bench:
    """What the benches of all kinds have in common."""

    @staticmethod
    def need(ability: Given | None) -> Given:
        """What a check cannot do without; where the bench does not have it the check is skipped."""
        if ability is None:
            pytest.skip("this bench cannot do that")
        return ability


@dataclass
class StageBench(Bench):
    """A stage, and what is true of it.

    `truth(axis, t_ns)` is where the table is, µm or degrees, by another way than the driver: the emulator's own axis, a
    gauge. `noise_um` bounds encoder noise and quantisation. `pose_rate_hz` is what the device's line can carry.
    `power_cycle()` switches the controller off and on. While the context `silence()` is open the device hears and does
    not answer.
    """

    stage: XYThetaStage
    clock: Clock
    truth: Callable[[str, int], float]
    noise_um: float = 0.1
    pose_rate_hz: float = 100.0
    home: Mapping[str, float] = field(default_factory=lambda: {"x": 7500.0, "y": 7500.0, "theta": 0.0})
    power_cycle: Callable[[], None] | None = None
    silence: Callable[[], AbstractContextManager[None]] | None = None

    @property
    def device(self) -> XYThetaStage:
        """The device under test."""
        return self.stage


@dataclass
class ZoomBench(Bench):
    """A zoom motor; `true_steps(t_ns)` is where it is. `silence` as for a stage."""

    zoom: ZoomMotor
    clock: Clock
    true_steps: Callable[[int], float]
    silence: Callable[[], AbstractContextManager[None]] | None = None

    @property
    def device(self) -> ZoomMotor:
        """The device under test."""
        return self.zoom


@dataclass
class CameraBench(Bench):
    """A camera; `true_middle_ns(frame_id)` is when the middle of that exposure really was."""

    camera: Camera
    clock: Clock
    true_middle_ns: Callable[[int], int]


class _Deaf:
    """Stands in for an emulator that is to be silent."""

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        return ()

    def advance(self, t_ns: int) -> Sequence[Reply]:
        return ()

    def next_event_ns(self) -> int | None:
        return None


@contextmanager
def _silence(wire: Wire) -> Iterator[None]:
    emulator, wire.emulator = wire.emulator, _Deaf()
    try:
        yield
    finally:
        wire.emulator = emulator


def _wire_of(name: str) -> Any:
    wire = wire_named(name)
    assert wire is not None
    return wire


def _stage_bench(stage: XYThetaStage, clock: Clock, world: Any, file: Path | None) -> StageBench:
    wire = _wire_of(stage.name)
    return StageBench(
        stage,
        clock,
        pose_rate_hz=40.0 if file == CHAINED else 100.0,  # a chain's controllers answer one after the other
        truth=lambda axis, t_ns: world.stage_axes[axis].position_at(t_ns),
        power_cycle=lambda: wire.emulator.power_cycle(clock.now_ns()),
        silence=lambda: _silence(wire),
    )


def _zoom_bench(zoom: ZoomMotor, clock: Clock, world: Any) -> ZoomBench:
    wire = _wire_of(zoom.name)
    return ZoomBench(zoom, clock, world.zoom_axis.position_at, silence=lambda: _silence(wire))


def _replace(rig: Rig, name: str, driver: type[Any] | None) -> None:
    """Put another driver, such as one with a planted fault, in front of the same emulator."""
    if driver is not None:
        assert rig.simulation is not None
        rig.devices[name] = driver(name, rig.simulation.settings_of(name), clock=rig.clock, bus=rig.bus)


def _emulated(seed: int, file: Path | None = None) -> Rig:
    return build_rig(file or shipped_rig("microscope"), fake=True, seed=seed, clock=SimulatedClock())


@contextmanager
def stage_bench(
    driver: type[Any] | None = None, *, referenced: bool = True, seed: int = 3, file: Path | None = None
) -> Iterator[StageBench]:
    """The GCS stage of a rig file on its emulator."""
    rig = _emulated(seed, file)
    _replace(rig, "sample_stage", driver)
    with rig:
        stage = rig.device("sample_stage", XYThetaStage)
        if referenced:
            stage.reference(["x", "y", "theta"])
        yield _stage_bench(stage, rig.clock, rig.simulation.world, file)


@contextmanager
def zoom_bench(driver: type[Any] | None = None, *, seed: int = 3, file: Path | None = None) -> Iterator[ZoomBench]:
    """The AZ zoom of a rig file on its emulator."""
    rig = _emulated(seed, file)
    _replace(rig, "zoom", driver)
    with rig:
        yield _zoom_bench(rig.device("zoom", ZoomMotor), rig.clock, rig.simulation.world)


@contextmanager
def served(
    transport: Literal["pty", "tcp"],
    *devices: str,
    seed: int = 3,
    file: Path | None = None,
    drivers: Mapping[str, type[Any]] | None = None,
    can_interface: str | None = None,
) -> Iterator[tuple[Rig, ServedRig]]:
    """Some devices of a rig file (the workstation) in real time, on ports of the operating system.

    `drivers` are others, such as ones with a planted fault, by the device that they are put in front of.
    """
    data = yaml.safe_load((file or shipped_rig("microscope")).read_text(encoding="utf-8"))
    for section in ("microscope", "probe"):
        data.pop(section, None)
    data["safety"] = "none"
    data["devices"] = {name: data["devices"][name] for name in devices}
    with tempfile.TemporaryDirectory() as folder:
        part, pointing = Path(folder) / "part.yaml", Path(folder) / "served.yaml"
        part.write_text(yaml.safe_dump(data), encoding="utf-8")
        world = Path(folder) / "world.yaml"
        world.write_text("stage: {power_on_spread_um: 30}\n", encoding="utf-8")  # a short way to the reference
        description = load_rig_file(part)
        with ServedRig(
            description, transport=transport, seed=seed, world=world, can_interface=can_interface
        ) as serving:
            serving.write(pointing)
            if can_interface in CABLES:
                seen, served_on = f": {CABLES[can_interface]}\n", f": {can_interface}\n"
                pointing.write_text(pointing.read_text(encoding="utf-8").replace(served_on, seen), encoding="utf-8")
            rig = build_rig(pointing)
            for name, driver in (drivers or {}).items():
                settings = rig.description.devices[name].settings
                rig.devices[name] = driver(name, settings, clock=rig.clock, bus=rig.bus)
            with rig:
                yield rig, serving


@contextmanager
def served_stage_bench(
    transport: Literal["pty", "tcp"], driver: type[Any] | None = None, *, file: Path | None = None
) -> Iterator[StageBench]:
    """The GCS stage on a port of the operating system."""
    drivers = {} if driver is None else {"sample_stage": driver}
    with served(transport, "sample_stage", file=file, drivers=drivers) as (rig, serving):
        stage = rig.device("sample_stage", XYThetaStage)
        stage.reference(["x", "y", "theta"])
        yield _stage_bench(stage, rig.clock, serving.simulation.world, file)


@contextmanager
def served_zoom_bench(
    transport: Literal["pty", "tcp"], driver: type[Any] | None = None, *, file: Path | None = None
) -> Iterator[ZoomBench]:
    """The AZ zoom on a port of the operating system."""
    with served(transport, "zoom", file=file, drivers={} if driver is None else {"zoom": driver}) as (rig, serving):
        yield _zoom_bench(rig.device("zoom", ZoomMotor), rig.clock, serving.simulation.world)


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
