"""The workstation's probe and gripper stages with a guarded force sensor, and a specimen that is a spring."""

from __future__ import annotations

import copy
import functools
import json
from collections.abc import Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml

from microdrivers.configs import shipped_rig
from microdrivers.core.clock import Clock, SimulatedClock
from microdrivers.core.contact_samples import Intervention
from microdrivers.core.errors import MoveCancelled
from microdrivers.core.samples import DeviceEvent, ForceSample
from microdrivers.devices.fine_stage import FineStage
from microdrivers.devices.force_sensor import ForceSensor
from microdrivers.rig import Rig, build_rig

STAGE, OTHER, SENSOR = "probe_stage", "gripper_stage", "probe_force"
LIMIT_UN = 1000.0
STIFFNESS_UN_PER_UM = 20.0
SURFACE_UM = -50.0
"""Of the probe stage's x axis."""

AT_LIMIT_UM = SURFACE_UM - LIMIT_UN / STIFFNESS_UN_PER_UM
RETRACT_UM = 400.0
PERIOD_NS = 5_000_000
STALE_NS = 50_000_000
_STAND_STILL = 37


@functools.cache
def _workstation() -> dict[str, Any]:
    return yaml.safe_load(shipped_rig().read_text(encoding="utf-8"))


def write_rig_file(
    folder: Path, *, safety: Any = None, stage: Mapping[str, Any] | None = None, with_other: bool = False, **sensor: Any
) -> Path:
    """A rig file of a stage or two, whose references are where they stand, and the sensor at 200 readings a second."""
    data = copy.deepcopy(_workstation())
    for section in ("microscope", "probe"):
        data.pop(section, None)
    names = (STAGE, *[OTHER] * with_other, SENSOR)
    data["devices"] = {name: data["devices"][name] for name in names}
    for name in names[:-1]:
        for axis in data["devices"][name]["axes"].values():
            axis["homing_method"] = _STAND_STILL
    data["devices"][STAGE] |= stage or {}
    data["devices"][SENSOR] |= {"rate_hz": 200} | sensor
    data["safety"] = safety or {
        "force_guards": [{"sensor": SENSOR, "stage": STAGE, "max_force_uN": LIMIT_UN}], "keep_out": "none",
    }  # fmt: skip
    file = folder / "probe.yaml"
    file.write_text(json.dumps(data), encoding="utf-8")
    return file


class GuardedRig:
    """An open rig, its stages referenced at 0, with all that was said on its bus."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.clock: Clock = rig.clock
        self.stage = rig.device(STAGE, FineStage)
        self.other = rig.devices.get(OTHER)
        self.sensor = rig.device(SENSOR, ForceSensor)
        self.world: Any = rig.simulation.world
        self._medium: Any = rig.simulation.emulations[SENSOR].medium
        self._silent = False
        self.interventions: list[Intervention] = []
        self.events: list[DeviceEvent] = []
        self.forces: list[ForceSample] = []
        rig.bus.topic("safety", Intervention).subscribe(self.interventions.append)
        for device in rig.devices.values():
            device.events.subscribe(self.events.append)
        self.sensor.topic.subscribe(self.forces.append)
        self.axes = self.world.fine_stage_axes[STAGE]
        self._zero_um = {axis: self.axes[axis].position_at(0) for axis in self.axes}
        self.press(self.spring_uN)

    def press(self, force_uN: Any) -> None:
        """Put this force, or function of the time, on the tip."""
        self.world.pressed[SENSOR] = force_uN if callable(force_uN) else lambda _t_ns: float(force_uN)

    def spring_uN(self, t_ns: int) -> float:
        """The specimen, on the side of smaller x."""
        return STIFFNESS_UN_PER_UM * max(0.0, SURFACE_UM - self.true_x_um(t_ns))

    def true_x_um(self, t_ns: int | None = None) -> float:
        """Where the stage is, from where it was referenced."""
        at_ns = self.clock.now_ns() if t_ns is None else t_ns
        return self.axes["x"].position_at(at_ns) - self._zero_um["x"]

    @property
    def amplifier(self) -> Any:
        """Behind the force sensor."""
        return self.rig.simulation.emulations[SENSOR].devices["amplifier"]

    def silence(self) -> None:
        """The amplifier is switched off."""
        self._medium.detach(self.amplifier.node)
        self._silent = True

    def wake(self) -> None:
        """It is switched on again; nothing if it was not off."""
        if self._silent:
            self._medium.attach(self.amplifier.node)
            self._silent = False

    def rules(self) -> list[str]:
        """What has intervened."""
        return [each.rule for each in self.interventions]

    def stops(self, device: str = STAGE) -> list[DeviceEvent]:
        """Who has stopped a stage."""
        return [event for event in self.events if event.kind == "stopped" and event.device == device]

    def reference(self) -> None:
        """All stages, where they stand."""
        for stage in (self.stage, *[self.other] * (self.other is not None)):
            stage.reference(stage.reference_order)


def build_guarded(folder: Path, *, clock: Clock | None = None, **changes: Any) -> Rig:
    """The emulated rig, closed."""
    return build_rig(write_rig_file(folder, **changes), fake=True, seed=2, clock=clock or SimulatedClock())


@contextmanager
def guarded_rig(folder: Path, *, clock: Clock | None = None, referenced: bool = True, **changes: Any):
    """The emulated rig, open."""
    with build_guarded(folder, clock=clock, **changes) as rig:
        guarded = GuardedRig(rig)
        try:
            if referenced:
                guarded.reference()
            yield guarded
        finally:
            guarded.wake()


def press_too_hard(guarded, *, speed_um_s=50.0):
    """Move into the specimen until the guard acts; returns the error of the move."""
    guarded.stage.move_to(x_um=AT_LIMIT_UM + 10.0)
    with pytest.raises(MoveCancelled) as caught:
        guarded.stage.move_to(x_um=AT_LIMIT_UM - 100.0, speed_um_s=speed_um_s)
    return caught.value
