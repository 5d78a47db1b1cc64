"""A force sensor wired to an amplifier on an emulated bus, and all that was published."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

from microdrivers.backends.cia404 import DRIVER, Cia404ForceSettings
from microdrivers.backends.cia404.sensor import Cia404ForceSensor
from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock, SimulatedClock
from microdrivers.core.samples import DeviceEvent, ForceSample
from microdrivers.core.units import NS_PER_S, Range
from microdrivers.fakes.can import CanNode, forget_medium, shared_medium
from tests.backends.cia404_peer import SheetAmplifier

_names = itertools.count()

RIG: dict[str, Any] = {
    "node_id": 21, "range_uN": Range(-2000.0, 2000.0), "bandwidth_hz": 500.0, "resolution_uN": 0.01,
    "stiffness_uN_per_um": 1000.0, "axis": (0.0, 0.0, 1.0), "carried_by": "probe_stage", "rate_hz": 1000.0,
}  # fmt: skip


class ForceBench:
    """Close it, or use it in a `with`, so that the bus is forgotten."""

    def __init__(
        self, amplifier: SheetAmplifier | None = None, *, others: Sequence[CanNode] = (), clock: Clock | None = None,
        bitrate: int = 500_000, timeout_s: float = 0.05, **rig: Any,
    ) -> None:  # fmt: skip
        self.amplifier = SheetAmplifier() if amplifier is None else amplifier
        self.clock = SimulatedClock() if clock is None else clock
        channel = f"cia404-test-{next(_names)}"
        self.medium = shared_medium(channel, clock=self.clock, bitrate=bitrate, seed=1)
        self._channel = channel
        for node in (self.amplifier, *others):
            self.medium.attach(node)
        self.connection = {"interface": "microdrivers", "channel": channel, "bitrate": bitrate, "timeout_s": timeout_s}
        self.bus = Bus()
        self.sensor = self.another("probe_force", **rig)
        self.samples: list[ForceSample] = []
        self.events: list[DeviceEvent] = []
        self.sensor.topic.subscribe(self.samples.append)
        self.sensor.events.subscribe(self.events.append)

    def another(self, name: str, **rig: Any) -> Cia404ForceSensor:
        settings = Cia404ForceSettings.model_validate({"connection": self.connection} | RIG | rig)
        sensor = DRIVER.create(name, settings, self.clock, self.bus)
        assert isinstance(sensor, Cia404ForceSensor)
        return sensor

    def opened(self) -> ForceBench:
        self.sensor.open()
        return self

    def __enter__(self) -> ForceBench:
        return self

    def __exit__(self, *_: object) -> None:
        self.sensor.close()
        forget_medium(self._channel, self.medium)

    @property
    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]

    @property
    def host_frames(self) -> list[str]:
        return [f"{frame.id:03X}#{frame.data.hex().upper()}" for _, who, frame in self.medium.log if who == "host"]

    def now_s(self) -> float:
        return self.clock.now_ns() / NS_PER_S
