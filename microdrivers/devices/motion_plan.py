"""What is about to be moved, for whoever has a rule about it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, Protocol

import msgspec

from microdrivers.core.units import Range

if TYPE_CHECKING:
    from microdrivers.devices.stage import Stage

MotionKind = Literal["move", "retraction", "reference"]


class MotionPlan(msgspec.Struct, frozen=True, kw_only=True):
    """Something that has passed a stage's own checks and has not been commanded yet; µm or degrees by axis.

    Attributes:
        kind: a search for references goes to places that nobody knows.
        start: where the stage is, all axes.
        targets: of the axes that are to move; empty for a search.
        sweep: the interval in which each axis stays until the motion has ended; empty for a search.
        straight: it begins at rest and the axes arrive together, so that the way is the line from start to targets.
    """

    kind: MotionKind
    start: Mapping[str, float]
    targets: Mapping[str, float]
    sweep: Mapping[str, Range]
    straight: bool

    @property
    def end(self) -> Mapping[str, float]:
        """Where the stage is afterwards, all axes."""
        return {**self.start, **self.targets}


class MotionRule(Protocol):
    """A rule of the rig for a stage's motion, asked before anything moves."""

    def check(self, stage: Stage[Any], plan: MotionPlan) -> None:
        """Let the motion pass.

        Raises:
            UnsafeError: the rule forbids it.
        """

    def free_share(self, stage: Stage[Any], plan: MotionPlan) -> float:
        """How much of the way from the start is allowed, 0 to 1."""

    def found_references(self, stage: Stage[Any]) -> None:
        """A search for references has succeeded; the stage is where the drives have left it."""
