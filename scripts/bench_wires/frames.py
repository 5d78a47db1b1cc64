"""The served camera: rate, losses, latency, and whether `grab()` ever delivers a frame exposed before the call."""

from __future__ import annotations

import random

import numpy as np

from bench_wires.figures import Figure, Times
from bench_wires.serving import Serving
from microdrivers.core.clock import SystemClock
from microdrivers.core.samples import Frame
from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.devices.camera import Camera
from microdrivers.rig import open_rig

_CAMERA = "camera_fine"
_WATCH_S = 20.0
_GRABS = 200
_COLD_GRABS = 20
_LONGEST_PAUSE_S = 0.05


def measure(repeat: float) -> list[Figure]:
    """Watch the stream, then grab at random moments; the truth comes from the serving process."""
    clock = SystemClock()
    frames: list[tuple[Frame, int]] = []
    grabs: list[tuple[int, Frame, int]] = []
    pauses = random.Random(1)
    with Serving(_CAMERA) as serving, open_rig(serving.rig_file, clock=clock) as rig:
        camera = rig.device(_CAMERA, Camera)

        def grab() -> None:
            clock.sleep(pauses.uniform(0.0, _LONGEST_PAUSE_S))
            called_ns = clock.now_ns()
            frame = camera.grab()
            grabs.append((called_ns, frame, clock.now_ns()))

        subscription = camera.topic.subscribe(lambda frame: frames.append((frame, clock.now_ns())))
        with camera.running():
            clock.sleep(_WATCH_S * max(repeat, 0.1))
            subscription.cancel()
            for _ in range(round(_GRABS * repeat) + 1):
                grab()
        for _ in range(round(_COLD_GRABS * repeat) + 1):
            grab()
        true_ns = serving.true_middles_ns()
    return [*_stream(frames, true_ns), _freshness(grabs, true_ns)]


def _stream(frames: list[tuple[Frame, int]], true_ns: dict[int, int]) -> list[Figure]:
    first, last = frames[0][0], frames[-1][0]
    rate_hz = (len(frames) - 1) * NS_PER_S / (last.t_ns - first.t_ns)
    lost = last.frame_id - first.frame_id + 1 - len(frames)
    height, width = first.image.shape
    exposure_end_ns = round(first.exposure_ms * NS_PER_MS / 2)
    latency = Times([seen_ns - true_ns[frame.frame_id] - exposure_end_ns for frame, seen_ns in frames])
    stamps = [abs(frame.t_ns - true_ns[frame.frame_id]) / frame.dt_ns for frame, _ in frames]
    return [
        Figure(
            f"MJPEG {width}×{height} from the served emulator",
            "30 Hz",
            f"{rate_hz:.2f} Hz, {lost} of {len(frames) + lost} frames lost",
            rate_hz > 29.9 and lost <= 0.01 * len(frames),
        ),
        Figure("  end of exposure to subscriber (the emulated camera's own delay included)", "", latency.in_ms()),
        Figure("  error of the stamps", "≤ as stated", f"{100 * np.mean(np.array(stamps) <= 1):.0f} % within ± 95 %"),
    ]


def _freshness(grabs: list[tuple[int, Frame, int]], true_ns: dict[int, int]) -> Figure:
    def began_ns(frame: Frame) -> int:
        return true_ns[frame.frame_id] - round(frame.exposure_ms * NS_PER_MS / 2)

    stale = sum(began_ns(frame) < called_ns for called_ns, frame, _ in grabs)
    took = Times([end_ns - called_ns for called_ns, _, end_ns in grabs])
    return Figure(
        "  grab() at random moments: frames exposed before the call",
        "none",
        f"{stale} of {len(grabs)}; took {took.in_ms()}",
        stale == 0,
    )
