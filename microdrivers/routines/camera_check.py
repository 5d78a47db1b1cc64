"""Is a camera fit for measuring: rate, freshness, losses, saturation, and whether it knows when it exposed."""

from __future__ import annotations

from microdrivers.core.errors import MicrodriversError
from microdrivers.core.samples import Frame
from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.devices.camera import Camera
from microdrivers.routines.device_state import state_text
from microdrivers.routines.findings import DeviceDiagnosis

STAMP_LIMIT_NS = 200_000
"""Calibrating in motion to 0.02° tolerates 0.17 ms between pose and frame; see docs/decisions/0002."""
RATE_TIME_S = 1.0
LEAST_RATE_SHARE = 0.9

_GRABS = 5
_FIRST_FRAME_S = 3.0
_SATURATED_SHARE = 0.01
_DARK_SHARE = 0.05


def full_scale(frame: Frame) -> int:
    """The largest value that a pixel of the frame can have."""
    return int(2**frame.bit_depth) - 1


def saturated_share(frame: Frame) -> float:
    """The share of pixels at full scale, 0 to 1."""
    return float((frame.image >= full_scale(frame)).mean())


def check_camera(camera: Camera, found: DeviceDiagnosis) -> None:
    """Let an open camera run for about two seconds and write down what was seen."""
    found.ok(state_text(camera, None))
    try:
        with camera.running():
            first = camera.grab(timeout_s=_FIRST_FRAME_S)
            _check_time(first, found)
            frames = _check_rate(camera, found)
            _check_freshness(camera, found)
    except MicrodriversError as error:
        found.failed(error)
        return
    _check_image(frames or [first], found)


def _check_time(frame: Frame, found: DeviceDiagnosis) -> None:
    stated = f"±{frame.dt_ns / NS_PER_MS:.3g} ms"
    found.figures |= {"t_source": frame.t_source, "stated_uncertainty_ms": frame.dt_ns / NS_PER_MS}
    remedy = "calibrate with --settled (move, settle, then grab); continuous 30 Hz needs stamps good to 0.2 ms"
    if frame.t_source != "device":
        found.warn(
            f"the capture time is not known, only the arrival: {stated} stated; nor can freshness be proven, "
            "for a frame from a buffer arrives like a fresh one",
            remedy,
        )
    else:
        found.judge(frame.dt_ns <= STAMP_LIMIT_NS, f"the camera stamps the capture time, {stated} stated", remedy)


def _check_rate(camera: Camera, found: DeviceDiagnosis) -> list[Frame]:
    """Rate and losses over a second; the images that may be kept are few, so only those around the end are."""
    frames: list[Frame] = []
    times: list[tuple[int, int, int]] = []

    def take(frame: Frame) -> None:
        times.append((frame.t_ns, frame.frame_id, frame.dropped_before))
        frames.append(frame)
        del frames[:-3]

    subscription = camera.topic.subscribe(take)
    try:
        camera.clock.sleep(RATE_TIME_S)
        camera.clock.sleep(0.0)  # an error in a source of the clock comes to light in the next wait
    finally:
        subscription.cancel()
    wanted_hz = camera.settings.rate_hz
    span_s = (times[-1][0] - times[0][0]) / NS_PER_S if times else 0.0
    rate_hz = (len(times) - 1) / span_s if span_s > 0 else len(times) / RATE_TIME_S
    dropped = sum(lost for _, _, lost in times)
    found.figures |= {"rate_hz": rate_hz, "dropped_frames": dropped, "frames": len(times)}
    if not times:
        found.problem(f"no frame came in {RATE_TIME_S:g} s", "check the camera's cable, trigger and exposure")
        return frames
    found.judge(
        rate_hz >= LEAST_RATE_SHARE * wanted_hz,
        f"{rate_hz:.1f} frames/s of {wanted_hz:g} asked",
        "shorten the exposure, lower rate_hz in the rig file, or give the camera a faster port",
    )
    lost = f"{dropped} of {len(times) + dropped} frames dropped"
    found.judge(dropped == 0, lost, "close other programs, or lower rate_hz in the rig file")
    if len({number for _, number, _ in times}) < len(times):
        found.problem("the same frame was delivered more than once", "report it to the authors of the driver")
    return frames


def _check_freshness(camera: Camera, found: DeviceDiagnosis) -> None:
    """`grab()` must return a frame exposed after the call, whatever lies in a buffer."""
    oldest_ms = 0.0
    waits_ms = []
    for number in range(_GRABS):
        camera.clock.sleep(number * 0.007)  # at other phases of the frame period
        called_ns = camera.clock.now_ns()
        frame = camera.grab()
        began_ns = frame.t_ns - round(frame.exposure_ms * NS_PER_MS / 2)
        oldest_ms = max(oldest_ms, (called_ns - began_ns) / NS_PER_MS)
        waits_ms.append((camera.clock.now_ns() - called_ns) / NS_PER_MS)
    found.figures |= {"grab_ms": max(waits_ms)}
    if oldest_ms > 0:
        found.problem(
            f"grab() returned a frame whose exposure began {oldest_ms:.3g} ms before the call",
            "report it to the authors of the driver: it hands out buffered frames",
        )
    elif frame.t_source == "device":
        found.ok(f"grab() returns frames exposed after the call, within {max(waits_ms):.0f} ms ({_GRABS} of {_GRABS})")
    else:
        found.ok(f"grab() returns within {max(waits_ms):.0f} ms a frame that, by its arrival, is fresh")


def _check_image(frames: list[Frame], found: DeviceDiagnosis) -> None:
    last = frames[-1]
    share, brightest = saturated_share(last), int(last.image.max())
    found.figures |= {"bit_depth": last.bit_depth, "saturated_share": share, "brightest": brightest}
    text = f"{last.bit_depth} bit; {100 * share:.3g} % of the pixels at {full_scale(last)}, brightest {brightest}"
    if brightest < _DARK_SHARE * full_scale(last):
        found.warn(f"the image is dark: {text}", "check lens cap, light and exposure_ms")
    else:
        found.judge(share <= _SATURATED_SHARE, text, "shorten exposure_ms or dim the light: saturated edges move")
    if len(frames) > 1 and all((frame.image == last.image).all() for frame in frames[:-1]):
        found.warn(
            "consecutive frames are identical to the last bit, noise included",
            "check that the camera runs: a frozen picture looks like this (a recorded or synthetic one also)",
        )
