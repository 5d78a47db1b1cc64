"""How far a table may lag behind its demand, and for how long (6065h and 6066h)."""

from __future__ import annotations

from microdrivers.core.units import NS_PER_MS
from microdrivers.fakes.cia402.motion import Motion
from microdrivers.fakes.cia402.objects import NO_WINDOW, DriveObjects

PERIOD_NS = 4 * NS_PER_MS
"""How often the drive looks, while the table is to move."""


class FollowingErrorWatch:
    """Looks every few milliseconds from `start` on, until the motion has ended.

    Attributes:
        too_large: whether the error was outside its window when it looked.
    """

    def __init__(self, motion: Motion, objects: DriveObjects) -> None:
        self.due_ns: int | None = None
        self.too_large = False
        self._motion = motion
        self._objects = objects
        self._since_ns: int | None = None

    def start(self, t_ns: int) -> None:
        """A motion begins."""
        self.stop()
        self.due_ns = t_ns + PERIOD_NS

    def stop(self) -> None:
        """The drive has given the motion up."""
        self.due_ns = self._since_ns = None
        self.too_large = False

    def advance(self, t_ns: int) -> bool:
        """Look; tells whether the error has been too large for too long."""
        self.due_ns = t_ns + PERIOD_NS if self._motion.moving_at(t_ns) or self._motion.jammed else None
        window = int(self._objects.following_window.value)
        self.too_large = window != NO_WINDOW and abs(self._motion.following_error_at(t_ns)) > window
        if not self.too_large:
            self._since_ns = None
            return False
        if self._since_ns is None:
            self._since_ns = t_ns
        return t_ns - self._since_ns >= int(self._objects.following_time_ms.value) * NS_PER_MS
