"""What a routine has recorded gives the same bits again, and says what is missing."""

import msgspec
import pytest

from microdrivers.configs import shipped_rig
from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock, utc_now
from microdrivers.core.errors import ConfigError, UnsupportedError
from microdrivers.core.samples import Frame, XYThetaSample, ZoomSample
from microdrivers.estimators.force.identify import IdentificationSettings
from microdrivers.estimators.optics.calibrator import CalibratorSettings
from microdrivers.recording.header import describe_recording
from microdrivers.recording.reader import Recording
from microdrivers.recording.recorder import Recorder
from microdrivers.recording.replay import Replay
from microdrivers.rig import open_rig
from microdrivers.routines.analysis import analyse_recording
from microdrivers.routines.force import (
    Characterisation,
    IndentationReplay,
    PressExperiment,
    build_result,
)
from microdrivers.routines.force.source import READY
from microdrivers.routines.notes import note
from microdrivers.routines.optics import CircleExperiment, CircleSettings, OpticsReplay, calibrate_optics
from microdrivers.routines.optics.calibration import build_result as build_optics_result
from microdrivers.routines.progress import SilentProgress
from microdrivers.routines.provenance import describe_run
from tests.routines.small_rig import SHORT, small_rig


def bits(estimates):
    return [msgspec.msgpack.encode(msgspec.structs.replace(estimate, order=-1)) for estimate in estimates]


def recorder_of(file, rig, **options):
    return Recorder(file, bus=rig.bus, clock=rig.clock, header=describe_recording(source="fake", seed=2), **options)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A simulated calibration through a zoom change, and its recording."""
    file = tmp_path_factory.mktemp("recorded") / "run.mcap"
    with (
        open_rig(shipped_rig("microscope"), fake=True, seed=2, clock=SimulatedClock()) as rig,
        recorder_of(file, rig) as recorder,
    ):
        source = CircleExperiment(rig, CircleSettings(frames=60, change_after_frame=30))
        settings = CalibratorSettings(forgetting=0.97, flush_frames=4, sigma_drift_um_s=0.02)
        run = calibrate_optics(
            source, settings=settings, on_host=lambda host, inbox: recorder.follow_arrivals(host, inbox.arrivals)
        )
    return run, file


def test_a_recorded_calibration_gives_the_same_bits(calibrated):
    run, file = calibrated
    with Recording(file) as recording:
        again = calibrate_optics(OpticsReplay(recording))
    assert again.settings == run.settings
    assert bits(again.estimates) == bits(run.estimates)
    assert again.arrivals == run.arrivals
    assert again.optics == run.optics


def test_the_first_frames_of_a_recorded_calibration_know_nothing_of_what_follows(calibrated):
    run, file = calibrated
    provenance = describe_run({"source": "test", "clock": "recorded"}, command="test", now=utc_now())
    with Recording(file) as recording:
        again = calibrate_optics(OpticsReplay(recording, frames=28))
        with pytest.raises(ConfigError, match="60 frames of the experiment, not 61"):
            OpticsReplay(recording, frames=61)
    assert bits(again.estimates) == bits(run.estimates[:28])
    result = build_optics_result(again, provenance)
    assert (result.complete, result.frames, result.zoom_change, result.notes) == (True, 28, None, [])


@pytest.mark.parametrize("frames", [32, 33])
def test_a_run_that_ends_in_a_change_of_zoom_says_so_once(calibrated, frames):
    provenance = describe_run({"source": "test", "clock": "recorded"}, command="test", now=utc_now())
    with Recording(calibrated[1]) as recording:
        result = build_optics_result(calibrate_optics(OpticsReplay(recording, frames=frames)), provenance)
    assert len(result.notes) == 1
    assert "this is the calibration at zoom 0.8999" in result.notes[0]
    assert "Texture" not in result.notes[0]


def damaged(file, copy, is_it):
    """A copy of which the chunks are damaged that hold such samples of these topics."""
    data = bytearray(file.read_bytes())
    with Recording(file) as recording:
        read = recording._read_messages

        def look(place, chunk, *arguments):
            found = read(place, chunk, *arguments)
            if any(is_it(sample) for _, sample in found):
                data[place.offset + place.length - 1] ^= 1
            return found

        recording._read_messages = look
        for _ in recording.samples():
            pass
    copy.write_bytes(data)
    return copy


@pytest.mark.parametrize(("numbers", "used"), [((3,), 59), ((59,), 59), ((40, 41), 58), ((60,), 60)])
def test_frames_that_a_recording_lacks_are_lost_and_no_later_one_takes_their_place(calibrated, tmp_path, numbers, used):
    run, file = calibrated
    with Recording(file) as recording:
        frames = [sample for _, sample in recording.samples(["camera_fine"]) if sample.order in set(run.arrivals)]
    lost = [frames[number].order for number in numbers]
    copy = damaged(file, tmp_path / "run.mcap", lambda sample: sample.order in lost)
    provenance = describe_run({"source": "test", "clock": "recorded"}, command="test", now=utc_now())
    with Recording(copy) as recording:
        again = calibrate_optics(OpticsReplay(recording))
        result = build_optics_result(again, provenance)
    assert [each.t_ns for each in again.estimates] == [
        each.t_ns for index, each in enumerate(run.estimates) if index not in numbers
    ]
    assert (result.frames, result.lost_frames) == (used, 60 - used)
    samples = "1 sample" if len(numbers) == 1 else "2 samples"
    told = f"The result is from a recording with a flaw: it lacks {samples} that the estimators had"
    assert result.notes[0].startswith(told)
    assert (f"among them {60 - used} frame" in result.notes[0]) == (used < 60)


def without(file, copy, is_it):
    """A recording that is whole by all that it says, and lacks such samples."""
    bus, clock = Bus(), SimulatedClock()
    with (
        Recording(file) as recording,
        Recorder(copy, bus=bus, clock=clock, header=describe_recording(source="fake")) as recorder,
    ):
        for host, orders in recording.arrivals.items():
            recorder.follow_arrivals(host, orders)
        for topic, sample in recording.samples(leave_out=("truth/*",)):
            if not is_it(sample):
                bus.topic(topic, type(sample)).publish(sample)
    return copy


def test_a_calibration_of_which_all_is_there_is_analysed_as_it_was_set_and_not_doubted(calibrated):
    run, file = calibrated
    provenance = describe_run({"source": "test", "clock": "recorded"}, command="test", now=utc_now())
    live, row = build_optics_result(run, provenance), analyse_recording(str(file))
    figures = ("scale_px_per_um", "scale_sigma_px_per_um", "angle_deg", "angle_sigma_deg", "zoom", "frames")
    assert [row[name] for name in figures] == [getattr(live, name) for name in figures]
    counts = ("losses", "missing", "dropped", "repeated", "unsorted", "lost_frames")
    assert [row[name] for name in ("doubtful", "complete", *counts)] == [False, True, *[0] * len(counts)]


def test_a_calibration_that_lacks_its_last_frames_is_doubtful(calibrated, tmp_path):
    run, file = calibrated
    last_ns = run.estimates[24].t_ns
    copy = without(file, tmp_path / "run.mcap", lambda sample: isinstance(sample, Frame) and sample.t_ns > last_ns)
    row = analyse_recording(str(copy))
    figures = ("doubtful", "complete", "frames", "lost_frames", "losses")
    assert [row[name] for name in figures] == [True, False, 25, 35, 0]
    assert row["missing"] >= 35
    assert "The recorded run is not whole: the recording lacks its last 35 frames." in row["notes"]
    assert "35 frames of the experiment" in row["notes"]
    assert "The zoom changed to 1.2, where no frame could be used: this is the calibration at zoom 0.8" in row["notes"]


def test_a_calibration_at_another_zoom_than_the_recorded_run_had_is_not_complete(calibrated, tmp_path):
    run, file = calibrated
    first_ns, last_ns = run.estimates[24].t_ns, run.estimates[-2].t_ns
    copy = without(file, tmp_path / "run.mcap", lambda s: isinstance(s, Frame) and first_ns < s.t_ns <= last_ns)
    row = analyse_recording(str(copy))
    assert [row[name] for name in ("doubtful", "complete", "losses")] == [True, False, 0]
    assert (row["missing"], row["frames"] + row["lost_frames"]) == (34, 60)
    assert "this is the calibration at zoom 0.8999" in row["notes"]


def test_frames_after_the_last_zoom_reading_cannot_be_used_and_the_result_says_so(calibrated, tmp_path):
    run, file = calibrated
    last_ns = run.estimates[24].t_ns
    copy = without(file, tmp_path / "run.mcap", lambda s: isinstance(s, ZoomSample) and s.t_ns > last_ns + 20_000_000)
    row = analyse_recording(str(copy))
    assert [row[name] for name in ("doubtful", "complete", "frames", "unmatched_frames")] == [True, False, 25, 35]
    assert "No pose or no zoom reading came after the last 35 frames of the run" in row["notes"]


def test_poses_that_a_recording_lacks_make_its_figures_doubtful(calibrated, tmp_path):
    run, file = calibrated
    first_ns = run.estimates[40].t_ns
    copy = without(
        file, tmp_path / "run.mcap", lambda s: isinstance(s, XYThetaSample) and 0 < s.t_ns - first_ns < 200_000_000
    )
    row = analyse_recording(str(copy))
    assert [row[name] for name in ("doubtful", "complete", "losses", "dropped")] == [True, True, 0, 0]
    assert row["missing"] > 10
    assert f"it lacks {row['missing']} samples that the estimators had" in row["notes"]
    assert f"missing: {row['missing']} samples of 'sample_stage', whose numbers are skipped" in row["notes"]


def test_a_calibration_whose_end_is_not_recorded_is_not_complete(calibrated, tmp_path):
    copy = without(calibrated[1], tmp_path / "run.mcap", lambda sample: getattr(sample, "kind", "") == "optics/done")
    row = analyse_recording(str(copy))
    assert [row[name] for name in ("doubtful", "complete", "frames", "missing")] == [True, False, 60, 0]
    assert "The recorded run is not whole: the recording does not hold its end." in row["notes"]


def test_a_calibration_whose_beginning_is_damaged_is_called_so(calibrated, tmp_path):
    for named in ("optics/begin", "optics/"):
        copy = damaged(calibrated[1], tmp_path / "run.mcap", lambda s, n=named: getattr(s, "kind", "").startswith(n))
        with Recording(copy) as recording, pytest.raises(UnsupportedError, match="note of its beginning is in what is"):
            OpticsReplay(recording)
        assert "note of its beginning is in what is" in analyse_recording(str(copy))["error"]


def test_an_interrupted_calibration_stays_one_when_it_is_replayed(tmp_path):
    class Interrupting(SilentProgress):
        def count(self, done, total):
            if done >= 30:
                raise KeyboardInterrupt

    provenance = describe_run({"source": "test", "clock": "recorded"}, command="test", now=utc_now())
    with (
        open_rig(shipped_rig("microscope"), fake=True, seed=2, clock=SimulatedClock()) as rig,
        recorder_of(tmp_path / "run.mcap", rig) as recorder,
    ):
        source = CircleExperiment(rig, CircleSettings(frames=60, zoom_to=0.9))
        calibrate_optics(
            source, progress=Interrupting(), on_host=lambda host, inbox: recorder.follow_arrivals(host, inbox.arrivals)
        )
    with Recording(tmp_path / "run.mcap") as recording:
        assert recording.complete
        result = build_optics_result(calibrate_optics(OpticsReplay(recording)), provenance)
    assert not result.complete
    assert result.notes[0].startswith("The recorded run is not whole: it was interrupted.")


def test_the_estimator_sees_what_it_saw(calibrated):
    run, file = calibrated
    with Recording(file) as recording:
        assert list(recording.arrivals["optics"]) == run.arrivals
        again = calibrate_optics(OpticsReplay(recording), keep_samples=True)
    assert [sample.order for sample in again.recorded] == run.arrivals


def test_the_order_of_arrival_is_known_without_reading_frames(calibrated, monkeypatch):
    run, file = calibrated
    with Recording(file) as recording:
        sizes = []
        read = recording._scan.read_chunk
        monkeypatch.setattr(recording._scan, "read_chunk", lambda place: sizes.append(place.length) or read(place))
        assert list(recording.arrivals["optics"]) == run.arrivals
    assert 0 < max(sizes) < 100_000 < 640 * 480


def test_a_recording_without_a_calibration_is_refused(tmp_path):
    clock, bus = SimulatedClock(), Bus()
    with Recorder(tmp_path / "a.mcap", bus=bus, clock=clock, header=describe_recording(source="fake")):
        bus.topic("stage", XYThetaSample)
    for source in (OpticsReplay, IndentationReplay):
        with Recording(tmp_path / "a.mcap") as recording, pytest.raises(UnsupportedError, match="holds no"):
            source(recording)


def test_a_run_that_was_interrupted_before_it_measured_is_called_so(tmp_path):
    clock, bus = SimulatedClock(), Bus()
    with Recorder(tmp_path / "a.mcap", bus=bus, clock=clock, header=describe_recording(source="fake")):
        for kind in ("optics/done", "force/done"):
            note(bus, clock, kind, {"ended_by": "it was interrupted"})
    for source in (OpticsReplay, IndentationReplay):
        with Recording(tmp_path / "a.mcap") as recording, pytest.raises(UnsupportedError, match="it was interrupted"):
            source(recording)


def test_a_recording_that_lacks_the_frames_says_so(tmp_path):
    file = tmp_path / "run.mcap"
    with (
        open_rig(shipped_rig("microscope"), fake=True, seed=2, clock=SimulatedClock()) as rig,
        recorder_of(file, rig, topics=("routine", "sample_stage", "zoom")),
    ):
        calibrate_optics(CircleExperiment(rig, CircleSettings(frames=10, zoom_to=0.9)))
    with Recording(file) as recording, pytest.raises(UnsupportedError, match="lacks the frame"):
        calibrate_optics(OpticsReplay(recording))


def poses(file, orders, *, arrivals=()):
    """A recording of poses with these orders, in this order of the file."""
    clock, bus = SimulatedClock(), Bus()
    with Recorder(file, bus=bus, clock=clock, header=describe_recording(source="fake")) as recorder:
        for order in orders:
            bus.topic("stage", XYThetaSample).publish(
                XYThetaSample(
                    t_ns=1000 * order, device="stage", order=order, x_um=float(order), y_um=0.0, theta_deg=0.0,
                    moving=False, on_target=True, referenced=True,
                )
            )  # fmt: skip
        recorder.follow_arrivals("host", arrivals)
    return Recording(file)


def published(recording, play):
    bus, seen = Bus(), []
    bus.topic("stage", XYThetaSample).subscribe(lambda sample: seen.append(sample.order))
    replay = Replay(recording, bus)
    play(replay)
    return seen, replay


def test_samples_come_in_the_order_of_the_bus(tmp_path):
    seen, _ = published(poses(tmp_path / "a.mcap", [0, 2, 1, 4, 3, 5]), lambda replay: replay.up_to(None))
    assert seen == [0, 1, 2, 3, 4, 5]


def test_those_of_an_inbox_come_as_they_arrived_there(tmp_path):
    recording = poses(tmp_path / "a.mcap", range(8), arrivals=[1, 4, 2, 6])

    def play(replay):
        replay.up_to(1)
        replay.as_arrived("host", ("stage",), 7)

    seen, replay = published(recording, play)
    assert [order for order in seen if order in (1, 4, 2, 6)] == [1, 4, 2, 6]
    assert sorted(seen) == [0, 1, 2, 3, 4, 5, 6]
    assert replay.missing == 0


def test_what_an_inbox_had_and_the_file_has_not_is_counted(tmp_path):
    recording = poses(tmp_path / "a.mcap", [0, 1, 3, 4], arrivals=[0, 1, 2, 3])
    seen, replay = published(recording, lambda replay: replay.as_arrived("host", ("stage",), None))
    assert seen == [0, 1, 3]
    assert replay.missing == 1


def test_what_came_before_an_inbox_listened_and_after_it_was_closed_is_not_for_it(tmp_path):
    recording = poses(tmp_path / "a.mcap", range(8), arrivals=[3, 4, 5])

    def play(replay):
        replay.up_to(1)
        replay.as_arrived("host", ("stage",), 5)  # a note came before the inbox was closed

    seen, replay = published(recording, play)
    assert seen == [0, 3, 4, 5]
    replay.up_to(None)
    assert seen == [0, 3, 4, 5, 6, 7]


def test_where_a_recording_was_cut_off_the_order_of_the_bus_will_do(tmp_path):
    recording = poses(tmp_path / "a.mcap", range(8), arrivals=[1, 2])
    recording.complete = False
    seen, _ = published(recording, lambda replay: replay.as_arrived("host", ("stage",), 7))
    assert seen == [1, 2, 3, 4, 5, 6]


def test_the_pace_is_that_of_the_times(tmp_path):
    recording = poses(tmp_path / "a.mcap", [0, 1_000_000, 3_000_000])
    clock, bus = SimulatedClock(), Bus()
    times = []
    bus.topic("stage", XYThetaSample).subscribe(lambda _sample: times.append(clock.now_ns()))
    Replay(recording, bus, clock=clock, speed=2.0).up_to(None)
    assert [t - times[0] for t in times] == [0, 500_000_000, 1_500_000_000]


@pytest.fixture(scope="module")
def indented(tmp_path_factory):
    """A short simulated characterisation with a fresh indentation, and its recording."""
    file = tmp_path_factory.mktemp("recorded") / "run.mcap"
    rig_file = small_rig(tmp_path_factory.mktemp("rig"))
    overrides = {"specimen": {"preset": "slip_corrected"}}
    with (
        open_rig(
            rig_file, fake=True, seed=2, clock=SimulatedClock(), devices="probe", world_overrides=overrides
        ) as rig,
        recorder_of(file, rig) as recorder,
    ):
        source = PressExperiment(rig, SHORT)
        characterisation = Characterisation(
            source,
            on_host=lambda host, inbox: recorder.follow_arrivals(host, inbox.arrivals),
            settings=IdentificationSettings(around_reversal=3),
        )
        run = characterisation.run()
    return run, file


@pytest.mark.xdist_group("recorded_press")
def test_a_recorded_characterisation_gives_the_same_bits(indented):
    run, file = indented
    with Recording(file) as recording:
        again = Characterisation(IndentationReplay(recording)).run()
    for before, after in ((run.first, again.first), (run.check, again.check)):
        assert bits(after.samples) == bits(before.samples)
        assert bits(after.deformations) == bits(before.deformations)
        assert bits(after.estimates) == bits(before.estimates)
        assert bits(after.forces) == bits(before.forces)
        assert after.arrivals == before.arrivals
    provenance = describe_run({"source": "test", "clock": "recorded"}, command="test", now=utc_now())
    live, row = build_result(run, provenance), analyse_recording(str(file))
    assert build_result(again, provenance) == live
    assert (row["protocol"], row["k1_uN_per_um"]) == (live.best, live.protocols[live.best].k1_uN_per_um)
    assert [row[name] for name in ("error", "doubtful", "complete", "missing")] == [None, False, True, 0]


@pytest.mark.xdist_group("recorded_press")
def test_the_experiment_notes_what_its_replay_needs(indented):
    _, file = indented
    with Recording(file) as recording:
        kinds = [sample.kind for _, sample in recording.samples(("routine",))]
        frames = sum(isinstance(sample, Frame) for _, sample in recording.samples(("camera_fine",)))
    assert kinds == ["force/settings", READY, "force/begin", "force/end", "force/begin", "force/end", "force/done"]
    assert frames > 100


@pytest.mark.xdist_group("recorded_press")
def test_the_specimen_was_identified(indented):
    run, _ = indented
    fit = run.identification.protocols["slip_corrected"]
    assert fit.k1_uN_per_um == pytest.approx(5.8781, rel=0.05)
    assert run.setup.scale_px_per_um is not None
