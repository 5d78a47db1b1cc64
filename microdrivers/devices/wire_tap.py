"""Lets others listen to a device's wire, or to a bus that devices share."""

from __future__ import annotations

import itertools
from typing import Literal

from microdrivers.core.bus import Bus
from microdrivers.core.samples import WireTraffic

WIRE_SUFFIX = "/wire"

_ERROR_FLAG = 0x20000000
"""In candump's notation, and SocketCAN's, the bit by which an identifier is the class of an error frame."""


class WireTap:
    """Publishes what passes on a wire, on topic `<name>/wire`, as long as somebody listens there.

    Args:
        name: the device's; of a line that several devices share, one that no device can have.
        bus: the rig's topics.
    """

    def __init__(self, name: str, bus: Bus) -> None:
        self._name = name
        self._bus = bus
        self.topic = bus.topic(f"{name}{WIRE_SUFFIX}", WireTraffic)
        self._next_seq = itertools.count().__next__

    def sent(self, t_ns: int, data: bytes) -> None:
        """The driver has handed these bytes to the port."""
        if self.topic.heard:
            self._publish(t_ns, "sent", data)

    def received(self, t_ns: int, data: bytes) -> None:
        """The driver has got these bytes from the port."""
        if self.topic.heard:
            self._publish(t_ns, "received", data)

    def of_bus(self, channel: str) -> CanTap:
        """The tap of a CAN bus of the same rig."""
        return CanTap(channel, self._bus)

    def _publish(self, t_ns: int, direction: Literal["sent", "received"], data: bytes) -> None:
        self.topic.publish(
            WireTraffic(
                t_ns=t_ns,
                device=self._name,
                seq=self._next_seq(),
                t_source="computed",
                direction=direction,
                data=bytes(data),
            )
        )


class CanTap(WireTap):
    """Publishes the frames of a CAN bus on topic `CAN <channel>/wire`, in candump's notation: `60B#4000100000000000`.

    Identifiers of 29 bits have eight digits, remote frames an R and the length, error frames the identifier
    20000000h + class.
    """

    def __init__(self, channel: str, bus: Bus) -> None:
        super().__init__(f"CAN {channel}", bus)

    @property
    def heard(self) -> bool:
        """Whether anybody listens: look before a frame is handed over."""
        return self.topic.heard

    def frame(
        self, t_ns: int, direction: Literal["sent", "received"], identifier: int, data: bytes, *,
        extended: bool = False, remote: bool = False,
    ) -> None:  # fmt: skip
        """A data or remote frame has passed, whose `data` is as long as it says."""
        name = f"{identifier:08X}" if extended else f"{identifier:03X}"
        payload = f"R{len(data)}" if remote else data.hex().upper()
        self._publish(t_ns, direction, f"{name}#{payload}".encode())

    def error_frame(self, t_ns: int, error_class: int, data: bytes) -> None:
        """The controller has reported trouble on the bus, as SocketCAN does."""
        self._publish(t_ns, "received", f"{_ERROR_FLAG | error_class:08X}#{data.hex().upper()}".encode())
