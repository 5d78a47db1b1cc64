"""The characterisation itself: the same for a live probe, a simulation and a recording."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from microdrivers.core.bus import Topic
from microdrivers.core.contact_samples import (
    DeformationSample,
    IndentationSample,
    SpecimenEstimate,
    VisionForceSample,
)
from microdrivers.core.errors import NoContact
from microdrivers.core.inbox import EstimatorHost, Inbox
from microdrivers.core.samples import ForceSample, Frame, Sample
from microdrivers.core.units import NS_PER_S
from microdrivers.estimators.force.identify import Identification, identify
from microdrivers.estimators.force.indenter import IndentationEstimator
from microdrivers.estimators.force.matcher import IndentationMatcher
from microdrivers.estimators.force.model import SpecimenModel, slipped_um
from microdrivers.estimators.force.record import IndentationRecord
from microdrivers.estimators.force.recursion import SpecimenRecursion
from microdrivers.estimators.force.vision_force import VisionForce
from microdrivers.routines.force.source import FrameTracker, IndentationSetup, IndentationSource, host_name
from microdrivers.routines.progress import Progress, SilentProgress


class Indentation(NamedTuple):
    """What one indentation left behind.

    Attributes:
        samples: deformation and force, one a matched frame. unmatched: frames without, by reason.
        deformations: one a frame. estimates: of the recursion. forces: read from the camera.
        arrivals: bus-wide order numbers in the order in which the estimators saw the samples. recorded: these samples,
            if asked for.
    """

    samples: list[IndentationSample]
    unmatched: Counter[str]
    deformations: list[DeformationSample]
    estimates: list[SpecimenEstimate]
    forces: list[VisionForceSample]
    arrivals: list[int]
    recorded: list[Sample]


class ForceRun(NamedTuple):
    """What a characterisation left behind; `check` is the fresh indentation, if there was one.

    `complete` is False if it was interrupted.
    """

    complete: bool
    first: Indentation
    record: IndentationRecord
    identification: Identification
    check: Indentation | None
    setup: IndentationSetup


class Characterisation:
    """Presses, identifies, and presses again with the sensor ignored.

    `first` and `check` hold what was measured even if `run` ends with an error. `on_host` is told the estimators' inbox
    of each indentation once it is there, for who records the order of arrival.
    """

    def __init__(
        self,
        source: IndentationSource,
        *,
        keep_samples: bool = False,
        on_host: Callable[[str, Inbox], object] = lambda _name, _inbox: None,
    ) -> None:
        self.first: Indentation | None = None
        self.check: Indentation | None = None
        self._source = source
        self._keep_samples = keep_samples
        self._on_host = on_host

    def run(self, progress: Progress | None = None, *, check: bool = True) -> ForceRun:
        """Run it; on any way out the tool is away from the specimen.

        An interruption (Ctrl-C) keeps what was measured.

        Raises:
            NoContact, IllConditioned and other DataError or CalibrationError: the record does not show or determine
                a specimen. MicrodriversError: whatever the source raises.
        """
        progress = progress or SilentProgress()
        source = self._source
        complete, identification, record = True, None, None
        try:
            tracker = source.prepare(progress)
            self.first = self._indent(tracker, None, progress)
            record = record_of(self.first.samples)
            progress.step("identifying the specimen")
            identification = identify(record)
            if check and source.repeatable:
                progress.step("a fresh indentation, with force from the camera alone")
                model = after_slip(identification)
                self.check = self._indent(tracker, model, progress)
        except KeyboardInterrupt:
            complete = False
        finally:
            source.finish()
        if self.first is None:
            raise NoContact("interrupted before anything was measured", remedy="start again")
        if record is None or identification is None:
            record = record_of(self.first.samples)
            identification = identify(record)
        return ForceRun(complete, self.first, record, identification, self.check, source.setup())

    def _indent(self, tracker: FrameTracker | None, model: SpecimenModel | None, progress: Progress) -> Indentation:
        """One indentation. An interruption during the first keeps it; see `run`."""
        source = self._source
        bus, names = source.bus, source.names
        estimator = IndentationEstimator(
            tracker,
            IndentationMatcher(),
            recursion=SpecimenRecursion() if model is None else None,
            vision_force=VisionForce(model) if model is not None else None,
        )
        found: list[Sample] = []
        deformations = bus.topic(names.deformation, DeformationSample)
        topics: dict[type[Sample], Topic[Any]] = {
            DeformationSample: deformations,
            IndentationSample: bus.topic("estimate/indentation", IndentationSample),
            SpecimenEstimate: bus.topic("estimate/specimen", SpecimenEstimate),
            VisionForceSample: bus.topic("estimate/force", VisionForceSample),
        }

        def publish(sample: Sample) -> None:
            found.append(sample)
            topics[type(sample)].publish(sample)

        seen = bus.topic(names.camera, Frame) if names.camera is not None else deformations
        hosts: list[EstimatorHost] = []

        def begin() -> None:
            hosts.append(
                EstimatorHost(
                    source.clock,
                    estimator,
                    (bus.topic(names.sensor, ForceSample), seen),
                    publish,
                    keep_samples=self._keep_samples,
                )
            )
            self._on_host(host_name(1 if model is None else 2), hosts[-1].inbox)

        try:
            source.indent(begin, progress)
        finally:
            for host in hosts:
                host.close()
            indentation = Indentation(
                samples=[s for s in found if isinstance(s, IndentationSample)],
                unmatched=estimator.matcher.unmatched,
                deformations=[s for s in found if isinstance(s, DeformationSample)],
                estimates=[s for s in found if isinstance(s, SpecimenEstimate)],
                forces=[s for s in found if isinstance(s, VisionForceSample)],
                arrivals=[order for host in hosts for order in host.inbox.arrivals],
                recorded=[sample for host in hosts for sample in host.recorded],
            )
            if model is None:
                self.first = indentation
            else:
                self.check = indentation
        return indentation


def record_of(samples: Sequence[IndentationSample]) -> IndentationRecord:
    """Matched samples as arrays; their noise is the median of what they state, NaN where they state none."""
    start_ns = samples[0].t_ns if samples else 0
    return IndentationRecord(
        time_s=np.array([(sample.t_ns - start_ns) / NS_PER_S for sample in samples]),
        deformation_um=np.array([sample.deformation_um for sample in samples]),
        force_uN=np.array([sample.force_uN for sample in samples]),
        deformation_sigma_um=_median([sample.deformation_sigma_um for sample in samples]),
        force_sigma_uN=_median([sample.force_sigma_uN for sample in samples]),
    )


def after_slip(identification: Identification) -> SpecimenModel:
    """The best model for the next indentation: in the first one the specimen has slipped into its holder already."""
    model = identification.protocols[identification.best].model()
    pressed_s = identification.contact_duration_s
    gone_um = float(slipped_um(model, pressed_s))
    return model._replace(slip_um=model.slip_um - gone_um, contact_um=model.contact_um + gone_um)


def _median(values: Sequence[float]) -> float:
    known = [value for value in values if value > 0.0]
    return float(np.median(known)) if known else float("nan")
