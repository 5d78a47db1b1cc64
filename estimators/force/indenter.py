"""All on-line estimators of an indentation as one: frames and readings in, whatever follows out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol

from microdrivers.core.contact_samples import (
    DeformationSample,
    IndentationSample,
    SpecimenEstimate,
    VisionForceSample,
)
from microdrivers.core.samples import ForceSample, Frame, Sample
from microdrivers.estimators.force.matcher import IndentationMatcher


class _FrameTracker(Protocol):
    def update(self, frame: Frame) -> DeformationSample: ...


class _Recursion(Protocol):
    def update(self, sample: Sample) -> Sequence[SpecimenEstimate]: ...


class _VisionForce(Protocol):
    def update(self, sample: Sample) -> Sequence[VisionForceSample]: ...

    def finish(self) -> Sequence[VisionForceSample]: ...


class IndentationEstimator:
    """Deformation from frames, force at the frames, and what on-line estimators make of them.

    Args:
        tracker: finds the deformation in frames; None if deformations come as samples.
        matcher: brings deformation and force together.
        recursion: takes the matched samples; None leaves it out.
        vision_force: takes the deformations alone; None leaves it out.
    """

    def __init__(
        self,
        tracker: _FrameTracker | None,
        matcher: IndentationMatcher,
        *,
        recursion: _Recursion | None = None,
        vision_force: _VisionForce | None = None,
    ) -> None:
        self.matcher = matcher
        self._tracker = tracker
        self._recursion = recursion
        self._vision_force = vision_force

    def update(self, sample: Sample) -> Iterable[Sample]:
        """Take a frame, a reading or a deformation; returns what followed, in order."""
        found: list[Sample] = []
        if isinstance(sample, Frame):
            if self._tracker is None:
                return found
            sample = self._tracker.update(sample)
            found.append(sample)
        if isinstance(sample, DeformationSample) and self._vision_force is not None:
            found += self._vision_force.update(sample)
        if isinstance(sample, DeformationSample | ForceSample):
            found += self._followed(self.matcher.update(sample))
        return found

    def finish(self) -> Iterable[Sample]:
        """No more samples come; returns what was waiting for some, in order.

        The recursion makes nothing of its last samples: no motion that follows tells whether they lie next to a corner.
        """
        forces = [] if self._vision_force is None else self._vision_force.finish()
        return [*forces, *self._followed(self.matcher.finish())]

    def _followed(self, indentations: Iterable[IndentationSample]) -> list[Sample]:
        found: list[Sample] = []
        for indentation in indentations:
            found.append(indentation)
            if self._recursion is not None:
                found += self._recursion.update(indentation)
        return found
