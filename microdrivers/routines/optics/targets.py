"""Which tracker follows which kind of target."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np

from microdrivers.core.samples import Frame, TrackedPoint

if TYPE_CHECKING:
    from microdrivers.estimators.vision.square import SquareTracker

TargetKind = Literal["square", "texture"]


class TargetTracker(Protocol):
    """A tracker that knows how far its target reaches."""

    def update(self, frame: Frame) -> TrackedPoint:
        """Locate the target's point; `found` is False if it is lost."""

    @property
    def reach_px(self) -> float:
        """Largest distance from the tracked point that must stay in view, px in the newest frame."""


def make_tracker(kind: TargetKind, *, near_px: tuple[float, float] = (0.0, 0.0)) -> TargetTracker:
    """A new tracker; `near_px` (from the principal point) says which point of the target is wanted."""
    if kind == "square":
        from microdrivers.estimators.vision.square import SquareTracker

        return _Square(SquareTracker(near_px=near_px, device="track"))
    from microdrivers.estimators.vision.texture import TextureTracker

    return TextureTracker(near_px=near_px, device="track")


class _Square:
    def __init__(self, tracker: SquareTracker) -> None:
        self._tracker = tracker

    def update(self, frame: Frame) -> TrackedPoint:
        return self._tracker.update(frame)

    @property
    def reach_px(self) -> float:
        fit = self._tracker.last_fit
        return 0.0 if fit is None else float(np.linalg.norm(fit.corners_px - fit.corners_px[0], axis=1).max())
