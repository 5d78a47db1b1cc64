"""Which tracker follows which kind of target, and how far the target reaches."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np

from microdrivers.core.samples import Frame, TrackedPoint

if TYPE_CHECKING:
    from microdrivers.estimators.vision.square import SquareTracker
    from microdrivers.estimators.vision.texture import TextureTracker

TargetKind = Literal["square", "texture"]

_TEXTURE_WINDOW = 0.4


class TargetTracker(Protocol):
    """A tracker that knows how far its target reaches."""

    @property
    def reach_px(self) -> float:
        """Largest distance from the tracked point that must stay in view, px in the newest frame."""

    def update(self, frame: Frame) -> TrackedPoint:
        """Locate the target's point; `found` is False if it is lost."""


def make_tracker(kind: TargetKind, *, near_px: tuple[float, float] = (0.0, 0.0)) -> TargetTracker:
    """A new tracker; `near_px` (from the principal point) says which point of the target is wanted."""
    if kind == "square":
        from microdrivers.estimators.vision.square import SquareTracker

        return _Square(SquareTracker(near_px=near_px, device="track"))
    from microdrivers.estimators.vision.texture import TextureTracker

    return _Texture(TextureTracker(point_px=near_px, window=_TEXTURE_WINDOW, device="track"))


class _Square:
    def __init__(self, tracker: SquareTracker) -> None:
        self._tracker = tracker

    @property
    def reach_px(self) -> float:
        fit = self._tracker.last_fit
        return 0.0 if fit is None else float(np.linalg.norm(fit.corners_px - fit.corners_px[0], axis=1).max())

    def update(self, frame: Frame) -> TrackedPoint:
        return self._tracker.update(frame)


class _Texture:
    def __init__(self, tracker: TextureTracker) -> None:
        self._tracker = tracker
        self._shape: tuple[int, ...] = (0, 0)

    @property
    def reach_px(self) -> float:
        return 0.5 * _TEXTURE_WINDOW * math.hypot(*self._shape)

    def update(self, frame: Frame) -> TrackedPoint:
        self._shape = frame.image.shape
        return self._tracker.update(frame)
