"""A recorded force characterisation as a source of samples: the same estimators, or others, on old data."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock, SimulatedClock
from microdrivers.core.contact_samples import DeformationSample
from microdrivers.core.errors import UnsupportedError
from microdrivers.core.samples import ForceSample, Frame
from microdrivers.estimators.force.identify import IdentificationSettings
from microdrivers.estimators.vision.contact import ImageScale
from microdrivers.recording.reader import Recording
from microdrivers.recording.replay import FRAME_HISTORY, Note, Replay, notes_of
from microdrivers.routines.force.sight import Sight
from microdrivers.routines.force.source import (
    BEGIN,
    DONE,
    END,
    READY,
    SETTINGS,
    FrameTracker,
    IndentationNames,
    IndentationSetup,
    Rests,
    host_name,
)
from microdrivers.routines.past_run import PastRun, noted_settings, past_run, refuse_unbegun
from microdrivers.routines.progress import Progress


class IndentationReplay:
    """Publishes what `calibrate force` has recorded, in the order in which its estimators got it.

    Raises:
        UnsupportedError: the recording holds no force characterisation.
    """

    whereabouts = ""

    def __init__(self, recording: Recording) -> None:
        self.bus = Bus()
        self.clock: Clock = SimulatedClock()
        self._recording = recording
        notes = notes_of(recording)
        ready = [note for note in notes if note.kind == READY]
        if not ready:
            refuse_unbegun(recording, notes, DONE)
            raise UnsupportedError(
                f"{recording.file} holds no force characterisation",
                remedy="give the run.mcap of `calibrate force`; `microdrivers info` tells what a file holds",
            )
        self._ready = ready[-1]
        self.past_settings = noted_settings(notes, SETTINGS, IdentificationSettings, before=self._ready)
        self._begins = [note for note in notes if note.kind == BEGIN and note.order > self._ready.order]
        self._ends = [note for note in notes if note.kind == END and note.order > self._ready.order]
        self._done = [note for note in notes if note.kind == DONE and note.order > self._ready.order]
        self.names = IndentationNames(**self._ready.content["names"])
        self.repeatable = len(self._begins) > 1
        self._inputs = (self.names.sensor, self.names.camera or self.names.deformation)
        self._replay = Replay(recording, self.bus)
        self._indentations = 0

    def prepare(self, progress: Progress) -> FrameTracker | None:
        """Publish what came before the first indentation, and learn from its frames what is tracked."""
        progress.step(f"replaying {self._recording.file}")
        known = self._ready.content
        if self.names.camera is None:
            self._replay.up_to(self._ready.order)
            return None
        wanted = {*known["travel_frames"], *known["rest_frames"]}
        frames: dict[int, Frame] = {}

        def keep(frame: Frame) -> None:
            if frame.seq in wanted:
                frames[frame.seq] = frame

        subscription = self.bus.topic(self.names.camera, Frame, history=FRAME_HISTORY).subscribe(keep)
        self._replay.up_to(self._ready.order)
        subscription.cancel()
        projection = known["projection"]
        scale = None if projection is None else ImageScale(tuple(projection["um_per_px"]), projection["relative_sigma"])
        sight = Sight(scale, source=known["scale_source"])
        sight.learn(
            self._all(frames, known["travel_frames"]),
            known["travel_um"],
            scale_hint_px_per_um=known["scale_hint_px_per_um"],
        )
        rest = self._all(frames, known["rest_frames"])
        return sight.tracker(
            self.names.camera, rest, contact_ahead_um=known["contact_ahead_um"], depth_um=known["depth_um"]
        )

    def _all(self, frames: dict[int, Frame], numbers: Sequence[int]) -> list[Frame]:
        missing = [number for number in numbers if number not in frames]
        if missing:
            raise UnsupportedError(
                f"{self._recording.file} lacks {len(missing)} of the frames by which the probe was found",
                remedy="record the camera's topic from the beginning of the routine",
            )
        return [frames[number] for number in numbers]

    def indent(self, begin: Callable[[], None], progress: Progress) -> Rests | None:
        """Publish the next indentation of the recording."""
        number = self._indentations = self._indentations + 1
        start = self._begins[number - 1].order if number <= len(self._begins) else None
        self._replay.up_to(start)
        begin()
        end = self._end(number)
        self._replay.as_arrived(host_name(number), self._inputs, None if end is None else end.order)
        if self._replay.missing:
            progress.step(f"{self._replay.missing} samples that the estimators had are not in the recording")
        self._replay.require(
            self.bus.topic(self.names.sensor, ForceSample), self.bus.topic(self.names.deformation, DeformationSample)
        )
        return Rests(**end.content) if end is not None and end.content else None

    def _end(self, number: int) -> Note | None:
        """The note that ends the indentation; None if it was broken off, or the note is lost."""
        begun = [note.order for note in self._begins[number - 1 : number + 1]]
        own = [note for note in self._ends if begun and begun[0] < note.order and not note.order > begun[-1] > begun[0]]
        return own[0] if own else None

    @property
    def past_run(self) -> PastRun:
        """What the recording says of it."""
        broken_off = ""
        if self._end(len(self._begins)) is None:
            how = "the recorded run" if self._recording.complete else "the recording was cut off, and"
            broken_off = f"{how} ends before indentation {max(1, len(self._begins))} was over"
        return past_run(self._recording, self._done, missing=self._replay.missing, broken_off=broken_off)

    def finish(self) -> None:
        """Publish what is left."""
        self._replay.up_to(None)

    def setup(self) -> IndentationSetup:
        """As it was."""
        return IndentationSetup(**self._ready.content["setup"])
