"""What is about to be moved, for whoever has a rule about it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import msgspec

from microdrivers.core.units import Range

MotionKind = Literal["move", "retraction", "reference"]


class MotionPlan(msgspec.Struct, frozen=True, kw_only=True):
    """Something that has passed a stage's own checks and has not been commanded yet; µm or degrees by axis.

    Attributes:
        kind: a search for references goes to places that nobody knows.
        start: where the stage is, all axes.
        targets: of the axes that are to move; empty for a search.
        sweep: the interval in which each axis stays until the motion has ended; empty for a search.
        straight: it begins at rest and the axes arrive together, so that the way is the line from start to targets.
        speed_um_s: along the way of the linear axes; 0 if it is not this command's to choose.
    """

    kind: MotionKind
    start: Mapping[str, float]
    targets: Mapping[str, float]
    sweep: Mapping[str, Range]
    straight: bool
    speed_um_s: float = 0.0

    @property
    def end(self) -> Mapping[str, float]:
        """Where the stage is afterwards, all axes."""
        return {**self.start, **self.targets}
