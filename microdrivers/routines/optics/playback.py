"""A recorded image sequence as a source of samples."""

from __future__ import annotations

from collections.abc import Callable

from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock, SimulatedClock
from microdrivers.estimators.optics.calibrator import PointTracker
from microdrivers.recording.image_sequence import ImageSequence
from microdrivers.routines.optics.source import Optics, SourceNames, frames_taken
from microdrivers.routines.optics.targets import TargetKind, make_tracker
from microdrivers.routines.past_run import PastRun
from microdrivers.routines.progress import Progress


class SequencePlayback:
    """Publishes an image sequence; its target is natural texture unless stated otherwise.

    Args:
        frames: how many of its frames the calibration takes, the first ones; None: all.

    Raises:
        ConfigError: it has fewer.
    """

    past_settings = None

    def __init__(self, sequence: ImageSequence, *, target: TargetKind = "texture", frames: int | None = None) -> None:
        self.bus = Bus()
        self.clock: Clock = SimulatedClock()
        self.names = SourceNames("stage", "zoom", "camera")
        self.past_run = PastRun(flaws=tuple(f"{flaw}, left out" for flaw in sequence.flaws))
        self._sequence = sequence
        self._frames = frames_taken(frames, len(sequence), source=str(sequence.folder))
        self._target: TargetKind = target

    def run(self, begin: Callable[[PointTracker], None], progress: Progress) -> None:
        """Publish the whole sequence."""
        progress.step(f"playing {len(self._sequence)} frames of {self._sequence.folder}")
        begin(make_tracker(self._target))
        self._sequence.publish(self.bus, stage="stage", zoom="zoom", camera="camera")

    def optics(self) -> Optics:
        """A sequence tells the image's size and nothing else."""
        height, width = self._sequence.load(self._sequence.rows[0]).shape
        return Optics(
            camera=self._sequence.folder.resolve().name,
            binning=1,
            roi=(0, 0, width, height),
            objective=None,
            pixel_pitch_um=None,
        )

    def frames_expected(self) -> int:
        """As asked for, or rows of the sequence."""
        return self._frames
