"""Rigs with tools only, and what is counted in their streams."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from microdrivers.configs import shipped_rig
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.samples import Sample
from microdrivers.devices.fine_stage import FineStage
from microdrivers.rig import Rig, build_rig

STAGE, SENSOR = "probe_stage", "probe_force"
AXES = ("x", "y", "z")


@contextmanager
def part_of_workstation(*devices: str, changes: dict[str, Any] | None = None) -> Iterator[Path]:
    """A rig file with these devices of the workstation and no rules about where they may be."""
    data = yaml.safe_load(shipped_rig().read_text(encoding="utf-8"))
    for section in ("microscope", "probe"):
        data.pop(section, None)
    data["safety"] = "none"
    data["devices"] = {name: data["devices"][name] | (changes or {}).get(name, {}) for name in devices}
    with tempfile.TemporaryDirectory(prefix="bench-can-") as folder:
        file = Path(folder) / "part.yaml"
        file.write_text(yaml.safe_dump(data), encoding="utf-8")
        yield file


@contextmanager
def simulated(*devices: str, seed: int) -> Iterator[Rig]:
    """An open rig with these devices on their emulators, on simulated time."""
    with (
        part_of_workstation(*devices) as file,
        build_rig(file, fake=True, seed=seed, clock=SimulatedClock()) as rig,
    ):
        yield rig


def bring_home(stage: FineStage, **home_um: float) -> None:
    """Reference all axes and go there."""
    stage.reference(stage.reference_order)
    stage.move_to(**{f"{axis}_um": home_um.get(axis, 0.0) for axis in AXES})
    stage.clock.sleep(0.2)  # until the servos' lag has died out


class Flow(NamedTuple):
    """A stream's samples beside what has passed on the bus."""

    samples: int
    frames: int
    twice: int
    backwards: int
    misnumbered: int

    @property
    def sound(self) -> bool:
        """Nothing lost, twice or out of order; one frame may have been under way at the end."""
        return not (self.twice or self.backwards or self.misnumbered) and abs(self.frames - self.samples) <= 1

    def __str__(self) -> str:
        return (
            f"{self.samples} samples of {self.frames} that passed on the bus: {self.twice} twice, {self.backwards} out "
            f"of order, {self.misnumbered} misnumbered"
        )


def judge(samples: Sequence[Sample], *, frames: int) -> Flow:
    """What a stream has kept of so many frames, by stamps and numbers."""
    steps = [(after.t_ns - before.t_ns, after.seq - before.seq) for before, after in itertools.pairwise(samples)]
    return Flow(
        len(samples),
        frames,
        twice=sum(step_ns == 0 for step_ns, _ in steps),
        backwards=sum(step_ns < 0 for step_ns, _ in steps),
        misnumbered=sum(numbers != 1 for _, numbers in steps),
    )
