"""A pose of three axes over a pseudo-terminal: poll, stamp, parse, publish."""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Callable
from typing import Any

from bench_wires.far_end import Bare, FarEnd, Script, device_on, record
from bench_wires.figures import Figure, Times, in_rounds
from microdrivers.core.clock import SystemClock

_STAGE = "sample_stage"
_LIMIT = 1.5
_ROUNDS = 40
_IN_A_ROUND = 200
_POSES = 64
_PIPYTHON_ASKS = b"POS? 1 2 3\n"


def measure(repeat: float) -> list[Figure]:
    """Rounds of bare exchanges and of `stage.read()`, in turn; the ratio is that of the medians of all."""
    script = record(_STAGE, before=lambda stage: stage.reference(["x", "y", "theta"]), use=_read_poses)
    request, replies = _pose_request(script)
    script[request] = replies
    script |= {_PIPYTHON_ASKS: [_positions_of(reply) for reply in replies], b"ERR?\n": [b"0\n"]}
    length = len(replies[0])
    clock = SystemClock()
    with FarEnd(script) as bare_end, FarEnd(script) as driver_end, FarEnd(script) as pipython_end:
        stage: Any = device_on(driver_end.port, _STAGE, clock)
        stage.open()
        poses: deque[Any] = deque(maxlen=100)
        stage.topic.subscribe(poses.append)
        cases = {"bare": Bare(bare_end, request, length).exchange, "driver": stage.read}
        pipython = _pipython(pipython_end.port)
        if pipython is not None:
            cases["pipython"] = pipython
        times = in_rounds(cases, round(_ROUNDS * repeat) + 1, in_a_round=_IN_A_ROUND)
        for _ in range(15):
            stage.topic.subscribe(deque[Any](maxlen=100).append)
        both = {"bare": cases["bare"], "driver": stage.read}
        crowded = in_rounds(both, round(_ROUNDS * repeat / 4) + 1, in_a_round=_IN_A_ROUND)
        stage.close()
    clock.close()
    bare = times["bare"]
    what = f"{len(request)} + {length} bytes"
    figures = [
        Figure(f"bare write, poll, read of {what}", "", bare.in_us()),
        _against(bare, times["driver"], "pose of three axes: poll, stamp, parse, publish", reach=True),
        _against(crowded["bare"], crowded["driver"], "  with 16 subscribers"),
    ]
    if "pipython" in times:
        figures.append(_against(bare, times["pipython"], "  pipython qPOS, which reads no status and stamps nothing"))
    return figures


def _against(bare: Times, other: Times, name: str, *, reach: bool = False) -> Figure:
    ratio = other.median_us / bare.median_us
    limit = f"≤ {_LIMIT} × bare" if reach else ""
    return Figure(name, limit, f"{ratio:.2f} × bare: {other.in_us()}", ratio <= _LIMIT if reach else None)


def _read_poses(stage: Any) -> None:
    for _ in range(_POSES):
        stage.read()
        stage.clock.sleep(0.01)


def _pose_request(script: Script) -> tuple[bytes, list[bytes]]:
    """The request for a pose is the one that was sent most often; replies of the length that most have."""
    request = max(script, key=lambda candidate: len(script[candidate]))
    length = statistics.mode(len(reply) for reply in script[request])
    return request, [reply for reply in script[request] if len(reply) == length]


def _positions_of(reply: bytes) -> bytes:
    """The first reply of a pose: its lines but the last end in a space."""
    return b"".join(reply.splitlines(keepends=True)[:3])


def _pipython(port: str) -> Callable[[], object] | None:
    """The manufacturer's library, as it is by default: it asks ERR? after each command."""
    try:
        from pipython.pidevice.gcs2.gcs2commands import GCS2Commands
        from pipython.pidevice.gcsmessages import GCSMessages
        from pipython.pidevice.interfaces.piserial import PISerial
    except ImportError:
        return None
    commands = GCS2Commands(GCSMessages(PISerial(port, 115200)))
    commands._axes = ["1", "2", "3"]
    return lambda: commands.qPOS(["1", "2", "3"])
