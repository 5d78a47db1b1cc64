"""On which flank the zoom body's gear lies, and how to reach a target from the wanted side."""

from __future__ import annotations

from microdrivers.devices.zoom_motor import Approach


class Backlash:
    """Remembers the flank that the moves so far leave in contact.

    Args:
        play_steps: the play; a motion of at least this length surely takes it up.
        tolerance_steps: how far from its target a move may end.
        low_steps, high_steps: no way leads outside.
    """

    def __init__(self, *, play_steps: int, tolerance_steps: int, low_steps: int, high_steps: int) -> None:
        self._play_steps = play_steps
        self._overshoot_steps = max(2 * play_steps, play_steps + tolerance_steps)
        self._low_steps = low_steps
        self._high_steps = high_steps
        self._flank: Approach | None = None

    def forget(self) -> None:
        """The flank is not known: the motor was stopped, or moved by something else."""
        self._flank = None

    def moved(self, start_steps: int, target_steps: int) -> None:
        """A direct move is made."""
        distance = target_steps - start_steps
        side: Approach = "below" if distance >= 0 else "above"
        if abs(distance) >= self._play_steps:
            self._flank = side
        elif side != self._flank and distance:
            self._flank = None

    def via(self, start_steps: int, target_steps: int, approach: Approach) -> int | None:
        """Where to go first, or None if the direct way ends on the wanted flank.

        Nearer to the end of the range than the overshoot the way turns at the end of the range; at the end itself
        the wanted side does not exist and the direct way is taken.
        """
        if approach == "direct" or not self._play_steps:
            return None
        ahead = target_steps - start_steps if approach == "below" else start_steps - target_steps
        if ahead >= self._play_steps or (ahead >= 0 and self._flank == approach):
            return None
        if approach == "below":
            via = max(target_steps - self._overshoot_steps, self._low_steps)
        else:
            via = min(target_steps + self._overshoot_steps, self._high_steps)
        return None if via == target_steps else via
