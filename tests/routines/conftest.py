"""An emulated calibration that tests may interfere with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest

from microdrivers.configs import shipped_rig
from microdrivers.core.clock import SimulatedClock, utc_now
from microdrivers.core.contact_samples import SpecimenEstimate, VisionForceSample
from microdrivers.report.truth import OpticsTruthCollector
from microdrivers.results.optics import OpticsResult
from microdrivers.rig import Rig, build_rig
from microdrivers.routines.force import Characterisation
from microdrivers.routines.optics import CircleExperiment, CircleSettings, OpticsRun, calibrate_optics
from microdrivers.routines.optics.calibration import build_result
from microdrivers.routines.provenance import describe_run
from tests.routines.indentation_source import MadeUpSource, result_of


@dataclass
class Calibration:
    """What one run left behind."""

    run: OpticsRun
    result: OpticsResult
    rig: Rig
    truth: Any
    judge: Callable[[OpticsRun], tuple[OpticsResult, Any]]
    """The result of a run, or of a part of it, and the truth of that."""


@pytest.fixture(scope="session")
def calibrate():
    """Run a calibration on the emulated workstation, some of whose drivers may be replaced."""

    def call(
        *,
        seed: int = 11,
        drivers: dict[str, type[Any]] | None = None,
        world: Any = None,
        prepare: Callable[[Rig], None] = lambda rig: None,
        keep_samples: bool = False,
        progress: Any = None,
        **settings: Any,
    ) -> Calibration:
        rig = build_rig(shipped_rig("microscope"), fake=True, seed=seed, clock=SimulatedClock(), world=world)
        assert rig.simulation is not None
        for name, driver in (drivers or {}).items():
            own = rig.simulation.settings_of(name)
            rig.devices[name] = driver(name, own, clock=rig.clock, bus=rig.bus)
        prepare(rig)
        with rig:
            source = CircleExperiment(rig, CircleSettings(**settings))
            collector = OpticsTruthCollector(source.bus)
            run = calibrate_optics(source, keep_samples=keep_samples, progress=progress)

        def judge(run: OpticsRun) -> tuple[OpticsResult, Any]:
            known = {"source": "test", "clock": "simulated", "rig_name": "workstation"}
            result = build_result(run, describe_run(known, command="test", now=utc_now()))
            return result, collector.compare(result, run.estimates)

        result, truth = judge(run)
        return Calibration(run, result, rig, truth, judge)

    return call


@pytest.fixture(scope="session")
def characterised():
    """A characterisation of a made-up specimen: source, run, result, and what was published on the way."""
    source = MadeUpSource()
    published: dict[str, list[Any]] = {"specimen": [], "force": []}
    source.bus.topic("estimate/specimen", SpecimenEstimate).subscribe(published["specimen"].append)
    source.bus.topic("estimate/force", VisionForceSample).subscribe(published["force"].append)
    run = Characterisation(source, keep_samples=True).run()
    return source, run, result_of(run), published
