"""A coordinated move of 1 mm through space, against the truth: where the axes really are."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from bench_wires.figures import Figure

from bench_can.tools import AXES, STAGE, bring_home, simulated
from microdrivers.core.samples import FineStageSample
from microdrivers.devices.fine_stage import FineStage

_START_UM = {"x": -400.0, "y": -300.0, "z": -200.0}
_WAY_UM = {"x": 800.0, "y": 500.0, "z": math.sqrt(1000.0**2 - 800.0**2 - 500.0**2)}
_SPEEDS_UM_S = (100.0, 500.0, 1000.0)
_STREAM_HZ = 100.0
_MOST_DEVIATION_UM = 2.0
_NOISE_UM = 0.1


class _Move(NamedTuple):
    end_counts: float
    deviation_um: float
    poses: int
    early: int
    """Poses that say `on_target` while an axis is farther from its target than tolerance and encoder noise."""


def measure(seeds: int) -> list[Figure]:
    """The worst of all worlds and speeds."""
    figures = []
    for speed_um_s in _SPEEDS_UM_S:
        moves = [_move(seed, speed_um_s) for seed in range(1, seeds + 1)]
        end_counts = max(move.end_counts for move in moves)
        deviation_um = max(move.deviation_um for move in moves)
        early, poses = sum(move.early for move in moves), sum(move.poses for move in moves)
        what = f"x-y-z move of 1 mm at {speed_um_s:g} µm/s, {seeds} worlds"
        figures += [
            Figure(f"{what}: end error", "≤ 1 count", f"{end_counts:.2f} counts of 50 nm", end_counts <= 1.0),
            Figure("  deviation from the straight line", f"≤ {_MOST_DEVIATION_UM:g} µm",
                   f"{deviation_um:.2f} µm", deviation_um <= _MOST_DEVIATION_UM),
            Figure("  on_target said early", "never", f"{early} of {poses} poses", early == 0),
        ]  # fmt: skip
    return figures


def _move(seed: int, speed_um_s: float) -> _Move:
    with simulated(STAGE, seed=seed) as rig:
        stage = rig.device(STAGE, FineStage)
        assert rig.simulation is not None
        world: Any = rig.simulation.world
        truth = world.fine_stage_axes[STAGE]
        bring_home(stage, **_START_UM)
        settings: Any = rig.description.devices[STAGE].settings
        counts_per_um = settings.axes.x.counts_per_um
        samples: list[FineStageSample] = []
        stage.topic.subscribe(samples.append)
        began_ns = rig.clock.now_ns()
        with stage.stream(_STREAM_HZ):
            goals = {f"{axis}_um": _START_UM[axis] + _WAY_UM[axis] for axis in AXES}
            end = stage.move_to(**goals, speed_um_s=speed_um_s)
        places = [
            [truth[axis].position_at(t_ns) - _START_UM[axis] for axis in AXES]
            for t_ns in range(began_ns, rig.clock.now_ns(), (rig.clock.now_ns() - began_ns) // 2000)
        ]
        errors_um = [truth[axis].position_at(end.t_ns) - goals[f"{axis}_um"] for axis in AXES]
        slack_um = stage.axes["x"].tolerance + _NOISE_UM
        early = [
            sample for sample in samples if sample.on_target
            and any(abs(truth[axis].position_at(sample.t_ns) - sample.target[axis]) > slack_um for axis in AXES)
        ]  # fmt: skip
        return _Move(max(map(abs, errors_um)) * counts_per_um, max(map(_aside, places)), len(samples), len(early))


def _aside(place_um: list[float]) -> float:
    """Distance from the straight way."""
    way = list(_WAY_UM.values())
    length_um = math.hypot(*way)
    along_um = sum(part * whole for part, whole in zip(place_um, way, strict=True)) / length_um
    return math.hypot(*(part - along_um * whole / length_um for part, whole in zip(place_um, way, strict=True)))
