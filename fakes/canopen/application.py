"""What lies behind the communication of a node."""

from __future__ import annotations

from typing import Literal, Protocol

Loss = Literal["heartbeat", "stopped", "reset"]


class Application(Protocol):
    """What lies behind the communication: a drive, an amplifier."""

    def advance(self, t_ns: int) -> None:
        """Let what falls due by itself happen."""

    def next_event_ns(self) -> int | None:
        """When that is."""

    def restart(self, t_ns: int) -> None:
        """As after power-on; objects have their power-on values already."""

    def communication_lost(self, loss: Loss, t_ns: int) -> None:
        """The master's heartbeat is missing, or the node was stopped or reset."""

    def communication_back(self, t_ns: int) -> None:
        """All heartbeats come again."""
