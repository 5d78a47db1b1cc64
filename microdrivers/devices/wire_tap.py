"""Lets others listen to a device's wire."""

from __future__ import annotations

from typing import Literal

from microdrivers.core.bus import Bus
from microdrivers.core.samples import WireTraffic


class WireTap:
    """Publishes what passes on a device's wire, on topic `<device>/wire`, as long as somebody listens there."""

    def __init__(self, device: str, bus: Bus) -> None:
        self._device = device
        self.topic = bus.topic(f"{device}/wire", WireTraffic)
        self._seq = 0

    def sent(self, t_ns: int, data: bytes) -> None:
        """The driver has handed these bytes to the port."""
        if self.topic.heard:
            self._publish(t_ns, "sent", data)

    def received(self, t_ns: int, data: bytes) -> None:
        """The driver has got these bytes from the port."""
        if self.topic.heard:
            self._publish(t_ns, "received", data)

    def _publish(self, t_ns: int, direction: Literal["sent", "received"], data: bytes) -> None:
        seq, self._seq = self._seq, self._seq + 1
        self.topic.publish(
            WireTraffic(
                t_ns=t_ns, device=self._device, seq=seq, t_source="computed", direction=direction, data=bytes(data)
            )
        )
