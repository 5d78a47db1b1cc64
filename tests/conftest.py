"""The same examples in every run: what a random search finds belongs into a test of its own. And strictness in CI."""

import gc
import os
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("deterministic", derandomize=True, deadline=None)
settings.load_profile("deterministic")

NO_SKIPS = bool({"MICRODRIVERS_NO_SKIPS", "VCAN_RUN"} & os.environ.keys())
"""Whether a test that is skipped has failed: in `.ci/run`, and in a guest, where all is there that tests need."""


_STEPS_BACK = 5
"""Of a process' priority, in which 0 is usual and 19 the least."""


def _refuse_skip(report):
    if NO_SKIPS and report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[-1] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome = "failed"
        report.longrepr = f"{report.nodeid} may not be skipped here (MICRODRIVERS_NO_SKIPS). {reason}"
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    return _refuse_skip((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """A whole module can be skipped as it is imported."""
    return _refuse_skip((yield))


_stepped_back = False


def pytest_runtest_setup(item):
    """Tests in real time begin first and sleep a lot; whoever uses the processor meanwhile must not make them late."""
    global _stepped_back
    if "PYTEST_XDIST_WORKER" in os.environ and not _stepped_back and not item.nodeid.endswith("@real_time"):
        _stepped_back = True
        os.nice(_STEPS_BACK)


def pytest_collection_finish(session):
    """What was imported stays; to look through it again and again for garbage costs a twentieth of the time."""
    gc.freeze()
    gc.set_threshold(5_000)


@pytest.fixture(scope="session")
def optics_recording(tmp_path_factory):
    """A recorded optical calibration of 30 small frames, as `calibrate optics` leaves one."""
    from microdrivers.core.bus import Bus
    from microdrivers.core.clock import SimulatedClock
    from microdrivers.core.samples import Frame
    from microdrivers.recording.header import RecordingHeader
    from microdrivers.recording.image_sequence import ImageSequence
    from microdrivers.recording.recorder import Recorder
    from microdrivers.routines.notes import note
    from microdrivers.routines.optics.source import BEGIN, DONE

    bus, clock = Bus(), SimulatedClock()
    known = {
        "names": {"stage": "stage", "zoom": "zoom", "camera": "camera"}, "target": "texture",
        "near_px": (0.0, 0.0), "first_frame": 0, "frames_expected": 29,
        "optics": {
            "camera": "camera", "binning": 1, "roi": (0, 0, 320, 240), "objective": None, "pixel_pitch_um": None
        },
    }  # fmt: skip
    folder = tmp_path_factory.mktemp("optics")
    header = RecordingHeader(source="recorded", rig="table", seed=4, created_utc="2026-01-01")
    with Recorder(folder / "run.mcap", bus=bus, clock=clock, header=header):
        bus.topic("camera", Frame).subscribe(lambda frame: frame.seq or note(bus, clock, BEGIN, known))
        sequence = ImageSequence(Path(__file__).parent / "data" / "micrograph_sequence")
        sequence.publish(bus, stage="stage", zoom="zoom", camera="camera")
        note(bus, clock, DONE, {"ended_by": ""})
    return folder / "run.mcap"


@pytest.fixture(scope="session")
def force_recording(tmp_path_factory):
    """A recorded force characterisation without frames."""
    from microdrivers.core.clock import SimulatedClock
    from microdrivers.recording.header import RecordingHeader
    from microdrivers.recording.indentation_table import IndentationTable
    from microdrivers.recording.recorder import Recorder
    from microdrivers.routines.force import IndentationPlayback
    from microdrivers.routines.force.source import BEGIN, DONE, END, READY, SETTINGS
    from microdrivers.routines.notes import note
    from microdrivers.routines.progress import SilentProgress

    clock = SimulatedClock()
    table = IndentationTable(Path(__file__).parent / "data" / "force" / "chiaro_aebp1_30hz.csv")
    source = IndentationPlayback(table)
    folder = tmp_path_factory.mktemp("force")
    known = {"names": source.names._asdict(), "setup": source.setup()._asdict()}
    with Recorder(folder / "run.mcap", bus=source.bus, clock=clock, header=RecordingHeader(source="recorded")):
        note(source.bus, clock, SETTINGS, {"around_reversal": 3, "protocol": None})
        note(source.bus, clock, READY, known)
        note(source.bus, clock, BEGIN, {})
        source.indent(lambda: None, SilentProgress())
        note(source.bus, clock, END, {})
        note(source.bus, clock, DONE, {"ended_by": ""})
    return folder / "run.mcap"
