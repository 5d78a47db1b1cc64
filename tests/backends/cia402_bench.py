"""A fine stage wired to three scripted drives, and all that it published."""

from __future__ import annotations

from typing import Any

from microdrivers.backends.cia402 import DRIVER, FineStageSettings
from microdrivers.backends.cia402.fine_stage import Cia402FineStage
from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock, SimulatedClock
from microdrivers.core.samples import DeviceEvent, FineStageSample
from microdrivers.core.units import NS_PER_S, Range
from microdrivers.fakes.can import forget_medium, shared_medium
from tests.backends.cia402_peer import PeerDrive

COUNTS = 20.0
AXIS: dict[str, Any] = {
    "counts_per_um": COUNTS, "travel_um": Range(-625.0, 625.0), "max_speed_um_s": 1000.0,
    "acceleration_um_s2": 10_000.0, "tolerance_um": 0.15, "homing_method": 17,
}  # fmt: skip
NODES = {"x": 11, "y": 12, "z": 13}


class Bench:
    """A stage on three peers; `changes` go to its settings, `axes` to single axes."""

    def __init__(
        self, *, clock: Clock | None = None, channel: str = "bench", axes: dict[str, dict[str, Any]] | None = None,
        bus: Bus | None = None, seed: int = 1, **changes: Any,
    ) -> None:  # fmt: skip
        self.clock = SimulatedClock() if clock is None else clock
        self.channel = channel
        self.medium = shared_medium(channel, clock=self.clock, bitrate=500_000, seed=seed)
        self.peers = {axis: PeerDrive(node_id) for axis, node_id in NODES.items()}
        for peer in self.peers.values():
            self.medium.attach(peer)
        own = {axis: AXIS | {"node_id": node_id} | (axes or {}).get(axis, {}) for axis, node_id in NODES.items()}
        values: dict[str, Any] = {
            "connection": {"interface": "microdrivers", "channel": channel, "timeout_s": 0.1}, "axes": own,
            "reference_order": ("z", "x", "y"), "retract_um": (0.0, 0.0, 500.0),
        }  # fmt: skip
        self.stage = self.make("probe_stage", values | changes, bus or Bus())
        self.samples: list[FineStageSample] = []
        self.events: list[DeviceEvent] = []
        self.stage.topic.subscribe(self.samples.append)
        self.stage.events.subscribe(self.events.append)

    def make(self, name: str, values: dict[str, Any], bus: Bus) -> Cia402FineStage:
        stage = DRIVER.create(name, FineStageSettings.model_validate(values), self.clock, bus)
        assert isinstance(stage, Cia402FineStage)
        return stage

    def opened(self) -> Bench:
        self.stage.open()
        return self

    def referenced(self) -> Bench:
        self.opened().stage.reference(["z", "x", "y"])
        self.events.clear()
        return self

    def close(self) -> None:
        self.stage.close()
        forget_medium(self.channel, self.medium)

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def truth_um(self, axis: str, t_ns: int | None = None) -> float:
        """Where an axis really is, in the drive's own direction."""
        return self.peers[axis].position_at(self.clock.now_ns() if t_ns is None else t_ns) / COUNTS

    def replace(self, axis: str) -> PeerDrive:
        """Switch a drive off and on: another one, fresh, in its place."""
        self.medium.detach(self.peers[axis])
        return self.replace_detached(axis)

    def replace_detached(self, axis: str) -> PeerDrive:
        """Switch a drive on that was switched off."""
        self.peers[axis] = PeerDrive(NODES[axis])
        self.medium.attach(self.peers[axis])
        return self.peers[axis]

    @property
    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]

    def seconds(self) -> float:
        return self.clock.now_ns() / NS_PER_S
