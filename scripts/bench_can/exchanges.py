"""What an exchange costs in process: driver, adapter, emulated bus and drives together."""

from __future__ import annotations

import time
from collections.abc import Callable

from bench_wires.figures import Figure, Times

from bench_can.tools import STAGE, bring_home, simulated
from microdrivers.backends.canopen.objects import DEVICE_TYPE
from microdrivers.backends.canopen.sdo import SdoClient
from microdrivers.backends.lines.can_line import shared_can_line
from microdrivers.devices.fine_stage import FineStage

_ROUNDS = 40
_IN_A_ROUND = 200
_MOST_SDO_US, _MOST_POSE_US = 50.0, 100.0


def measure(repeat: float) -> list[Figure]:
    """Rounds of SDO reads and of `stage.read()`, in turn; the best round decides, as others disturb whole rounds."""
    with simulated(STAGE, seed=1) as rig:
        stage = rig.device(STAGE, FineStage)
        bring_home(stage)
        settings = rig.devices[STAGE]._settings  # type: ignore[attr-defined]
        line = shared_can_line(settings.connection, clock=rig.clock)
        sdo = SdoClient(line, settings.axes.x.node_id, timeout_s=0.3, name="x")
        calls: dict[str, Callable[[], object]] = {"SDO": lambda: sdo.read(DEVICE_TYPE), "pose": stage.read}
        found: dict[str, list[list[int]]] = {name: [] for name in calls}
        for _ in range(round(_ROUNDS * repeat) + 2):
            for name, call in calls.items():
                found[name].append(_round(call))
    sdo_times, pose_times = (Times(*found[name][1:]) for name in calls)
    return [
        _figure("SDO read of 4 bytes, in process", sdo_times, _MOST_SDO_US),
        _figure("pose of three axes, from SYNC to sample, in process", pose_times, _MOST_POSE_US),
    ]


def _round(call: Callable[[], object]) -> list[int]:
    times = []
    for _ in range(_IN_A_ROUND):
        begun_ns = time.perf_counter_ns()
        call()
        times.append(time.perf_counter_ns() - begun_ns)
    return times


def _figure(name: str, times: Times, most_us: float) -> Figure:
    return Figure(
        name, f"≤ {most_us:g} µs", f"{times.best_us:.1f} µs in the best round, in all {times.in_us()}",
        times.best_us <= most_us,
    )  # fmt: skip
