"""Streams over the kernel's SocketCAN in real time: on this computer's vcan0, or on that of a guest.

Emulators and drivers share one interpreter here, and frames pass two bridges between kernel and emulated bus. In a
guest, time is the guest's: it stands still while the host does not let the guest run (see vcan_run/uml_clock.c).
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from bench_wires.figures import Figure

from bench_can.tools import SENSOR, STAGE, bring_home, judge, part_of_workstation
from microdrivers.backends.cia402.fine_stage import Cia402FineStage
from microdrivers.backends.lines.can_line import shared_can_line
from microdrivers.core.samples import Sample
from microdrivers.devices.force_sensor import ForceSensor
from microdrivers.fakes.can import medium_named
from microdrivers.fakes.can.medium import Medium
from microdrivers.rig import Rig, build_rig, load_rig_file
from microdrivers.rig.serving import ServedRig

_CHANNEL = "vcan0"
_POSE_HZ, _FORCE_HZ = 200.0, 1000.0
_SECONDS = 10.0
_SYNC_ID, _ANSWER_ID = 0x080, 0x180
_QUICK = {"heartbeat_ms": 1000}
_TOOL = Path(__file__).parents[1] / "vcan-run"
_BENCH = Path(__file__).parents[1] / "bench_can.py"
_NOT_SET_UP = 2
_SETTLE_S = 0.2


def measure(repeat: float) -> list[Figure]:
    """Here if there is a vcan0, else in a guest."""
    if Path("/sys/class/net", _CHANNEL).exists():
        return _measure_here(_SECONDS * repeat)
    with tempfile.TemporaryDirectory(prefix="bench-can-") as folder:
        file = Path(folder) / "figures.json"
        told = [sys.executable, str(_BENCH), "socketcan", "--repeat", str(repeat), "--json", str(file)]
        done = subprocess.run([sys.executable, str(_TOOL), "--", *told], stdout=subprocess.DEVNULL)
        if done.returncode == _NOT_SET_UP:
            return [Figure("SocketCAN", "", "not measured: scripts/vcan-run --setup auto")]
        if not file.exists():  # a figure that falls short ends with an exit status, too
            done.check_returncode()
        return [Figure(*fields) for fields in json.loads(file.read_text(encoding="utf-8"))]


def _measure_here(seconds: float) -> list[Figure]:
    with part_of_workstation(STAGE, SENSOR, changes={STAGE: _QUICK}) as part:
        pointing = part.with_name("served.yaml")
        description = load_rig_file(part)
        settings: Any = {name: description.devices[name].settings for name in (STAGE, SENSOR)}
        with ServedRig(description, seed=1, can_interface=_CHANNEL) as serving:
            serving.write(pointing)
            medium = medium_named(f"socketcan:{settings[STAGE].connection.channel}")
            assert medium is not None
            with build_rig(pointing) as rig:
                bring_home(rig.device(STAGE, Cia402FineStage))
                return [*_poses(rig, medium, seconds), *_forces(rig, medium, settings[SENSOR].node_id, seconds)]


def _poses(rig: Rig, medium: Medium, seconds: float) -> list[Figure]:
    stage = rig.device(STAGE, Cia402FineStage)
    settings: Any = rig.description.devices[STAGE].settings
    line = shared_can_line(settings.connection, clock=rig.clock)
    samples, stamps_ns = list[Sample](), list[int]()
    before = dict(stage.line_counters)
    topic = stage.topic.subscribe(samples.append)
    listening = line.listen(_ANSWER_ID + settings.axes.x.node_id, lambda received: stamps_ns.append(received.t_ns))
    began_ns = rig.clock.now_ns()
    with stage.stream(_POSE_HZ):
        rig.clock.sleep(seconds)
        load = stage.bus_load
    rig.clock.sleep(_SETTLE_S)
    listening.cancel()
    topic.cancel()
    lost, skipped = (stage.line_counters[name] - before[name] for name in ("lost_samples", "skipped_samples"))
    flow, expected = judge(samples, frames=_passed(medium, _SYNC_ID, began_ns)), round(seconds * _POSE_HZ)
    steps_us = np.diff(stamps_ns) / 1e3
    half_widths_us = np.array([sample.dt_ns for sample in samples]) / 1e3
    name = f"3 axes on SYNC at {_POSE_HZ:g} Hz for {seconds:g} s, SocketCAN ({os.environ.get('VCAN_RUN', 'native')})"
    return [
        Figure(f"{name}: poses", f"{expected}, none lost", str(flow), flow.samples >= expected and flow.sound),
        Figure("  lost, and left out, as the driver says", "0 and 0", f"{lost} and {skipped}", lost == skipped == 0),
        Figure(
            "  kernel stamps of one drive's answers: off their period", "", _spread(np.abs(steps_us - 1e6 / _POSE_HZ))
        ),
        Figure("  kernel stamps out of order", "none", str(int((steps_us <= 0).sum())), bool((steps_us > 0).all())),
        Figure("  half-width of the poses' stamps", "", _spread(half_widths_us)),
        Figure("  bus load, as the driver says", "", f"{load:.1%} of {medium.bitrate / 1000:g} kbit/s"),
    ]


def _forces(rig: Rig, medium: Medium, node_id: int, seconds: float) -> list[Figure]:
    sensor = rig.device(SENSOR, ForceSensor)
    samples = list[Sample]()
    topic = sensor.topic.subscribe(samples.append)
    began_ns = rig.clock.now_ns()
    with sensor.stream(_FORCE_HZ):
        rig.clock.sleep(seconds)
    topic.cancel()
    flow = judge(samples, frames=_passed(medium, _ANSWER_ID + node_id, began_ns))
    name = f"  {_FORCE_HZ:g} forces/s for {seconds:g} s, by the amplifier's timer"
    return [Figure(name, "none lost", str(flow), flow.sound)]


def _passed(medium: Medium, cob_id: int, since_ns: int) -> int:
    """How many frames of that identifier have passed on the emulated bus."""
    return sum(frame.id == cob_id and t_ns >= since_ns for t_ns, _, frame in list(medium.log))


def _spread(values_us: np.ndarray) -> str:
    return f"{np.median(values_us):.0f} µs (95 % {np.percentile(values_us, 95):.0f}, at most {values_us.max():.0f})"
