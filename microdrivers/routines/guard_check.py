"""What the doctor says of guarded motion: how fast a force guard's stop leaves, and which boxes tools can reach."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence

from microdrivers.core.errors import MicrodriversError
from microdrivers.core.units import NS_PER_MS
from microdrivers.devices.fine_stage import FineStage
from microdrivers.devices.force_sensor import ForceSensor
from microdrivers.rig import Rig
from microdrivers.rig.safety_checks import unguarded
from microdrivers.rig.safety_force_guard import ForceGuard
from microdrivers.rig.sections import RigFile
from microdrivers.routines.findings import DeviceDiagnosis

REHEARSALS = 20
LATENCY_LIMIT_MS = 5.0
_PAUSE_S = 0.01


def check_guards(rig: Rig, diagnoses: Sequence[DeviceDiagnosis]) -> None:
    """Rehearse each force guard on its stage at rest, and name the boxes within reach; nothing moves.

    The findings are added to those of the sensors and of the stages.
    """
    found = {diagnosis.name: diagnosis for diagnosis in diagnoses}
    for guard in rig.safety.guards.values():
        sensor, stage = found.get(guard.settings.sensor), rig.devices.get(guard.settings.stage)
        if sensor is not None and isinstance(stage, FineStage):
            force = rig.devices[guard.settings.sensor]
            rate_hz = force.stream_rate_hz if isinstance(force, ForceSensor) else math.inf
            _check_guard(guard, stage, rate_hz, sensor)
    for name, carrier in unguarded(rig.file.safety, rig.description.devices).items():
        if name in found:
            _say_unguarded(rig.file, carrier, found[name])
    for name, device in rig.devices.items():
        if isinstance(device, FineStage) and device.link == "open" and name in found:
            boxes = rig.safety.keep_out.reachable(device)
            if not rig.safety.keep_out:
                found[name].ok("no keep_out box limits where its tip may go")
            if boxes:
                found[name].ok(f"its tip could reach and is kept out of: {', '.join(boxes)}")


def _say_unguarded(file: RigFile, carrier: str, found: DeviceDiagnosis) -> None:
    """A warning of what presses; where the rig file guards another sensor, it has made a choice."""
    what = f"no force guard watches it: nothing stops {carrier} if it presses too hard"
    presses = file.probe is not None and file.probe.force == found.name
    if file.safety.force_guards and not presses:
        found.ok(what)
    else:
        found.warn(what, "name both under force_guards in the rig file's safety section, with a max_force_uN")


def _check_guard(guard: ForceGuard, stage: FineStage, rate_hz: float, found: DeviceDiagnosis) -> None:
    what = f"its guard stops {stage.name} beyond {guard.settings.max_force_uN:g} µN; {_goes_on(guard, stage, rate_hz)}"
    try:
        took_ms = _rehearsed_ms(guard, stage)
    except MicrodriversError as error:
        found.failed(error, f"{what}; its rehearsal failed")
        return
    if not took_ms:
        found.warn(f"{what}; not rehearsed, since {stage.name} is not known to be at rest", "open it, and let it rest")
        return
    if stage.clock.simulated:
        found.ok(f"{what}; how soon the stop command leaves is measured in real time only")
        return
    median_ms, worst_ms = statistics.median(took_ms), max(took_ms)
    found.figures |= {"stop_median_ms": median_ms, "stop_worst_ms": worst_ms}
    found.judge(
        worst_ms <= LATENCY_LIMIT_MS,
        f"{what}; from reading to stop command {median_ms:.2f} ms, {worst_ms:.2f} ms at worst of {REHEARSALS}",
        "let nothing else load this computer, and give the tools a bus of their own",
    )


def _goes_on(guard: ForceGuard, stage: FineStage, rate_hz: float) -> str:
    """How far the tool goes on beyond the limit: for a period of the readings, and while it brakes."""
    stated = guard.settings.max_speed_um_s
    speed_um_s = max(stage.max_speed.values()) if stated is None else stated
    weakest_um_s2 = min(axis.acceleration for axis in stage.axes.values())
    way_um = speed_um_s / rate_hz + speed_um_s**2 / (2.0 * weakest_um_s2)
    whose = "the guard's max_speed_um_s" if stated is not None else "its largest; the guard states no max_speed_um_s"
    return f"until it stands, it goes on by up to {way_um:.2g} µm at a speed of {speed_um_s:g} µm/s ({whose})"


def _rehearsed_ms(guard: ForceGuard, stage: FineStage) -> list[float]:
    newest = stage.topic.latest
    if stage.link != "open" or stage.may_be_moving or newest is None or newest.moving:
        return []
    took_ms = []
    for _ in range(REHEARSALS):
        took_ms.append(guard.rehearse() / NS_PER_MS)
        stage.clock.sleep(_PAUSE_S)  # stops come before all else on a bus: others want their turn
    return took_ms
