"""Benches of the tools: fine stages and force sensors, on emulators in process and on ports."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml

from microdrivers.configs import shipped_rig
from microdrivers.core.clock import Clock, SimulatedClock
from microdrivers.devices.fine_stage import FineStage
from microdrivers.devices.force_sensor import ForceSensor
from microdrivers.rig import build_rig
from tests.conformance.bench import Bench, served
from tests.fakes.analogue_bench import module_behind

_PATIENT_S = 1.0
HOME = {"x": 0.0, "y": 0.0, "z": 0.0}


@dataclass
class FineStageBench(Bench):
    """A fine stage; the fields are those of a `StageBench`.

    `power_cycle()` switches one of its drives off and on, `heartbeat_s` is the interval of the drives' heartbeats.
    """

    stage: FineStage
    clock: Clock
    truth: Callable[[str, int], float]
    noise_um: float = 0.1
    pose_rate_hz: float = 100.0
    heartbeat_s: float = 0.1
    home: Mapping[str, float] = field(default_factory=lambda: dict(HOME))
    power_cycle: Callable[[], None] | None = None
    silence: Callable[[], AbstractContextManager[None]] | None = None

    @property
    def device(self) -> FineStage:
        """The device under test."""
        return self.stage


@dataclass
class ForceBench(Bench):
    """A force sensor. `press(force_uN)` puts that force on its tip, `true_uN(t_ns)` is what it has felt.

    `noise_uN` bounds what remains in a mean over `tare_s`, drift included; `settle_s` is how long a reading takes to
    follow.
    """

    sensor: ForceSensor
    clock: Clock
    press: Callable[[float], None]
    true_uN: Callable[[int], float]
    noise_uN: float
    tare_s: float = 0.5
    settle_s: float = 0.2
    disconnect: Callable[[], None] | None = None


def bring_home(stage: FineStage) -> None:
    """Reference what is not, and go to where checks begin."""
    stage.rules = ()  # the suites judge the driver; the rig's rules have tests of their own
    unknown = [axis for axis in stage.reference_order if not stage.referenced[axis]]
    if unknown:
        stage.reference(unknown)
    stage.move_to(x_um=HOME["x"], y_um=HOME["y"], z_um=HOME["z"])
    stage.clock.sleep(0.2)  # until the servos' lag has died out


def _fine_stage_bench(
    stage: FineStage, clock: Clock, simulation: Any, *, pose_rate_hz: float, heartbeat_s: float
) -> FineStageBench:
    bring_home(stage)
    axes = simulation.world.fine_stage_axes[stage.name]
    drives = simulation.emulations[stage.name].devices
    return FineStageBench(
        stage,
        clock,
        truth=lambda axis, t_ns: axes[axis].position_at(t_ns),
        pose_rate_hz=pose_rate_hz,
        heartbeat_s=heartbeat_s,
        power_cycle=lambda: drives["y"].power_cycle(clock.now_ns()),
    )


class _Press:
    """The force on a sensor's tip as a function of time, in place of what the world would have it feel."""

    def __init__(self, world: Any, sensor: str, clock: Clock) -> None:
        self._clock = clock
        self._steps = [(-(10**18), 0.0)]
        world.pressed[sensor] = self.at

    def __call__(self, force_uN: float) -> None:
        self._steps.append((self._clock.now_ns(), force_uN))

    def at(self, t_ns: int) -> float:
        return next(force_uN for since_ns, force_uN in reversed(self._steps) if since_ns <= t_ns)


def _force_bench(sensor: ForceSensor, clock: Clock, simulation: Any) -> ForceBench:
    press = _Press(simulation.world, sensor.name, clock)
    can = sensor.name == "probe_force"
    emulation = simulation.emulations[sensor.name]
    return ForceBench(
        sensor,
        clock,
        press=press,
        true_uN=press.at,
        noise_uN=0.05 if can else 0.5,
        tare_s=0.5 if can else 2.0,
        settle_s=0.1 if can else 0.3,
        disconnect=(
            (lambda: emulation.devices["amplifier"].disconnect_sensor(clock.now_ns()))
            if can
            else (lambda: module_behind(sensor.name).disconnect())
        ),
    )


@contextmanager
def fine_stage_bench(driver: type[Any] | None = None, *, seed: int = 3) -> Iterator[FineStageBench]:
    """The probe's stage on the emulated bus."""
    rig = build_rig(shipped_rig(), fake=True, seed=seed, clock=SimulatedClock(), devices=["probe_stage"])
    if driver is not None:
        assert rig.simulation is not None
        settings = rig.simulation.settings_of("probe_stage")
        rig.devices["probe_stage"] = driver("probe_stage", settings, clock=rig.clock, bus=rig.bus)
    with rig:
        stage = rig.device("probe_stage", FineStage)
        yield _fine_stage_bench(stage, rig.clock, rig.simulation, pose_rate_hz=100.0, heartbeat_s=0.1)


@contextmanager
def force_bench(name: str, driver: type[Any] | None = None, *, seed: int = 3) -> Iterator[ForceBench]:
    """A force sensor of the workstation in process."""
    rig = build_rig(shipped_rig(), fake=True, seed=seed, clock=SimulatedClock(), devices=[name])
    if driver is not None:
        assert rig.simulation is not None
        rig.devices[name] = driver(name, rig.simulation.settings_of(name), clock=rig.clock, bus=rig.bus)
    with rig:
        yield _force_bench(rig.device(name, ForceSensor), rig.clock, rig.simulation)


@contextmanager
def served_fine_stage_bench(
    transport: Literal["pty", "tcp"] = "pty",
    *,
    can_interface: str | None = None,
    pose_rate_hz: float = 50.0,
    file: Path | None = None,
) -> Iterator[FineStageBench]:
    """The probe's stage in real time, behind a serial adapter or on a SocketCAN interface.

    Its heartbeats are slow: a computer that runs tests, drives and host at once may be late for faster ones.
    """
    data = yaml.safe_load((file or shipped_rig()).read_text(encoding="utf-8"))
    data["devices"]["probe_stage"]["heartbeat_ms"] = round(1000 * _PATIENT_S)
    with tempfile.TemporaryDirectory() as folder:
        patient = Path(folder) / "patient.yaml"
        patient.write_text(yaml.safe_dump(data), encoding="utf-8")
        with served(transport, "probe_stage", can_interface=can_interface, file=patient) as (rig, serving):
            stage = rig.device("probe_stage", FineStage)
            yield _fine_stage_bench(
                stage, rig.clock, serving.simulation, pose_rate_hz=pose_rate_hz, heartbeat_s=_PATIENT_S
            )


@contextmanager
def served_force_bench(
    name: str, transport: Literal["pty", "tcp"] = "pty", *, can_interface: str | None = None, file: Path | None = None
) -> Iterator[ForceBench]:
    """A force sensor in real time, on a port."""
    with served(transport, name, can_interface=can_interface, file=file or shipped_rig()) as (rig, serving):
        yield _force_bench(rig.device(name, ForceSensor), rig.clock, serving.simulation)
