"""Rig-file settings of a force sensor on a CiA 404 amplifier."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import pydantic

from microdrivers.backends.cia404.measurement_frame import LARGEST_FRAME_BYTES, bus_load
from microdrivers.backends.lines.settings import CanConnection
from microdrivers.core.units import Range
from microdrivers.devices.force_sensor_settings import ForceSensorSettings

CHANNELS = Range(1, 8)
MOST_LOAD = 0.7
"""Share of the bus that one sensor may take: the rest is for requests, heartbeats and the other devices."""

FASTEST_HZ = 1000.0
"""The event timer counts milliseconds, and amplifiers ask not to be read faster."""


class Cia404ForceSettings(ForceSensorSettings):
    """A force sensor on one channel of an amplifier.

    With `sync` the amplifier sends on each SYNC, together with all devices that do; else by its own event timer, which
    counts whole milliseconds. `conversion_ms` is how long the amplifier takes to renew its value. Node 127 is
    this computer.
    """

    driver: Literal["cia404-force"] = "cia404-force"
    connection: CanConnection
    node_id: int = pydantic.Field(ge=1, le=126)
    channel: int = pydantic.Field(default=1, ge=int(CHANNELS.min), le=int(CHANNELS.max))
    rate_hz: float = pydantic.Field(default=FASTEST_HZ, gt=0, le=FASTEST_HZ)
    sync: bool = False
    conversion_ms: float = pydantic.Field(default=1.0, gt=0, le=1000)

    @pydantic.model_validator(mode="after")
    def _room_on_the_bus(self) -> Cia404ForceSettings:
        load = self.load_at(self.rate_hz)
        if load > MOST_LOAD:
            raise ValueError(
                f"rate_hz {self.rate_hz:g} loads the bus with {load:.0%} of its {self.connection.bitrate / 1000:g} "
                f"kbit/s, more than the {MOST_LOAD:.0%} that one sensor may take; lower the rate to "
                f"{self.rate_hz * MOST_LOAD / load:.0f} Hz or less, or raise the bit rate of all nodes"
            )
        return self

    def load_at(self, rate_hz: float) -> float:
        """Share of the bus that a stream takes at most."""
        return bus_load(rate_hz, LARGEST_FRAME_BYTES, bitrate=self.connection.bitrate, with_sync=self.sync)

    def claims(self) -> tuple[str, ...]:
        """The node."""
        return (f"node {self.node_id} on {self.connection.place}",)

    def shares(self) -> Mapping[str, Mapping[str, object]]:
        """The bus."""
        return self.connection.shared()
