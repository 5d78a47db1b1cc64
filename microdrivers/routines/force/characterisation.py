"""The characterisation itself: the same for a live probe, a simulation and a recording."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

from microdrivers.core.bus import Topic
from microdrivers.core.contact_samples import (
    DeformationSample,
    IndentationSample,
    SpecimenEstimate,
    VisionForceSample,
)
from microdrivers.core.errors import CalibrationError, DataError, MicrodriversError, NoContact
from microdrivers.core.inbox import EstimatorHost, Inbox
from microdrivers.core.samples import ForceSample, Frame, Sample
from microdrivers.estimators.force.identify import Identification, IdentificationSettings, identify
from microdrivers.estimators.force.indenter import IndentationEstimator
from microdrivers.estimators.force.matcher import IndentationMatcher
from microdrivers.estimators.force.model import SpecimenModel, slipped_um
from microdrivers.estimators.force.record import IndentationRecord
from microdrivers.estimators.force.recursion import SpecimenRecursion
from microdrivers.estimators.force.vision_force import VisionForce
from microdrivers.estimators.vision.image_drift import ImageDrift
from microdrivers.routines.force.frames import all_frames, drift_of, in_contact_uN, record_of, without_drift
from microdrivers.routines.force.source import (
    DONE,
    SETTINGS,
    FrameTracker,
    IndentationSetup,
    IndentationSource,
    Rests,
    host_name,
)
from microdrivers.routines.notes import INTERRUPTED, note, noted_ending
from microdrivers.routines.past_run import PastRun
from microdrivers.routines.progress import Progress, SilentProgress


class Indentation(NamedTuple):
    """What one indentation left behind.

    Attributes:
        samples: deformation and force, one a matched frame. unmatched: frames without, by reason.
        frames: all frames in order of time, those without a deformation or a force flagged with the reason; the
            picture's drift is taken off.
        drift: of the picture; None if it is not known.
        felt_uN: how far single readings, between the frames, too, were off the usual force; 0 within their noise.
        deformations: one a frame. estimates: of the recursion. forces: read from the camera.
        arrivals: bus-wide order numbers in the order in which the estimators saw the samples. recorded: these samples,
            if asked for.
        began: whether the tool had set out. ended: whether it had come back, and rested.
        turned_at_uN: the limit of force that had turned it back; None if that did not, or it had not come back.
    """

    samples: list[IndentationSample]
    unmatched: Counter[str]
    frames: list[IndentationSample]
    drift: ImageDrift | None
    felt_uN: float
    deformations: list[DeformationSample]
    estimates: list[SpecimenEstimate]
    forces: list[VisionForceSample]
    arrivals: list[int]
    recorded: list[Sample]
    began: bool
    ended: bool
    turned_at_uN: float | None


class ForceRun(NamedTuple):
    """What a characterisation left behind; `check` is the fresh indentation, if there was one.

    `complete` is False if it ended early; `ended_by` says by what. `past_run` is what a recording tells of its run.
    """

    complete: bool
    ended_by: str
    first: Indentation
    record: IndentationRecord
    identification: Identification
    check: Indentation | None
    setup: IndentationSetup
    past_run: PastRun


class Characterisation:
    """Presses, identifies, and presses again with the sensor ignored.

    `first` and `check` hold what was measured even if `run` ends with an error, and `interrupted` tells whether it was
    by Ctrl-C. `tells_nothing` is why `partial` found no specimen in it. `on_host` is told the estimators' inbox of each
    indentation once it is there, for who records the order of arrival; `settings` say how to identify: None as the
    recorded run did, or as usual.
    """

    def __init__(
        self,
        source: IndentationSource,
        *,
        keep_samples: bool = False,
        on_host: Callable[[str, Inbox], object] = lambda _name, _inbox: None,
        settings: IdentificationSettings | None = None,
    ) -> None:
        self.first: Indentation | None = None
        self.check: Indentation | None = None
        self.interrupted = False
        self.tells_nothing = ""
        self._record: IndentationRecord | None = None
        self._identification: Identification | None = None
        self._source = source
        self._keep_samples = keep_samples
        self._on_host = on_host
        self._settings = settings or source.past_settings or IdentificationSettings()

    def run(self, progress: Progress | None = None, *, check: bool = True) -> ForceRun:
        """Run it; on any way out the tool is away from the specimen.

        An interruption (Ctrl-C) keeps what was measured.

        Raises:
            NoContact, IllConditioned and other DataError or CalibrationError: the record does not show or determine
                a specimen. MicrodriversError: whatever the source raises. See `partial` for what is left then.
        """
        note(self._source.bus, self._source.clock, SETTINGS, self._settings._asdict())
        try:
            with noted_ending(self._source.bus, self._source.clock, DONE, finish=self._source.finish) as ending:
                try:
                    self._experiment(progress or SilentProgress(), check=check)
                except KeyboardInterrupt:
                    self.interrupted = True
                    raise
        except KeyboardInterrupt:  # while the probe was taken away
            self.interrupted = True
            raise
        if self.first is None:
            raise NoContact("interrupted before anything was measured", remedy="start again")
        return self._found(ending.ended_by or self._source.past_run.ended_by)

    def partial(self, error: MicrodriversError | KeyboardInterrupt) -> ForceRun | None:
        """What had been measured before `run` ended with this error, identified; None if that tells nothing."""
        ended_by = error.what if isinstance(error, MicrodriversError) else INTERRUPTED
        if self.first is None or not self.first.frames:
            return None
        try:
            return self._found(ended_by)
        except NoContact:
            self.tells_nothing = f"no contact shows in its {len(self.first.frames)} frames"
        except (DataError, CalibrationError) as why:
            self.tells_nothing = why.what
        return None

    def _experiment(self, progress: Progress, *, check: bool) -> None:
        source = self._source
        tracker = source.prepare(progress)
        self._indent(tracker, None, progress)
        progress.step("identifying the specimen")
        found = self._found("").identification
        if check and source.repeatable:
            progress.step("a fresh indentation, with force from the camera alone")
            self._indent(tracker, after_slip(found), progress)

    def _found(self, ended_by: str) -> ForceRun:
        """What `first` says of the specimen."""
        assert self.first is not None
        if self._record is None or self._identification is None:
            self._record = record_of(self.first.frames)
            self._identification = self._identified(self._record, self.first.frames)
        source = self._source
        return ForceRun(
            not ended_by, ended_by, self.first, self._record, self._identification, self.check, source.setup(),
            source.past_run,
        )  # fmt: skip

    def _identified(self, record: IndentationRecord, frames: list[IndentationSample]) -> Identification:
        try:
            return identify(record, self._settings)
        except NoContact as error:
            felt_uN = in_contact_uN(frames)
            if not felt_uN:
                raise self._between_frames(frames) or error from error
            raise DataError(
                f"the force leaves its noise in only {len(felt_uN)} of {len(frames)} frames, by up to "
                f"{max(felt_uN):.4g} µN",
                remedy="press more slowly or deeper, so that more frames see the specimen pressed",
            ) from error

    def _between_frames(self, frames: list[IndentationSample]) -> DataError | None:
        """What to say where the sensor felt what no frame saw; None if it did not."""
        felt_uN = 0.0 if self.first is None else self.first.felt_uN
        if felt_uN == 0.0:
            return None
        return DataError(
            f"up to {felt_uN:.4g} µN was felt, but so briefly that none of the {len(frames)} frames shows the specimen "
            "pressed",
            remedy="press more slowly, so that frames see the specimen pressed",
        )

    def _indent(self, tracker: FrameTracker | None, model: SpecimenModel | None, progress: Progress) -> None:
        """One indentation: `first` or, with a model of the specimen, `check`; kept whatever ends it."""
        session = _Session(self._source, tracker, model, keep_samples=self._keep_samples, on_host=self._on_host)
        rests = None
        try:
            rests = self._source.indent(session.begin, progress)
        finally:
            indentation = session.end(rests)
            if model is None:
                self.first = indentation
            else:
                self.check = indentation


class _Session:
    """One indentation under way: its estimators, and what they have found.

    Args:
        source: presses, and has the bus.
        tracker: finds the deformation in frames; None if deformations come as samples.
        model: of the specimen, to read the force from the camera; None to estimate the specimen.
        keep_samples, on_host: as of `Characterisation`.
    """

    def __init__(
        self,
        source: IndentationSource,
        tracker: FrameTracker | None,
        model: SpecimenModel | None,
        *,
        keep_samples: bool,
        on_host: Callable[[str, Inbox], object],
    ) -> None:
        bus, names = source.bus, source.names
        self._clock = source.clock
        self._keep_samples = keep_samples
        self._on_host = on_host
        self._host_name = host_name(1 if model is None else 2)
        self._host: EstimatorHost | None = None
        self._estimator = IndentationEstimator(
            tracker,
            IndentationMatcher(),
            recursion=SpecimenRecursion() if model is None else None,
            vision_force=VisionForce(model) if model is not None else None,
        )
        deformations = bus.topic(names.deformation, DeformationSample)
        self._topics: dict[type[Sample], Topic[Any]] = {
            DeformationSample: deformations,
            IndentationSample: bus.topic("estimate/indentation", IndentationSample),
            SpecimenEstimate: bus.topic("estimate/specimen", SpecimenEstimate),
            VisionForceSample: bus.topic("estimate/force", VisionForceSample),
        }
        frames = bus.topic(names.camera, Frame) if names.camera is not None else deformations
        readings = bus.topic(names.sensor, ForceSample)
        self._inputs: tuple[Topic[Any], ...] = (readings, frames)
        self._found: list[Sample] = []
        self._felt: list[ForceSample] = []
        self._seen: list[DeformationSample] = []
        self._watches = (deformations.subscribe(self._seen.append), readings.subscribe(self._felt.append))

    def begin(self) -> None:
        """What follows belongs to the indentation."""
        self._host = EstimatorHost(
            self._clock, self._estimator, self._inputs, self._publish, keep_samples=self._keep_samples
        )
        self._on_host(self._host_name, self._host.inbox)

    def end(self, rests: Rests | None) -> Indentation:
        """No more samples come; `rests` are the tool's, if they are known."""
        if self._host is not None:
            self._host.close()
        for sample in self._estimator.finish():
            self._publish(sample)
        for watch in self._watches:
            watch.cancel()
        matched = [sample for sample in self._found if isinstance(sample, IndentationSample)]
        matcher, drift = self._estimator.matcher, drift_of(self._seen, matched, rests)
        return Indentation(
            samples=matched,
            unmatched=matcher.unmatched,
            frames=without_drift(all_frames(matched, self._seen, matcher.given_up), drift),
            drift=drift,
            felt_uN=max(in_contact_uN(self._felt), default=0.0),
            deformations=self._seen,
            estimates=[sample for sample in self._found if isinstance(sample, SpecimenEstimate)],
            forces=[sample for sample in self._found if isinstance(sample, VisionForceSample)],
            arrivals=[] if self._host is None else self._host.inbox.arrivals,
            recorded=[] if self._host is None else self._host.recorded,
            began=self._host is not None,
            ended=rests is not None,
            turned_at_uN=None if rests is None else rests.turned_at_uN,
        )

    def _publish(self, sample: Sample) -> None:
        self._found.append(sample)
        self._topics[type(sample)].publish(sample)


def after_slip(identification: Identification) -> SpecimenModel:
    """The best model for the next indentation: in the first one the specimen has slipped into its holder already."""
    model = identification.protocols[identification.best].model()
    pressed_s = identification.contact_duration_s
    gone_um = float(slipped_um(model, pressed_s))
    return model._replace(slip_um=model.slip_um - gone_um, contact_um=model.contact_um + gone_um)
