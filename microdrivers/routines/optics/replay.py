"""A recorded calibration as a source of samples: the same estimator, or another one, on old data."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock, SimulatedClock
from microdrivers.core.errors import UnsupportedError
from microdrivers.core.samples import Frame, Sample, XYThetaSample, ZoomSample
from microdrivers.estimators.optics.calibrator import CalibratorSettings, PointTracker
from microdrivers.recording.reader import Recording
from microdrivers.recording.replay import FRAME_HISTORY, Note, Replay, notes_of
from microdrivers.routines.optics.source import BEGIN, DONE, HOST, SETTINGS, Optics, SourceNames, frames_taken
from microdrivers.routines.optics.targets import make_tracker
from microdrivers.routines.past_run import PastRun, noted_settings, past_run, refuse_unbegun
from microdrivers.routines.progress import Progress


class _Before(NamedTuple):
    """The number of the frame before, and how many samples were missing up to it."""

    seq: int
    missing: int


class OpticsReplay:
    """Publishes what `calibrate optics` has recorded, in the order in which its estimator got it.

    Args:
        frames: how many of the run's frames the calibration takes, the first ones; None: as the run did.

    Raises:
        UnsupportedError: the recording holds no optical calibration. ConfigError: the run took fewer frames.
    """

    def __init__(self, recording: Recording, *, frames: int | None = None) -> None:
        self.bus = Bus()
        self.clock: Clock = SimulatedClock()
        self._recording = recording
        notes = notes_of(recording)
        self._beginning = _beginning(recording, notes)
        self.past_settings = noted_settings(notes, SETTINGS, CalibratorSettings, before=self._beginning)
        self._done = [note for note in notes if note.kind == DONE and note.order > self._beginning.order]
        taken: int | None = self._beginning.content["frames_expected"]
        self._frames_expected = frames if taken is None else frames_taken(frames, taken, source=str(recording.file))
        self.names = SourceNames(**self._beginning.content["names"])
        self._frames: list[Frame] = []
        self._replay = Replay(recording, self.bus, admit=self._admit)
        self._before: _Before | None = None
        self._frames_told = self._lost_frames = self._lost_last = 0

    def run(self, begin: Callable[[PointTracker], None], progress: Progress) -> None:
        """Publish the whole recording."""
        noted = self._beginning.content
        progress.step(f"replaying {self._recording.file}")
        tracker = make_tracker(noted["target"], near_px=tuple(noted["near_px"]))
        replay = self._replay
        camera = self.bus.topic(self.names.camera, Frame, history=FRAME_HISTORY)
        subscription = camera.subscribe(self._keep)
        replay.up_to(self._beginning.order)
        subscription.cancel()
        first = [frame for frame in self._frames if frame.seq == noted["first_frame"]]
        if not first:
            raise UnsupportedError(
                f"{self._recording.file} lacks the frame in which the target was found",
                remedy="record the camera's topic from the beginning of the routine",
            )
        tracker.update(first[-1])
        self._frames.clear()
        self._before = _Before(seq=camera.history[-1].seq, missing=0)
        begin(tracker)
        replay.as_arrived(HOST, (self.names.stage, self.names.zoom, self.names.camera), None)
        if self._frames_expected is not None and self._done and not self._done[-1].content["ended_by"]:
            self._lost_last = min(self._frames_expected - self._frames_told, replay.missing - self._before.missing)
        if replay.missing:
            progress.step(f"missing in the recording, of the samples that the estimator had: {replay.missing}")
        replay.require(self.bus.topic(self.names.stage, XYThetaSample), self.bus.topic(self.names.zoom, ZoomSample))

    @property
    def past_run(self) -> PastRun:
        """What the recording says of it."""
        lost = self._lost_frames + self._lost_last
        return past_run(
            self._recording, self._done, missing=self._replay.missing, lost_frames=lost, lost_last=self._lost_last
        )

    def _admit(self, topic: str, sample: Sample) -> bool:
        """Count the run's frames, and those that the recording lacks; no later one takes the place of a lost one."""
        if topic != self.names.camera or self._before is None:
            return True
        # A number that is skipped may be of a frame that the camera lost in the run: then no sample is missing either.
        missing = self._replay.missing
        lost = max(0, min(sample.seq - self._before.seq - 1, missing - self._before.missing))
        if self._frames_expected is not None:
            lost = min(lost, self._frames_expected - self._frames_told)
        self._before = _Before(sample.seq, missing)
        self._lost_frames += lost
        self._frames_told += lost
        is_later = self._frames_told == self._frames_expected
        self._frames_told += not is_later
        return not (is_later and self._lost_frames)

    def _keep(self, frame: Frame) -> None:
        if frame.seq == self._beginning.content["first_frame"]:
            self._frames.append(frame)

    def optics(self) -> Optics:
        """As they were."""
        noted = self._beginning.content["optics"]
        return Optics(**noted | {"roi": tuple(noted["roi"])})

    def frames_expected(self) -> int | None:
        """As it was, or as asked for."""
        return self._frames_expected


def _beginning(recording: Recording, notes: Sequence[Note]) -> Note:
    beginnings = [note for note in notes if note.kind == BEGIN]
    if not beginnings and recording.losses and (HOST in recording.arrivals or any(n.kind == DONE for n in notes)):
        raise UnsupportedError(
            f"{recording.file} holds an optical calibration, and the note of its beginning is in what is damaged or "
            "lost of the file: without it the calibration cannot be estimated anew",
            remedy="give another copy of the file; `microdrivers export` gives what is intact of its samples",
        )
    if not beginnings:
        refuse_unbegun(recording, notes, DONE)
        raise UnsupportedError(
            f"{recording.file} holds no optical calibration",
            remedy="give the run.mcap of `microdrivers calibrate optics`; `microdrivers info` tells what a file holds",
        )
    return beginnings[-1]
