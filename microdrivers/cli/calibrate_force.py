"""`microdrivers calibrate force`."""

from __future__ import annotations

import contextlib
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from microdrivers.cli.options import fields_given, given, refuse_options_given
from microdrivers.cli.output import describe_recorded, describe_rig, tell_flaws, write_results
from microdrivers.cli.rig_options import WIRE_LOG_HELP, RigChoice, saying_commands
from microdrivers.cli.run_output import RECORDING, RESULT, RecordingChoice, RunOutput, recording_options
from microdrivers.core.protocol_names import MOST_AROUND_REVERSAL, PROTOCOLS

if TYPE_CHECKING:
    from microdrivers.core.errors import MicrodriversError
    from microdrivers.core.protocol_names import ProtocolName
    from microdrivers.estimators.force.identify import IdentificationSettings
    from microdrivers.report.force_truth import ContactTruthCollector
    from microdrivers.results.force import ForceResult
    from microdrivers.routines.force import Characterisation, ForceRun, IndentationSource

RECORD = "record.csv"
_SETTINGS = {"leave_out": "around_reversal", "protocol": "protocol"}
"""Which field of the identification's settings an option sets."""

OF_ANALYSIS = tuple(_SETTINGS)
"""Options of the analysis: they may be tried on old data too."""

REPLAY_HELP = "A run.mcap: the same estimators on what it recorded, set as in that run unless options say otherwise."
_QUESTION = "Is the specimen held, the probe aligned with it, and nothing else in its way?"


@click.command(short_help="A specimen's springs and damper; then force from the camera.")
@click.option("--rig", "rig_file", type=click.Path(path_type=Path), help="Rig file; default: the emulated workstation.")
@click.option("--fake", is_flag=True, help="Replace every connection of the rig file by its emulator.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Which simulated world to draw.")
@click.option("--world", type=click.Path(path_type=Path), help="World file of the simulation.")
@click.option("--specimen", metavar="NAME", help="Preset of an emulated specimen; on hardware, a name for the result.")
@click.option("--csv", "table", type=click.Path(path_type=Path), help="A recorded indentation instead of a rig.")
@click.option("--replay", type=click.Path(path_type=Path), help=REPLAY_HELP)
@recording_options
@click.option("--calibration", type=click.Path(path_type=Path), help="result.json of `calibrate optics` for µm.")
@click.option("--depth-um", type=float, default=110.0, show_default=True, help="How far to press, 5 to 1000.")
@click.option("--max-force-uN", "max_force_uN", type=float, help="Where to turn back; default: 80 % of the limit.")
@click.option("--speed-um-s", type=float, default=5.0, show_default=True, help="Of the probe, in and out, 0.1 to 100.")
@click.option("--hold-s", type=click.FloatRange(min=0.0), default=0.0, show_default=True, help="Wait when deepest.")
@click.option("--check/--no-check", default=True, show_default=True, help="Press again, force from the camera alone.")
@click.option(
    "--leave-out", type=click.IntRange(0, MOST_AROUND_REVERSAL), default=2, show_default=True,
    help="Samples not fitted on either side of contact, reversals and release.",
)  # fmt: skip
@click.option(
    "--protocol", type=click.Choice(PROTOCOLS),
    help="Protocol whose model is reported as best. Default: chosen automatically (see docs/recorded-indentations.md).",
)  # fmt: skip
@click.option("--yes", is_flag=True, help="Do not ask whether specimen and probe are ready.")
@click.option("--out", type=click.Path(path_type=Path), help="Where to write; default: runs/<time>-force/.")
@click.option("--real-time", is_flag=True, help="Run an emulated rig in real time instead of as fast as possible.")
@click.option("--wire-log", type=click.Path(path_type=Path), metavar="FILE", help=WIRE_LOG_HELP)
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON instead of a summary.")
def force(
    rig_file: Path | None,
    fake: bool,
    seed: int,
    world: Path | None,
    specimen: str | None,
    table: Path | None,
    replay: Path | None,
    recording: RecordingChoice | None,
    calibration: Path | None,
    yes: bool,
    check: bool,
    leave_out: int,
    protocol: ProtocolName | None,
    out: Path | None,
    real_time: bool,
    wire_log: Path | None,
    as_json: bool,
    **press: Any,
) -> None:
    """Identify a held specimen's springs and damper with the force probe (Bilen et al., section III.C).

    The probe tares, approaches slowly until contact, presses at constant speed to a depth or force, and returns;
    the camera gives the deformation. F = m·a + b·v + k1·x + k2·x³ is then identified in the paper's four ways, and a
    second indentation tells how well force is read from the camera alone. The rig file's force guard watches over it
    all. Writes result.json, specimen.yaml, record.csv and report.html.

    \b
    Examples:
      microdrivers calibrate force                                emulated workstation, world 0
      microdrivers calibrate force --specimen slip_corrected      another emulated specimen
      microdrivers calibrate force --rig lab.yaml --depth-um 60   hardware; asks before it moves
      microdrivers calibrate force --rig lab.yaml --fake          the same rig, emulated
      microdrivers calibrate force --csv indentation.csv          time_s, indentation_um, force_uN
      microdrivers calibrate force --replay runs/7/run.mcap       what a run has recorded, again
      microdrivers calibrate force --replay runs/7/run.mcap --protocol loading --leave-out 5
    """
    from microdrivers.configs import shipped_rig
    from microdrivers.estimators.force.identify import IdentificationSettings

    settings = IdentificationSettings(around_reversal=leave_out, protocol=protocol)
    of_old_data = table is not None or replay is not None
    recording = None if of_old_data or recording is None else recording._replace(calibration=calibration)
    output = RunOutput("force", out, as_json=as_json, recording=recording)
    try:
        if of_old_data:
            _refuse_rig_options(table, replay)
        opened: AbstractContextManager[_Opened]
        if table is not None:
            opened, check = _from_table(table, specimen, settings), False
        elif replay is not None:
            opened = _from_recording(replay, settings, must_check=check and given("check"))
        else:
            _check_figures(press)
            emulated = fake or rig_file is None
            if not emulated and not yes:
                _ask(rig_file or shipped_rig())
            choice = RigChoice(rig_file or shipped_rig(), emulated, seed, world, wire_log)
            opened = _on_rig(choice, specimen, calibration, press, settings, real_time)
        status = _run(opened, check, output)
    finally:
        output.close()
    if status:
        sys.exit(status)


def _ask(rig_file: Path) -> None:
    """Have the operator confirm; a rig file that is wrong, or states no force guard, is reported before."""
    from microdrivers.rig import load_rig_file

    rig = load_rig_file(rig_file).rig
    if rig.probe is not None and rig.probe.force not in {guard.sensor for guard in rig.safety.force_guards}:
        click.echo(f"no force guard watches {rig.probe.force}: the rig file's safety section states none", err=True)
    click.confirm(_QUESTION, abort=True, err=True)


def _check_figures(press: dict[str, Any]) -> None:
    """Before anything is asked or opened."""
    from microdrivers.routines.force import PressSettings

    PressSettings(**press).check()


def _refuse_rig_options(table: Path | None, replay: Path | None) -> None:
    from microdrivers.core.errors import ConfigError

    if table is not None and replay is not None:
        raise ConfigError("--csv and --replay exclude each other", remedy="leave out one of them")
    option, describes, tries = ("--csv", ("specimen",), ()) if table is not None else ("--replay", (), ("check",))
    refuse_options_given(
        f"{option} replaces the rig", allowed=("table", "replay", "out", "as_json", "yes", *describes),
        of_analysis=(*OF_ANALYSIS, *tries),
    )  # fmt: skip


class _Opened(NamedTuple):
    """Whoever publishes the samples, what is known of it, and how the specimen is identified."""

    source: IndentationSource
    known: dict[str, Any]
    settings: IdentificationSettings


@contextlib.contextmanager
def _from_recording(file: Path, settings: IdentificationSettings, *, must_check: bool) -> Iterator[_Opened]:
    from microdrivers.core.errors import UnsupportedError
    from microdrivers.recording.reader import Recording
    from microdrivers.routines.force import IndentationReplay

    with Recording(file) as recording:
        tell_flaws(recording)
        source = IndentationReplay(recording)
        if must_check and not source.repeatable:
            raise UnsupportedError(
                f"{file} holds one indentation: there is no other to check the camera's force with",
                remedy="leave out --check",
            )
        if source.past_settings is not None:
            settings = source.past_settings._replace(**fields_given(settings, _SETTINGS))
        yield _Opened(source, describe_recorded(recording), settings)


@contextlib.contextmanager
def _from_table(file: Path, specimen: str | None, settings: IdentificationSettings) -> Iterator[_Opened]:
    from microdrivers.recording.indentation_table import IndentationTable
    from microdrivers.routines.force import IndentationPlayback

    known = {"source": f"recorded indentation {file}", "clock": "recorded", "settings": {"specimen": specimen}}
    yield _Opened(IndentationPlayback(IndentationTable(file)), known, settings)


@contextlib.contextmanager
def _on_rig(
    choice: RigChoice,
    specimen: str | None,
    calibration: Path | None,
    press: dict[str, Any],
    identification: IdentificationSettings,
    real_time: bool,
) -> Iterator[_Opened]:
    from microdrivers.core.clock import SimulatedClock, SystemClock
    from microdrivers.rig import open_rig
    from microdrivers.routines.force import PressExperiment, PressSettings, Sight

    file, fake, seed, world, wire_log, _ = choice
    clock = SimulatedClock() if fake and not real_time else SystemClock()
    overrides = {"specimen": {"preset": specimen}} if fake and specimen is not None else None
    with (
        saying_commands(file),
        _naming_the_option(),
        open_rig(
            file, fake=fake, seed=seed or 0, clock=clock, world=world, world_overrides=overrides, devices="probe",
            wire_log=wire_log,
        ) as rig,
    ):  # fmt: skip
        settings = PressSettings(**press)
        sight = Sight.calibrated(rig, calibration) if calibration is not None else Sight()
        known = describe_rig(rig, fake=fake, seed=seed, settings=settings._asdict() | {"specimen": specimen})
        yield _Opened(PressExperiment(rig, settings, sight=sight), known, identification)


@contextlib.contextmanager
def _naming_the_option() -> Iterator[None]:
    """What is wrong with the preset of the specimen is wrong with the option that names it."""
    from microdrivers.core.errors import ConfigError
    from microdrivers.rig.simulation import OVERRIDES

    try:
        yield
    except ConfigError as error:
        if (error.file, error.key) == (OVERRIDES, "specimen.preset"):
            error.file, error.key = "--specimen", ""
        raise


def _run(opened: AbstractContextManager[_Opened], check: bool, output: RunOutput) -> int:
    """Measure, then close whatever was open, and only then write: Ctrl-C may end that at any moment."""
    from microdrivers.core.clock.interruption import INTERRUPTION
    from microdrivers.core.errors import MicrodriversError
    from microdrivers.report.force_truth import ContactTruthCollector
    from microdrivers.routines.force import Characterisation

    characterisation = run = None
    try:
        with opened as (source, known, settings):
            known["settings"] = known.get("settings", {}) | settings._asdict()
            truth = ContactTruthCollector(source.bus)
            with output.recorded(source, known):
                characterisation = Characterisation(source, on_host=output.follow, settings=settings)
                run = characterisation.run(output.progress, check=check)
        INTERRUPTION.check()  # one that was kept until now
    except (MicrodriversError, KeyboardInterrupt) as error:
        if characterisation is None:
            raise
        interrupted = characterisation.interrupted or isinstance(error, KeyboardInterrupt)
        if run is None or not interrupted:
            _tell_what_is_left(characterisation, error, known, truth, output)
            if interrupted or source.whereabouts not in str(error):
                click.echo(source.whereabouts, nl=bool(source.whereabouts), err=True)
            if interrupted:
                raise KeyboardInterrupt from error
            raise
        characterisation.interrupted = True
    try:
        status = _finish(characterisation, run, known, truth, output)
    except KeyboardInterrupt:
        click.echo(source.whereabouts, nl=bool(source.whereabouts), err=True)
        raise
    if characterisation.interrupted:
        click.echo(f"interrupted; {source.whereabouts or 'the result is from what had been published'}", err=True)
    return status


def _finish(
    characterisation: Characterisation,
    run: ForceRun,
    known: dict[str, Any],
    truth: ContactTruthCollector,
    output: RunOutput,
) -> int:
    """Write and show the result."""
    measured = _measured(characterisation)
    if characterisation.interrupted and write_results(output.folder, measured):  # before another Ctrl-C comes
        click.echo(_what_to_do_with(output.folder / RECORD, ""), err=True)
    from microdrivers.report.force_summary import force_summary

    result = _result(run, known, truth, output)
    files = measured | _files(result, output)
    return output.finish(result, partial(force_summary, result), files, complete=not characterisation.interrupted)


def _tell_what_is_left(
    characterisation: Characterisation,
    error: MicrodriversError | KeyboardInterrupt,
    known: dict[str, Any],
    truth: ContactTruthCollector,
    output: RunOutput,
) -> None:
    """Keep what an experiment that failed has measured, and what that says of the specimen."""
    folder, found = output.folder, characterisation.partial(error)
    measured = _measured(characterisation)
    recorded = f"{folder / RECORDING} holds the samples until then" if (folder / RECORDING).exists() else ""
    if not measured and characterisation.interrupted:
        what = "interrupted before the specimen was pressed: there is no result"
        click.echo(f"{what}{'; ' * bool(recorded)}{recorded}", err=True)
    elif measured and recorded and characterisation.tells_nothing:
        click.echo(recorded, err=True)
    elif measured and recorded:
        command = shlex.join(["microdrivers", "calibrate", "force", "--replay", str(folder / RECORDING)])
        click.echo(f"{recorded}; to analyse it: {command}", err=True)
    if measured and known["clock"] != "recorded" and write_results(folder, measured):
        click.echo(_what_to_do_with(folder / RECORD, characterisation.tells_nothing), err=True)
    if found is not None and write_results(folder, _files(_result(found, known, truth, output), output)):
        output.close()
        click.echo(f"what it says of the specimen is in {folder}/: result.json, specimen.yaml, report.html", err=True)


def _what_to_do_with(record: Path, tells_nothing: str) -> str:
    """What an experiment that failed has measured, and how it is analysed, unless it says nothing of a specimen."""
    if tells_nothing:
        return f"what was measured is in {record}; it cannot be analysed: {tells_nothing}"
    command = shlex.join(["microdrivers", "calibrate", "force", "--csv", str(record)])
    return f"what was measured is in {record}; to analyse it: {command}"


def _result(run: ForceRun, known: dict[str, Any], truth: ContactTruthCollector, output: RunOutput) -> ForceResult:
    """What the run says of the specimen; with what its recording lacks, and the truth if it was simulated."""
    from microdrivers.routines.force import build_result

    result = build_result(run, output.provenance(known))
    notes = [*result.notes, *output.recording_notes]
    return result.model_copy(update={"truth": truth.compare(result, run.first.deformations), "notes": notes})


def _files(result: ForceResult, output: RunOutput) -> dict[str, Callable[[Path], object]]:
    """What writes the files of a result."""
    from microdrivers.report.force_report import write_force_report

    def draw(file: Path) -> None:
        output.progress.step("drawing the report")
        write_force_report(result, file)

    return {RESULT: result.write_json, "specimen.yaml": result.write_specimen, "report.html": draw}


def _measured(characterisation: Characterisation) -> dict[str, Callable[[Path], object]]:
    """What writes down what has been measured, also of an experiment that failed; nothing if nothing has."""
    from microdrivers.recording.indentation_table import write_indentation_table

    if characterisation.first is None or not characterisation.first.frames:
        return {}
    return {RECORD: partial(write_indentation_table, samples=characterisation.first.frames)}
