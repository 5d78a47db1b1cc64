"""Does a device's stream come as fast as it is used, and does it carry readings?"""

from __future__ import annotations

from typing import Any

from microdrivers.core.samples import Sample
from microdrivers.devices.base import Device
from microdrivers.devices.force_sensor import STALE, ForceSensor
from microdrivers.devices.stage import Stage
from microdrivers.devices.zoom_motor import ZoomMotor
from microdrivers.routines.camera_check import LEAST_RATE_SHARE, RATE_TIME_S
from microdrivers.routines.findings import DeviceDiagnosis

POSE_RATE_HZ = 100.0
"""What the optical calibration streams a stage at; `ZOOM_RATE_HZ` likewise."""
ZOOM_RATE_HZ = 70.0
OTHER_RATE_HZ = 50.0


def usual_rate_hz(device: Device[Any]) -> float:
    """The rate at which a device of this kind is streamed in use; a force sensor has it from the rig file."""
    if isinstance(device, Stage):
        return POSE_RATE_HZ
    if isinstance(device, ForceSensor):
        return device.stream_rate_hz
    return ZOOM_RATE_HZ if isinstance(device, ZoomMotor) else OTHER_RATE_HZ


def check_stream(device: Device[Any], found: DeviceDiagnosis) -> None:
    """Stream for a second and write down what came."""
    wanted_hz = usual_rate_hz(device)
    readings, stale = 0, 0

    def count(sample: Sample) -> None:
        nonlocal readings, stale
        is_stale = STALE in sample.flags
        stale += is_stale
        readings += not is_stale

    subscription = device.topic.subscribe(count)
    try:
        with device.stream(wanted_hz):
            device.clock.sleep(RATE_TIME_S)
        device.clock.sleep(0.0)  # an error in a source of the clock comes to light in the next wait
    finally:
        subscription.cancel()
    rate_hz = readings / RATE_TIME_S
    found.figures |= {"stream_asked_hz": wanted_hz, "stream_hz": rate_hz, "stream_stale": stale}
    if not readings:
        found.problem(f"no sample came in {RATE_TIME_S:g} s of streaming", "check cable and power")
        return
    if stale:
        found.problem(
            f"the stream was STALE {stale} times: no new reading came in time",
            "check cable and power, and that nobody else makes the device restart",
        )
    found.judge(
        rate_hz >= LEAST_RATE_SHARE * wanted_hz,
        f"streams {rate_hz:.0f} samples/s of {wanted_hz:g} asked",
        "raise the baud rate, give the device a line of its own, or ask for fewer samples",
    )
