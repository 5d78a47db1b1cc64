"""What a host's controller receives, and which frames it lets through."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from microdrivers.fakes.can.frame import Frame

EXTENDED_FLAG, REMOTE_FLAG, ERROR_FLAG = 1 << 31, 1 << 30, 1 << 29
"""In an identifier, as in linux/can.h."""

PROTOCOL_ERROR = Frame(0x008, bytes(8))
"""An error frame, as SocketCAN shows it: the class of the error as identifier (linux/can/error.h)."""


class Arrival(NamedTuple):
    """What a port received.

    Attributes:
        t_ns: when the frame ended on the bus.
        error: it is an error frame; `frame` then tells its class.
        own: the port sent it.
    """

    t_ns: int
    frame: Frame
    error: bool = False
    own: bool = False


class Filter:
    """Lets frames through whose identifier is `id` where `mask` has ones, as (id, mask, extended or either).

    Without any of these, all pass.
    """

    def __init__(self, wanted: Sequence[tuple[int, int, bool | None]]) -> None:
        self._wanted = tuple(wanted)
        self._known: dict[int, bool] = {}

    def accepts(self, frame: Frame) -> bool:
        """Whether a frame passes."""
        if not self._wanted:
            return True
        key = frame.id | EXTENDED_FLAG if frame.extended else frame.id
        accepted = self._known.get(key)
        if accepted is None:
            accepted = self._known[key] = any(
                not (frame.id ^ identifier) & mask and (extended is None or extended == frame.extended)
                for identifier, mask, extended in self._wanted
            )
        return accepted
