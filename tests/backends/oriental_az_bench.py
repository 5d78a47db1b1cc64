"""A zoom motor wired to an emulated drive, and what every test of it asks."""

from __future__ import annotations

import math
from typing import Any

from microdrivers.backends.oriental_az import DRIVER, AzZoomSettings
from microdrivers.backends.oriental_az.zoom import AzZoomMotor
from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock, SimulatedClock
from microdrivers.core.samples import DeviceEvent, ZoomSample
from microdrivers.core.units import Range
from microdrivers.devices.zoom_motor import ZoomCurve
from microdrivers.fakes.wire import WireEmulator
from tests.backends.oriental_az_peer import Gateway, SheetDrive, plug_in

CURVE = ((-500, 0.75), (4000, 3.0), (12_000, 11.25))
STOP_ON = bytes.fromhex("0106007D0020180A")
INPUTS_OFF = bytes.fromhex("0106007D000019D2")


class Bench:
    """A zoom motor on an emulated drive, and all that it published."""

    def __init__(self, drive: WireEmulator | None = None, *, clock: Clock | None = None, **changes: Any) -> None:
        self.drive = SheetDrive(position=1000) if drive is None else drive
        self.clock = SimulatedClock() if clock is None else clock
        connection = changes.pop("connection", {})
        behind_gateway = connection.get("framing") == "tcp"
        url, self.wire = plug_in(Gateway(self.drive) if behind_gateway else self.drive, self.clock)
        values: dict[str, Any] = {
            "connection": {"port": url} | connection, "curve": CURVE,
            "zoom_range": Range(0.8, 10.0), "speed_steps_s": 20_000, "acceleration_steps_s2": 1_000_000,
        }  # fmt: skip
        bus = Bus()
        motor = DRIVER.create("zoom", AzZoomSettings.model_validate(values | changes), self.clock, bus)
        assert isinstance(motor, AzZoomMotor)
        self.motor = motor
        self.samples: list[ZoomSample] = []
        self.events: list[DeviceEvent] = []
        motor.topic.subscribe(self.samples.append)
        motor.events.subscribe(self.events.append)

    def opened(self) -> Bench:
        self.motor.open()
        return self

    @property
    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]


def sheet(bench: Bench) -> SheetDrive:
    assert isinstance(bench.drive, SheetDrive)
    return bench.drive


def at_steps(steps: int) -> float:
    return ZoomCurve.from_points(CURVE).zoom_at(steps)


def check_honesty(bench: Bench) -> None:
    """No sample may call a moving motor at rest, or a target reached too early."""
    drive = sheet(bench)
    for sample in bench.samples:
        instants = range(sample.t_ns - sample.dt_ns, sample.t_ns + sample.dt_ns + 1, max(1, sample.dt_ns // 4))
        assert min(drive.feedback(t) for t in instants) <= sample.position_steps
        assert max(drive.feedback(t) for t in instants) >= sample.position_steps
        if any(drive.moves(t) for t in instants):
            assert sample.moving
        if sample.on_target and not math.isnan(sample.target_zoom):
            assert not sample.moving
            assert drive.settled_at(sample.t_ns - sample.dt_ns) == sample.position_steps
