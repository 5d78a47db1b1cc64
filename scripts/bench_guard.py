"""The force guard's figures: how far the force overshoots its limit, and how long a stop takes to leave.

    python scripts/bench_guard.py [overshoot] [latency] [--trips 300] [--speed-um-s 5]

Without a name both are measured, in about two minutes. Overshoot: in simulation, the probe pressed on each preset of
the specimen, and on a hard obstacle, until the guard stops it. Latency: probe stage and force sensor served by another
process behind a serial CAN adapter on a pseudo-terminal, whose true force steps over the limit and back. The instant of
a sample lies 1.1 ms before its frame has arrived. On a busy machine the last row tells how busy it is.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import math
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from bench_wires.figures import Figure, show

from microdrivers.configs import shipped_rig
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.errors import MoveCancelled
from microdrivers.core.samples import DeviceEvent, ForceSample
from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.devices.fine_stage import FineStage
from microdrivers.devices.force_sensor import ForceSensor
from microdrivers.rig import Rig, build_rig, load_rig_file, open_rig
from microdrivers.rig.serving import ServedRig

STAGE, SENSOR = "probe_stage", "probe_force"
LIMITS_UN = {
    "single": 500.0, "unloading_springs": 500.0, "slip_corrected": 500.0, "viscoelastic": 500.0, "obstacle": 1500.0,
}  # fmt: skip
OBSTACLE_UM, OBSTACLE_UN_PER_UM = -200.0, 50.0
MOST_OVERSHOOT, MOST_LATENCY_MS = 0.02, 5.0
BRAKED_AFTER_S = 0.2
HALF_PERIOD_NS = 60_000_000
REHEARSALS = 100


def part_of_workstation(folder: Path, *, limit_uN: float, heartbeat_ms: int = 100) -> Path:
    """The workstation's probe alone, with that limit."""
    data = yaml.safe_load(shipped_rig().read_text(encoding="utf-8"))
    for section in ("microscope", "probe"):
        data.pop(section, None)
    data["devices"] = {name: data["devices"][name] for name in (STAGE, SENSOR)}
    data["devices"][STAGE]["heartbeat_ms"] = heartbeat_ms
    data["safety"]["force_guards"] = [{"sensor": SENSOR, "stage": STAGE, "max_force_uN": limit_uN}]
    file = folder / "probe.yaml"
    file.write_text(yaml.safe_dump(data), encoding="utf-8")
    return file


# ---------------------------------------------------------------------- overshoot


def overshoot(preset: str, *, speed_um_s: float, folder: Path) -> tuple[float, float]:
    """The largest true force over the limit, as a share of it, until the stage stands; and the stiffness, µN/µm.

    Infinite if the guard does not trip.
    """
    limit_uN = LIMITS_UN[preset]
    specimen = {"preset": "none" if preset == "obstacle" else preset}
    rig = build_rig(
        part_of_workstation(folder, limit_uN=limit_uN), fake=True, seed=1, clock=SimulatedClock(),
        world_overrides={"specimen": specimen},
    )  # fmt: skip
    with rig:
        return _press_until_stopped(rig, preset, limit_uN, speed_um_s)


def _press_until_stopped(rig: Rig, preset: str, limit_uN: float, speed_um_s: float) -> tuple[float, float]:
    assert rig.simulation is not None
    world: Any = rig.simulation.world
    stage, sensor = rig.device(STAGE, FineStage), rig.device(SENSOR, ForceSensor)
    true_uN: list[tuple[float, float]] = []
    axis = world.fine_stage_axes[STAGE]["x"]
    stage.reference(stage.reference_order)
    stage.move_to(x_um=-100.0, y_um=0.0, z_um=0.0)
    sensor.tare()
    if preset == "obstacle":
        world.pressed[SENSOR] = lambda t_ns: OBSTACLE_UN_PER_UM * max(0.0, OBSTACLE_UM - axis.position_at(t_ns))
    near_um = OBSTACLE_UM + 5.0 if preset == "obstacle" else -405.0
    stage.move_to(x_um=near_um, speed_um_s=200.0)
    sensor.topic.subscribe(
        lambda sample: true_uN.append((axis.position_at(sample.t_ns), world.force_uN(SENSOR, sample.t_ns)))
    )
    try:
        stage.move_to(x_um=stage.limits["x"].min, speed_um_s=speed_um_s)
    except MoveCancelled:
        rig.clock.sleep(BRAKED_AFTER_S)
    else:
        return math.inf, math.nan
    place_um, force_uN = np.array(true_uN[-400:]).T
    loading = slice(0, max(2, int(np.argmax(force_uN))))
    slope = np.polyfit(-place_um[loading][-200:], force_uN[loading][-200:], 1)[0]
    return float(force_uN.max() / limit_uN - 1.0), float(slope)


def measure_overshoot(speed_um_s: float) -> list[Figure]:
    """Of all presets."""
    figures = []
    with tempfile.TemporaryDirectory() as folder:
        for preset, limit_uN in LIMITS_UN.items():
            share, slope = overshoot(preset, speed_um_s=speed_um_s, folder=Path(folder))
            name = f"overshoot at {speed_um_s:g} µm/s, {preset}, {slope:.1f} µN/µm at the limit of {limit_uN:g} µN"
            figures.append(Figure(name, f"≤ {MOST_OVERSHOOT:.0%}", f"{share:.3%}", share <= MOST_OVERSHOOT))
    return figures


# ---------------------------------------------------------------------- latency


def serve(file: Path, served: Path, limit_uN: float) -> None:
    """The other process: a true force that steps over the limit and back, until its input ends."""
    with ServedRig(load_rig_file(file), seed=1) as serving:
        world: Any = serving.simulation.world
        world.pressed[SENSOR] = lambda t_ns: 1.2 * limit_uN * (t_ns // HALF_PERIOD_NS % 2)
        serving.write(served)
        print("ready", flush=True)
        sys.stdin.read()


@contextlib.contextmanager
def served_probe(folder: Path, limit_uN: float) -> Iterator[Path]:
    """The probe behind a serial adapter, in another process; gives the rig file that leads there."""
    file, served = part_of_workstation(folder, limit_uN=limit_uN, heartbeat_ms=2000), folder / "served.yaml"
    command = [sys.executable, __file__, "serve", str(file), str(served), str(limit_uN)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        process.stdout.readline()
        yield served
    finally:
        process.communicate()


def measure_latency(trips: int) -> list[Figure]:
    """At rest, and on the served bus."""
    limit_uN = 1000.0
    with tempfile.TemporaryDirectory() as folder, served_probe(Path(folder), limit_uN) as file, open_rig(file) as rig:
        rehearsed_ms = []
        for _ in range(REHEARSALS):
            rehearsed_ms.append(rig.safety.guards[SENSOR].rehearse() / NS_PER_MS)
            rig.clock.sleep(0.01)
        handed_ms = _trip_often(rig, trips)
    return [
        _latency("guard called → stop handed to the port (rehearsal at rest)", rehearsed_ms),
        _latency("instant of the sample → stop handed to the port, served CAN", handed_ms),
    ]


def _latency(name: str, values_ms: list[float]) -> Figure:
    p50, p99 = np.percentile(values_ms, [50, 99])
    spread = f"p50 {p50:.2f}, p99 {p99:.2f}, worst {max(values_ms):.2f} ms ({len(values_ms)})"
    return Figure(name, f"p99 ≤ {MOST_LATENCY_MS:g} ms", spread, bool(p99 <= MOST_LATENCY_MS))


def _trip_often(rig: Rig, trips: int) -> list[float]:
    """How long after the instant of the sample that trips the stop had been handed over, ms."""
    stops: list[DeviceEvent] = []
    handed_ms: list[float] = []

    def seen(sample: ForceSample) -> None:  # after the guard, in the same thread
        if stops:
            handed_ms.append((stops.pop().t_ns - sample.t_ns) / NS_PER_MS)

    rig.devices[STAGE].events.subscribe(lambda event: stops.append(event) if event.kind == "stopped" else None)
    subscription = rig.devices[SENSOR].topic.subscribe(seen)
    rig.safety.begin(STAGE)
    rig.clock.sleep(trips * 2 * HALF_PERIOD_NS / NS_PER_S)
    subscription.cancel()
    return handed_ms


def main() -> int:
    """Print the table; exit status 1 if a figure falls short."""
    if sys.argv[1:2] == ["serve"]:
        serve(Path(sys.argv[2]), Path(sys.argv[3]), float(sys.argv[4]))
        return 0
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("figures", nargs="*", choices=["overshoot", "latency", []], help="default: both")
    parser.add_argument("--trips", type=int, default=300)
    parser.add_argument("--speed-um-s", type=float, default=5.0)
    asked = parser.parse_args()
    figures: list[Figure] = []
    logging.disable(logging.WARNING)  # one line a trip
    if not asked.figures or "overshoot" in asked.figures:
        figures += measure_overshoot(asked.speed_um_s)
    if not asked.figures or "latency" in asked.figures:
        figures += measure_latency(asked.trips)
    return show(figures)


if __name__ == "__main__":
    sys.exit(main())
