"""A calibration over ports of the operating system: the emulators serve in another process, and threads bring samples.

Nothing here asserts how fast anything is; scripts/bench_wires measures that.
"""

import random
import subprocess
import sys
from contextlib import ExitStack
from typing import NamedTuple

import msgspec
import pytest

from microdrivers.configs import shipped_rig
from microdrivers.core.clock import SimulatedClock, SystemClock, utc_now
from microdrivers.core.samples import Frame, OpticsEstimate, XYThetaSample, ZoomSample
from microdrivers.devices.xytheta_stage import XYThetaStage
from microdrivers.estimators.optics import student_factor
from microdrivers.estimators.optics.calibrator import OpticsCalibrator
from microdrivers.recording.header import describe_recording
from microdrivers.recording.reader import Recording
from microdrivers.recording.recorder import Recorder
from microdrivers.results.optics import OpticsResult
from microdrivers.rig import open_rig
from microdrivers.routines.optics import CircleExperiment, CircleSettings, OpticsReplay, OpticsRun, calibrate_optics
from microdrivers.routines.optics.calibration import build_result
from microdrivers.routines.optics.targets import make_tracker
from microdrivers.routines.provenance import describe_run

# One after the other: they run in real time.
pytestmark = pytest.mark.ports

SEED = 3


class Calibration(NamedTuple):
    """What a run left behind, and how many frames it was to take."""

    run: OpticsRun
    result: OpticsResult
    frames: int | None


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """The usual world, with a short way to the reference switches."""
    file = tmp_path_factory.mktemp("world") / "world.yaml"
    file.write_text("stage: {power_on_spread_um: 30}\n")
    return file


@pytest.fixture(scope="module")
def served_rig(tmp_path_factory, world):
    """The workstation on ports, referenced; another process serves it."""
    file = tmp_path_factory.mktemp("served") / "served.yaml"
    command = [sys.executable, "-m", "microdrivers", "serve", str(shipped_rig("microscope")), "--world", str(world)]
    command += ["--seed", str(SEED), "--write", str(file), "--for", "300"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as serving:
        try:
            while not serving.stdout.readline().startswith("serving"):
                assert serving.poll() is None
            with open_rig(file) as rig:
                rig.device("sample_stage", XYThetaStage).reference(["x", "y", "theta"])
            yield file
        finally:
            serving.terminate()


def calibrated(file, clock, *, fake=False, world=None, recording=None, **settings):
    with open_rig(file, clock=clock, fake=fake, seed=SEED, world=world) as rig, ExitStack() as stack:
        source = CircleExperiment(rig, CircleSettings(**settings))
        recorder = None
        if recording is not None:
            header = describe_recording(source="fake")
            recorder = stack.enter_context(Recorder(recording, bus=rig.bus, clock=clock, header=header))

        def follow(host, inbox):
            if recorder is not None:
                recorder.follow_arrivals(host, inbox.arrivals)

        run = calibrate_optics(source, keep_samples=True, on_host=follow)
    known = {"source": "test", "clock": "simulated" if clock.simulated else "system", "rig_name": "workstation"}
    result = build_result(run, describe_run(known, command="test", now=utc_now()))
    return Calibration(run, result, source.frames_expected())


def bits(estimates):
    """All that an estimate says, NaN included; its place on the bus says nothing."""
    return [msgspec.msgpack.encode(msgspec.structs.replace(estimate, order=-1)) for estimate in estimates]


def replayed(calibration, samples):
    """Samples in any order, put in the order of the recorded inbox and fed to a new estimator."""
    first = calibration.run.estimates[0]
    tracker = make_tracker("square", near_px=(first.u_px, first.v_px))
    estimator = OpticsCalibrator(tracker, calibration.run.settings, frames=calibration.frames)
    by_order = {sample.order: sample for sample in samples}
    results = [result for order in calibration.run.arrivals for result in estimator.update(by_order[order])]
    return [result for result in results if isinstance(result, OpticsEstimate)]


def test_a_threaded_run_on_ports_replays_in_the_order_of_its_inbox_to_the_same_bits(served_rig, tmp_path):
    file = tmp_path / "run.mcap"
    calibration = calibrated(served_rig, SystemClock(), recording=file, settled=False, frames=40, change_after_frame=20)
    run = calibration.run
    assert run.complete
    assert [sample.order for sample in run.recorded] == run.arrivals
    assert {type(sample) for sample in run.recorded} == {XYThetaSample, ZoomSample, Frame}
    assert len(run.estimates) + run.lost_frames + run.unmatched_frames == 40
    assert len(run.estimates) > 25

    shuffled = random.Random(1).sample(run.recorded, len(run.recorded))
    assert bits(replayed(calibration, shuffled)) == bits(run.estimates)
    with Recording(file) as recording:
        again = calibrate_optics(OpticsReplay(recording))
    assert again.arrivals == run.arrivals
    assert bits(again.estimates) == bits(run.estimates)


def test_a_calibration_on_ports_agrees_with_one_in_process_of_the_same_world(served_rig, world):
    settings = {"frames": 15, "degrees_per_frame": 24.0, "zoom_to": 0.9}
    served = calibrated(served_rig, SystemClock(), **settings).result
    here = calibrated(shipped_rig("microscope"), SimulatedClock(), fake=True, world=world, **settings).result
    assert served.view == here.view
    assert apart(served, here, "scale_px_per_um", "scale_sigma_px_per_um") < 2.5
    assert apart(served, here, "angle_deg", "angle_sigma_deg") < 2.5


def apart(served, here, quantity, sigma):
    """Difference in units of the 95 % half-width of the difference that the two results state."""
    both = sum((student_factor(r.degrees_of_freedom) * getattr(r, sigma)) ** 2 for r in (served, here)) ** 0.5
    return abs(getattr(served, quantity) - getattr(here, quantity)) / both
