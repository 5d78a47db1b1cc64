"""`microdrivers calibrate optics`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from microdrivers.cli.exit_codes import EXIT_ERROR, EXIT_INTERRUPTED, EXIT_OK
from microdrivers.cli.options import FiniteRange, fields_given, given, refuse_options_given
from microdrivers.cli.output import describe_recorded, describe_rig, tell_flaws
from microdrivers.cli.rig_options import WIRE_LOG_HELP, RigChoice, saying_commands
from microdrivers.cli.run_output import RESULT, RecordingChoice, RunOutput, recording_options

if TYPE_CHECKING:
    from microdrivers.estimators.optics.calibrator import CalibratorSettings
    from microdrivers.routines.optics.source import OpticsSource

_SETTINGS = {"forgetting": "forgetting", "flush_frames": "flush_frames", "drift_um_s": "sigma_drift_um_s"}
"""Which field of the estimator's settings an option sets."""

OF_ANALYSIS = ("frames", *_SETTINGS)
"""Options of the analysis: they may be tried on old data too."""

REPLAY_HELP = "A run.mcap: the same estimator on what it recorded, set as in that run unless options say otherwise."


@click.command(short_help="Camera to stage, through a zoom change.")
@click.option("--rig", "rig_file", type=click.Path(path_type=Path), help="Rig file; default: the emulated workstation.")
@click.option("--fake", is_flag=True, help="Replace every connection of the rig file by its emulator.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Which simulated world to draw.")
@click.option("--world", type=click.Path(path_type=Path), help="World file of the simulation.")
@click.option("--images", type=click.Path(path_type=Path), help="Folder with frames.csv: a recorded image sequence.")
@click.option("--replay", type=click.Path(path_type=Path), help=REPLAY_HELP)
@recording_options
@click.option("--out", type=click.Path(path_type=Path), help="Where to write; default: runs/<time>-optics/.")
@click.option("--radius-um", type=float, help="Radius of the circle; default: up to 300, as large as fits the view.")
@click.option("--zoom-to", type=float, default=1.2, show_default=True, help="Zoom after the change.")
@click.option("--zoom-from", type=float, default=0.9, show_default=True, help="Zoom before the change.")
@click.option(
    "--frames",
    type=click.IntRange(min=10),
    default=100,
    show_default=True,
    help="Frames on the circle; of old data, the first.",
)
@click.option(
    "--forgetting", type=FiniteRange(0, 1, min_open=True), default=0.99, show_default=True,
    help="λ of the estimator while the zoom rests; 1 forgets nothing.",
)  # fmt: skip
@click.option(
    "--flush-frames", type=click.IntRange(min=2), default=3, show_default=True,
    help="Frames with λ = 0 once the zoom has come to rest.",
)  # fmt: skip
@click.option(
    "--drift-um-s", type=FiniteRange(min=0), default=0.005, show_default=True,
    help="How fast the sample may drift against the stage; widens the intervals.",
)  # fmt: skip
@click.option("--settled/--in-motion", default=None, help="Take frames at rest, or never; default: as times are known.")
@click.option("--real-time", is_flag=True, help="Run an emulated rig in real time instead of as fast as possible.")
@click.option("--wire-log", type=click.Path(path_type=Path), metavar="FILE", help=WIRE_LOG_HELP)
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON instead of a summary.")
def optics(
    rig_file: Path | None,
    fake: bool,
    seed: int,
    world: Path | None,
    images: Path | None,
    replay: Path | None,
    recording: RecordingChoice | None,
    out: Path | None,
    radius_um: float | None,
    zoom_to: float,
    zoom_from: float,
    frames: int,
    forgetting: float,
    flush_frames: int,
    drift_um_s: float,
    settled: bool | None,
    real_time: bool,
    wire_log: Path | None,
    as_json: bool,
) -> None:
    """Calibrate camera to stage on line while the zoom changes (Bilen et al., section III.B).

    A target on the sample stage moves on a circle; one of its points is tracked at frame rate and the projection
    matrix is estimated by recursive least squares, through a change of zoom. Writes result.json, calibration.yaml
    and report.html. On hardware the stage must have been referenced before: see `microdrivers reference`.

    \b
    Examples:
      microdrivers calibrate optics                          emulated workstation, world 0
      microdrivers calibrate optics --seed 7 --out runs/7    another world
      microdrivers calibrate optics --rig lab.yaml           hardware
      microdrivers calibrate optics --rig lab.yaml --fake    the same rig, emulated
      microdrivers calibrate optics --images recording/      a recorded sequence
      microdrivers calibrate optics --replay runs/7/run.mcap what a run has recorded, again
      microdrivers calibrate optics --replay runs/7/run.mcap --forgetting 0.95 --frames 80
    """
    from microdrivers.configs import shipped_rig
    from microdrivers.core.errors import ConfigError
    from microdrivers.estimators.optics.calibrator import CalibratorSettings

    if images is not None and replay is not None:
        raise ConfigError("--images and --replay exclude each other", remedy="leave out one of them")
    if images is not None or replay is not None:
        option = "--images" if images is not None else "--replay"
        refuse_options_given(
            f"{option} replaces the rig", allowed=("images", "replay", "out", "as_json"), of_analysis=OF_ANALYSIS
        )
    settings = CalibratorSettings(forgetting=forgetting, flush_frames=flush_frames, sigma_drift_um_s=drift_um_s)
    first = frames if given("frames") else None
    of_old_data = images is not None or replay is not None
    output = RunOutput("optics", out, as_json=as_json, recording=None if of_old_data else recording)
    try:
        if images is not None:
            status = _from_images(images, first, settings, output)
        elif replay is not None:
            status = _from_recording(replay, first, settings, output)
        else:
            circle = {
                "radius_um": radius_um,
                "zoom_from": zoom_from,
                "zoom_to": zoom_to,
                "frames": frames,
                "settled": settled,
            }
            choice = RigChoice(rig_file or shipped_rig(), fake or rig_file is None, seed, world, wire_log)
            status = _on_rig(choice, circle, settings, real_time, output)
    finally:
        output.close()
    if status == EXIT_INTERRUPTED:
        click.echo("interrupted: all axes were told to stop", err=True)
    if status:
        sys.exit(status)


def _from_images(folder: Path, frames: int | None, settings: CalibratorSettings, output: RunOutput) -> int:
    from microdrivers.recording.image_sequence import ImageSequence
    from microdrivers.routines.optics import SequencePlayback

    sequence = ImageSequence(folder)
    provenance = {"source": f"image sequence {folder}", "clock": "recorded"}
    return _run(SequencePlayback(sequence, frames=frames), settings, provenance, output)


def _from_recording(file: Path, frames: int | None, settings: CalibratorSettings, output: RunOutput) -> int:
    from microdrivers.recording.reader import Recording
    from microdrivers.routines.optics import OpticsReplay

    with Recording(file) as recording:
        tell_flaws(recording)
        source = OpticsReplay(recording, frames=frames)
        if source.past_settings is not None:
            settings = source.past_settings._replace(**fields_given(settings, _SETTINGS))
        return _run(source, settings, describe_recorded(recording), output)


def _on_rig(
    choice: RigChoice, circle: dict[str, Any], estimator: CalibratorSettings, real_time: bool, output: RunOutput
) -> int:
    from microdrivers.core.clock import SimulatedClock, SystemClock
    from microdrivers.rig import open_rig
    from microdrivers.routines.optics import CircleExperiment, CircleSettings

    file, fake, seed, world, wire_log, _ = choice
    clock = SimulatedClock() if fake and not real_time else SystemClock()
    with (
        saying_commands(file),
        open_rig(
            file, fake=fake, seed=seed or 0, clock=clock, world=world, devices="microscope", wire_log=wire_log
        ) as rig,
    ):
        settings = CircleSettings(**circle)
        provenance = describe_rig(rig, fake=fake, seed=seed, settings=settings._asdict())
        return _run(CircleExperiment(rig, settings), estimator, provenance, output)


def _run(source: OpticsSource, settings: CalibratorSettings, known: dict[str, Any], output: RunOutput) -> int:
    from microdrivers.core.errors import CalibrationError
    from microdrivers.report.optics_report import write_optics_report
    from microdrivers.report.summary import optics_summary
    from microdrivers.report.truth import OpticsTruthCollector
    from microdrivers.routines.optics import calibrate_optics
    from microdrivers.routines.optics.calibration import build_result

    truth = OpticsTruthCollector(source.bus)
    with output.recorded(source, known):
        run = calibrate_optics(source, settings=settings, progress=output.progress, on_host=output.follow)
    if not run.estimates and not run.complete:
        click.echo("nothing had been measured yet", err=True)
        return EXIT_INTERRUPTED
    known["settings"] = known.get("settings", {}) | run.settings._asdict() | {"frames": source.frames_expected()}
    try:
        result = build_result(run, output.provenance(known))
    except CalibrationError as error:
        if run.complete:
            raise
        click.echo(f"too little had been measured for a result: {error.what}", err=True)
        return EXIT_INTERRUPTED
    notes = [*result.notes, *output.recording_notes]
    result = result.model_copy(update={"truth": truth.compare(result, run.estimates), "notes": notes})
    output.progress.step("drawing the report")
    files: dict[str, Callable[[Path], object]] = {
        RESULT: result.write_json,
        "calibration.yaml": result.write_calibration,
        "report.html": partial(write_optics_report, result),
    }
    status = output.finish(result, partial(optics_summary, result), files, complete=run.complete)
    # A run that ended as planned, with a result that is not of its end; the result's notes say why.
    ended_as_planned = run.complete and (run.past_run.lost_last or not run.past_run.ended_by)
    return status or (EXIT_ERROR if ended_as_planned and not result.complete else EXIT_OK)
