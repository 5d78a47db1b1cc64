"""Examines a rig device by device: who answers, how fast, how well timed, and on request whether axes move as told."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

from microdrivers.core.errors import LinkError, MicrodriversError, MotionError
from microdrivers.core.samples import ForceSample, PoseSample, Sample, ZoomSample
from microdrivers.core.units import NS_PER_MS
from microdrivers.devices.base import Device
from microdrivers.devices.camera import Camera
from microdrivers.devices.force_sensor import DISCONNECTED, INVALID, SATURATED, UNTARED
from microdrivers.devices.shared_bus import SharesABus
from microdrivers.devices.stage import Stage
from microdrivers.devices.xytheta_stage import XYThetaStage
from microdrivers.rig import Rig
from microdrivers.routines.bus_check import buses_of, check_bus
from microdrivers.routines.camera_check import STAMP_LIMIT_NS, check_camera
from microdrivers.routines.device_state import identity_text, state_text, unreferenced_axes
from microdrivers.routines.findings import DeviceDiagnosis, Diagnosis
from microdrivers.routines.guard_check import check_guards
from microdrivers.routines.progress import Progress
from microdrivers.routines.stream_check import check_stream

READS = 20
STEP_UM = 20.0

_MOST_FAILED_READS = 3
_SECOND_LOOK_S = 0.6
_SLOW_FACTOR = 10.0
_STEP_SPEED_UM_S = 200.0
_STEP_SLACK_UM = 0.5
_POSES = 5


@runtime_checkable
class CountsItsLine(Protocol):
    """A device whose driver tells what happened on its line since it was opened.

    A key that begins with `exchanges` counts what went well; any other one counts what did not.
    """

    @property
    def line_counters(self) -> Mapping[str, int]:
        """Counts by name."""


def diagnose(rig: Rig, *, motion: bool = False, progress: Progress | None = None) -> Diagnosis:
    """Open every device of a closed rig by itself and examine it; one failure does not hide the others.

    Then let all devices of each bus that they share stream at once, and examine the bus.

    Args:
        rig: built and not opened; the caller closes it.
        motion: also move each referenced linear axis of a stage by ±STEP_UM and compare with its encoder. On an
            emulated rig, which knows no reference after its power-on, the axes are referenced first.
        progress: told which device is being examined.
    """
    diagnoses, file = [], rig.description.file
    for name, device in rig.devices.items():
        if progress is not None:
            progress.step(f"examining {name}")
        found = DeviceDiagnosis(name=name, driver=rig.description.devices[name].driver_name)
        diagnoses.append(found)
        try:
            device.open()
        except MicrodriversError as error:
            found.failed(error)
            continue
        found.info = device.info
        found.ok(identity_text(device.info))
        try:
            _examine(rig, device, found, motion)
        except MicrodriversError as error:
            found.failed(error)
        if device.fault is not None:
            found.problem(f"the device is at fault: {device.fault.what}", device.fault.remedy)
    check_guards(rig, diagnoses)
    for found in diagnoses:
        found.say_commands(file)
    buses = []
    for bus, devices in buses_of(rig.devices.values()).items():
        if progress is not None:
            progress.step(f"examining {bus}")
        examined = check_bus(bus, devices)
        if examined is not None:
            buses.append(examined)
    return Diagnosis(
        rig=rig.file.name,
        file=str(rig.description.file),
        fake=rig.fake or rig.file.emulated,
        clock="simulated" if rig.clock.simulated else "system",
        devices=diagnoses,
        buses=buses,
    )


def _examine(rig: Rig, device: Device[Any], found: DeviceDiagnosis, motion: bool) -> None:
    if isinstance(device, Camera):
        check_camera(device, found)
        return
    last = _check_round_trip(device, found)
    if last is None:
        return
    if motion and rig.starts_anew and isinstance(device, Stage) and (unknown := unreferenced_axes(device)):
        device.reference(unknown)
        last = device.read()
    if isinstance(last, ForceSample) and last.flags & INVALID:
        device.clock.sleep(_SECOND_LOOK_S)  # a broken wire may look like a force at first
        last = device.read()
    _check_state(rig, device, last, found)
    _check_time(device, last, found)
    check_stream(device, found)
    if motion and isinstance(device, Stage):
        _check_motion(device, found)
    if isinstance(device, CountsItsLine):
        of_bus = device.bus_facts.counters if isinstance(device, SharesABus) else ()
        _check_line({name: count for name, count in device.line_counters.items() if name not in of_bus}, found)


def _check_round_trip(device: Device[Any], found: DeviceDiagnosis) -> Sample | None:
    """Time `read()`; returns the last sample, None if the device does not answer."""
    took_ms: list[float] = []
    failures: list[LinkError] = []
    last: Sample | None = None
    while len(took_ms) < READS and len(failures) < _MOST_FAILED_READS:
        start_ns = device.clock.now_ns()
        try:
            last = device.read()
        except LinkError as error:
            failures.append(error)
        else:
            took_ms.append((device.clock.now_ns() - start_ns) / NS_PER_MS)
    if failures:
        tried = len(took_ms) + len(failures)
        found.failed(failures[-1], f"{len(failures)} of {tried} reads failed")
    if not took_ms:
        return None
    median_ms, worst_ms = statistics.median(took_ms), max(took_ms)
    found.figures |= {"read_median_ms": median_ms, "read_worst_ms": worst_ms, "reads_failed": len(failures)}
    found.judge(
        worst_ms <= _SLOW_FACTOR * median_ms,
        f"read() takes {median_ms:.3g} ms (median of {len(took_ms)}), {worst_ms:.3g} ms at worst",
        "look for other traffic on the line, a USB adapter's latency timer, and a busy computer",
    )
    return last if len(failures) < _MOST_FAILED_READS else None


def _check_state(rig: Rig, device: Device[Any], sample: Sample, found: DeviceDiagnosis) -> None:
    text = state_text(device, sample)
    file = rig.description.file
    command = f"make sure that the way is free, then: microdrivers reference {file} --device {device.name}"
    axes = unreferenced_axes(device)
    if isinstance(sample, ForceSample) and sample.flags & INVALID:
        found.problem(text, _invalid_remedy(sample))
    elif UNTARED in sample.flags:
        found.ok(f"{text}: no zero is taken yet, as after every start")
    elif axes:
        found.warn(f"{text} (positions mean nothing yet)", f"{command} --axes {','.join(axes)}")
    elif isinstance(sample, ZoomSample) and not sample.referenced:
        found.warn(f"{text} (the zoom means nothing yet)", command)
    else:
        found.ok(text)
    if isinstance(sample, PoseSample | ZoomSample) and sample.moving:
        found.warn("it moves although nobody told it to", f"microdrivers stop {file}")
    if isinstance(device, Stage) and isinstance(sample, PoseSample):
        for axis, position in sample.position.items():
            if axis not in axes and position not in device.limits[axis]:
                unit = device.axes[axis].unit
                found.problem(
                    f"axis {axis} is at {position:.6g} {unit}, outside its limits {device.limits[axis]} {unit}",
                    f"check travel_um or travel_deg of axis {axis} in the rig file, then again reference([{axis!r}])",
                )


def _invalid_remedy(sample: ForceSample) -> str:
    if DISCONNECTED in sample.flags:
        return "check the sensor's plug and cable at the amplifier or module, and its supply"
    if SATURATED in sample.flags:
        return "free the tip; if it is free, compare range_uN and zero in the rig file with the sensor"
    return "check cable and power"


def _check_time(device: Device[Any], sample: Sample, found: DeviceDiagnosis) -> None:
    found.figures |= {"t_source": sample.t_source, "stated_uncertainty_ms": sample.dt_ns / NS_PER_MS}
    what = f"its time is stated to ±{sample.dt_ns / NS_PER_MS:.3g} ms ({sample.t_source})"
    if isinstance(device, XYThetaStage):
        remedy = "calibrate with --settled; a faster line or a controller on a serial port helps"
        found.judge(sample.dt_ns <= STAMP_LIMIT_NS, what, remedy)
    else:
        found.ok(what)


def _check_line(counters: Mapping[str, int], found: DeviceDiagnosis) -> None:
    found.figures["line"] = dict(counters)
    bad = any(count for name, count in counters.items() if not name.startswith("exchanges"))
    text = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counters.items())
    found.judge(not bad, f"line: {text}", "check cable, shield, baud rate, and that one program alone uses the line")


# ---------------------------------------------------------------------- motion


def _check_motion(stage: Stage[Any], found: DeviceDiagnosis) -> None:
    for axis in _linear_axes(stage):
        if not stage.referenced[axis]:
            found.warn(
                f"axis {axis} was not moved: it is not referenced",
                f"reference({stage.to_reference([axis])!r}), then run the doctor again",
            )
            continue
        home = _pose(stage)[axis]
        beside = [goal for goal in (home + STEP_UM, home - STEP_UM) if goal in stage.limits[axis]]
        steps_um: list[float] = []
        for goal in (position for away in beside for position in (away, home)):
            moved_um = _step(stage, axis, goal, found)
            if moved_um is None:
                break  # an axis that does not move as told is told nothing more
            steps_um.append(moved_um)
        else:
            found.figures[f"steps_{axis}_um"] = steps_um
            found.ok(f"axis {axis} moves as told: by its encoder {', '.join(f'{step:+.2f}' for step in steps_um)} µm")


def _step(stage: Stage[Any], axis: str, goal: float, found: DeviceDiagnosis) -> float | None:
    """Move one axis and compare with the encoders; returns what it moved, None if that is not what it was told."""
    before = _pose(stage)
    asked = goal - before[axis]
    error: MotionError | None = None
    try:
        stage.start_axis_to(axis, goal, speed=_step_speed(stage, axis)).wait()
    except MotionError as failure:
        error = failure
    after = _pose(stage)
    moved = {name: after[name] - before[name] for name in before}
    problem = _judge_step(axis, asked, moved, stage.axes[axis].tolerance, error)
    if problem is None:
        return moved[axis]
    found.problem(f"axis {axis} was told to move {asked:+.2f} µm and {problem[0]}", problem[1])
    stage.stop(by="doctor", reason=f"axis {axis} does not move as told")
    return None


def _judge_step(
    axis: str, asked: float, moved: Mapping[str, float], tolerance_um: float, error: MotionError | None
) -> tuple[str, str] | None:
    """What is wrong with a step, and what to try; None if it is right. All in µm."""
    others = [name for name in moved if name != axis and abs(moved[name]) > STEP_UM / 4]
    for other in others[:1]:
        return (
            f"axis {other} moved {moved[other]:+.2f} µm, {axis} itself {moved[axis]:+.2f} µm: wrong axis",
            f"are {axis} and {other} swapped? Check `id` of both axes in the rig file, and the cables",
        )
    if abs(moved[axis] - asked) <= 2 * tolerance_um + _STEP_SLACK_UM:
        if error is None:
            return None
        return f"moved {moved[axis]:+.2f} µm, yet the move failed: {error.what}", error.remedy
    if abs(moved[axis]) < STEP_UM / 10:
        return (
            f"did not move ({moved[axis]:+.2f} µm)",
            "check servo, motor supply, emergency stop and brake; or is the unit wrong by a factor?",
        )
    if moved[axis] * asked < 0:
        return (
            f"moved the WRONG WAY, {moved[axis]:+.2f} µm: wrong sign",
            f"check `direction` of axis {axis} in the rig file, and the polarity of motor and encoder",
        )
    return (
        f"moved {moved[axis]:+.2f} µm: wrong size",
        f"check unit, resolution and stage type of axis {axis} in the rig file and in the controller",
    )


def _pose(stage: Stage[Any]) -> dict[str, float]:
    """Mean of a few readings at rest."""
    poses = [stage.read().position for _ in range(_POSES)]
    return {axis: statistics.fmean(pose[axis] for pose in poses) for axis in _linear_axes(stage)}


def _linear_axes(stage: Stage[Any]) -> list[str]:
    return [axis for axis, spec in stage.axes.items() if spec.unit == "µm"]


def _step_speed(stage: Stage[Any], axis: str) -> float:
    return min(_STEP_SPEED_UM_S, stage.max_speed[axis])
