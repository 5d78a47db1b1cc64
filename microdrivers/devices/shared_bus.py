"""What a driver can tell of a bus that its device shares with others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import msgspec


class BusFacts(msgspec.Struct, frozen=True, kw_only=True):
    """A bus as the rig sees it.

    Attributes:
        name: the same for all devices that share it.
        bitrate: bit/s.
        load: share of the last whole second that the frames took which the rig sent and received, 0 to 1.
        counters: what has happened since the bus was opened, by name. `sent`, `received` and `exchanges` count what
            went well, every other one what did not.
    """

    name: str
    bitrate: int
    load: float
    counters: Mapping[str, int]

    @property
    def troubles(self) -> Mapping[str, int]:
        """The counters of what did not go well."""
        return {name: count for name, count in self.counters.items() if name not in ("sent", "received", "exchanges")}


@runtime_checkable
class SharesABus(Protocol):
    """A device whose driver tells about the bus that it is on."""

    @property
    def bus_facts(self) -> BusFacts:
        """The bus at present; also when the device is closed."""
