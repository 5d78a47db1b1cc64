"""What an exchange costs in process: driver, adapter, emulated bus and drives together."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bench_wires.figures import Figure, Times, in_rounds

from bench_can.tools import STAGE, bring_home, simulated
from microdrivers.backends.canopen.objects import DEVICE_TYPE
from microdrivers.backends.canopen.sdo import SdoClient
from microdrivers.backends.lines.can_line import shared_can_line
from microdrivers.devices.fine_stage import FineStage

_ROUNDS = 300
_IN_A_ROUND = 20
_STREAM_HZ = 100.0
_MOST_SDO_US, _MOST_POSE_US = 50.0, 100.0


def measure(repeat: float) -> list[Figure]:
    """Short rounds of each, in turn; the best round decides, for others disturb whole rounds."""
    with simulated(STAGE, seed=1) as rig:
        stage = rig.device(STAGE, FineStage)
        bring_home(stage)
        settings: Any = rig.description.devices[STAGE].settings
        medium = {"interface": "microdrivers", "channel": f"socketcan:{settings.connection.channel}"}
        line = shared_can_line(settings.connection.model_copy(update=medium), clock=rig.clock)
        sdo = SdoClient(line, settings.axes.x.node_id, timeout_s=0.3, name="x")
        poses: list[object] = []
        stage.topic.subscribe(poses.append)

        def stream() -> None:
            rig.clock.sleep(1 / _STREAM_HZ)

        rounds = round(_ROUNDS * repeat) + 1
        scale = in_rounds({"loop": _loop}, rounds, in_a_round=_IN_A_ROUND)["loop"]
        calls: dict[str, Callable[[], object]] = {"SDO": lambda: sdo.read(DEVICE_TYPE), "pose": stage.read}
        asked = in_rounds(calls, rounds, in_a_round=_IN_A_ROUND)
        poses.clear()
        with stage.stream(_STREAM_HZ):
            streamed = in_rounds({"pose": stream}, rounds, in_a_round=_IN_A_ROUND)["pose"]
        assert len(poses) >= rounds * _IN_A_ROUND
    return [
        Figure("a Python loop of 1000 turns, for scale", "", f"{scale.best_us:.1f} µs in the best round"),
        _figure("SDO read of 4 bytes, in process", asked["SDO"], _MOST_SDO_US),
        _figure("pose of three axes in process, SYNC to sample: asked for", asked["pose"], _MOST_POSE_US),
        _figure("  in a stream, all that happens between two poses", streamed, _MOST_POSE_US),
    ]


def _loop() -> None:
    total = 0
    for number in range(1000):
        total += number * number % 7


def _figure(name: str, times: Times, most_us: float) -> Figure:
    return Figure(
        name, f"≤ {most_us:g} µs", f"{times.best_us:.1f} µs in the best round, in all {times.in_us()}",
        times.best_us <= most_us,
    )  # fmt: skip
