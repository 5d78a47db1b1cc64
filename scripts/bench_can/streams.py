"""Three axes on SYNC beside a fast force sensor, on one bus in simulated time: nothing may be lost.

What has passed on the bus is counted there, in the emulated medium, and compared with what the drivers have published.
"""

from __future__ import annotations

import itertools
from collections import Counter
from typing import Any

from bench_wires.figures import Figure

from bench_can.tools import SENSOR, STAGE, bring_home, judge, simulated
from microdrivers.backends.cia402.fine_stage import Cia402FineStage
from microdrivers.backends.cia404.sensor import Cia404ForceSensor
from microdrivers.core.samples import Sample
from microdrivers.core.units import NS_PER_S
from microdrivers.fakes.can import medium_named

_POSE_HZ, _FORCE_HZ = 100.0, 1000.0
_SECONDS = 60.0
_FIRST_PDO_ID = 0x180


def measure(repeat: float) -> list[Figure]:
    """Both streams at once, while the stage moves to and fro; counted between two instants in mid-stream."""
    moves = max(2, round(_SECONDS * repeat))
    with simulated(STAGE, SENSOR, seed=1) as rig:
        stage, sensor = rig.device(STAGE, Cia402FineStage), rig.device(SENSOR, Cia404ForceSensor)
        bring_home(stage)
        settings: Any = {name: rig.description.devices[name].settings for name in (STAGE, SENSOR)}
        medium = medium_named(f"socketcan:{settings[STAGE].connection.channel}")
        assert medium is not None
        poses, forces, passed = list[Sample](), list[Sample](), Counter[int]()
        with stage.stream(_POSE_HZ), sensor.stream(_FORCE_HZ):
            rig.clock.sleep(0.1 + 0.25 / _FORCE_HZ)
            stage.topic.subscribe(poses.append)
            sensor.topic.subscribe(forces.append)
            medium.on_passed = lambda _t_ns, _who, frame: passed.update((frame.id,))
            places = itertools.cycle((50.0, 0.0))
            end_ns = rig.clock.now_ns() + moves * NS_PER_S
            while rig.clock.now_ns() < end_ns:
                stage.start_move_to(x_um=next(places), y_um=-30.0, speed_um_s=200.0)
                rig.clock.sleep_until(min(end_ns, rig.clock.now_ns() + NS_PER_S))
            medium.on_passed = None
            seen = len(poses), len(forces)
            load, said_load = medium.load(), stage.bus_load
            lost = stage.line_counters["lost_samples"] + sensor.lost_frames
            skipped = stage.line_counters["skipped_samples"]
    name = f"3 axes on SYNC at {_POSE_HZ:g} Hz + {_FORCE_HZ:g} forces/s, {moves} s simulated"
    limit = "none lost, twice, out of order"
    pose_flow = judge(poses[: seen[0]], frames=round(moves * _POSE_HZ))
    force_flow = judge(forces[: seen[1]], frames=passed[_FIRST_PDO_ID + settings[SENSOR].node_id])
    return [
        Figure(f"{name}: poses", limit, str(pose_flow).replace("that passed on the bus", "turns"), pose_flow.sound),
        Figure("  forces", limit, str(force_flow), force_flow.sound),
        Figure("  lost, and left out, as the drivers say", "0 and 0", f"{lost} and {skipped}", lost == skipped == 0),
        Figure("  bus load, of the emulated bus", "", f"{load:.1%} of {medium.bitrate / 1000:g} kbit/s"),
        Figure("  bus load, as the driver says, stuff bits at their most", "", f"{said_load:.1%}"),
    ]  # fmt: skip
