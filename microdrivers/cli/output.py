"""What the calibrations share: where results are written, and what is known of the rig or recording they come from."""

from __future__ import annotations

import functools
import json
import math
import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click
from click.core import ParameterSource

from microdrivers.cli.exit_codes import EXIT_ERROR, EXIT_INTERRUPTED, EXIT_OK

if TYPE_CHECKING:
    from microdrivers.core.bus import Bus
    from microdrivers.core.clock import Clock
    from microdrivers.core.errors import MicrodriversError
    from microdrivers.recording.reader import Recording
    from microdrivers.recording.recorder import Recorder
    from microdrivers.rig import Rig

RECORDING = "run.mcap"
RESULT = "result.json"
COMPRESSION_HELP = "without loss: a third to a half smaller, 3 to 10 ms of processor time a megapixel."


def topic_patterns(topics: Sequence[str]) -> list[str] | None:
    """The names and patterns of all `--topics`; None if that was not given.

    Raises:
        ConfigError: it was given, and names nothing.
    """
    from microdrivers.core.errors import ConfigError

    patterns = [name.strip() for names in topics for name in names.split(",") if name.strip()]
    if topics and not patterns:
        raise ConfigError("--topics names no topic", remedy="name some, or leave out --topics for all of them")
    return patterns or None


class FiniteRange(click.FloatRange):
    """A number within a range, neither infinite nor NaN."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """As click's own."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number


def given(name: str) -> bool:
    """Whether the user has given that parameter of the present command."""
    return click.get_current_context().get_parameter_source(name) is ParameterSource.COMMANDLINE


def refuse_options_given(reason: str, *, allowed: Collection[str], of_analysis: Collection[str] = ()) -> None:
    """Refuse what the user has given beside an option that makes it void.

    Args:
        reason: what that option does, as `--images replaces the rig`.
        allowed: names of the parameters that keep their meaning.
        of_analysis: and of those that may be tried on old data.

    Raises:
        ConfigError: something else was given on the command line.
    """
    from microdrivers.core.errors import ConfigError

    parameters = {p.name: max(p.opts, key=len) for p in click.get_current_context().command.params if p.name}
    void = [option for name, option in parameters.items() if given(name) and name not in {*allowed, *of_analysis}]
    if void:
        tries = [option for name, option in parameters.items() if name in of_analysis]
        other = f"; what can be tried on old data: {', '.join(tries)}" if tries else ""
        raise ConfigError(
            f"{reason}, and there is no experiment to drive", remedy=f"leave out {', '.join(void)}{other}"
        )


def prepare_folder(folder: Path) -> Path:
    """Find out before the experiment whether its result can be written.

    Args:
        folder: which need not exist.

    Raises:
        ConfigError: it cannot, or another result is there.
    """
    from microdrivers.core.errors import ConfigError

    if (folder / RESULT).exists():
        raise ConfigError(
            f"a {RESULT} is there, and a result is never written over", file=str(folder),
            remedy="choose another --out folder",
        )  # fmt: skip
    existed = folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        if not existed:
            folder.rmdir()  # a failed run leaves nothing behind
    except OSError as error:
        raise ConfigError(
            f"nothing can be written there: {error.strerror}", file=str(folder), remedy="choose another --out folder"
        ) from error
    return folder


def error_as_json(error: MicrodriversError) -> str:
    """What a command with --json prints if it fails: an object whose only key is `error`."""
    return json.dumps({"error": _error_data(error)}, indent=1, ensure_ascii=False)


def _error_data(error: MicrodriversError) -> dict[str, Any]:
    from microdrivers.core.errors import ConfigError, ErrorTree

    found = {"kind": type(error).__name__, "what": error.what, "remedy": error.remedy, "device": error.device}
    place = {name: getattr(error, name) for name in ("file", "line", "column", "key")} if isinstance(
        error, ConfigError) else {}  # fmt: skip
    parts = {"errors": [_error_data(part) for part in error.errors]} if isinstance(error, ErrorTree) else {}
    return found | place | parts


def describe_rig(rig: Rig, *, fake: bool, seed: int | None, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The provenance of a run on a rig, as `describe_run` takes it."""
    import msgspec

    return {
        "source": "emulated rig" if fake else "emulated rig on ports" if rig.file.emulated else "live rig",
        "clock": "simulated" if rig.clock.simulated else "system",
        "rig_name": rig.file.name,
        "rig_file": str(rig.description.file),
        "rig": rig.description.as_data(),
        "fake": fake or rig.file.emulated,
        "seed": seed if fake else None,
        "devices": {
            name: {key: str(value) for key, value in msgspec.structs.asdict(device.info).items()}
            for name, device in rig.devices.items()
        },
        "settings": dict(settings),
    }


class RecordingChoice(NamedTuple):
    """How a run is recorded; `calibration` is that of the optics, for a run that uses one."""

    compress_images: bool
    calibration: Path | None = None


def recording_options(command: Callable[..., None]) -> Callable[..., None]:
    """The options by which a run is recorded; the command gets them as `recording`, None if it is not."""

    @click.option("--record/--no-record", default=True, show_default=True, help="Record all samples in run.mcap.")
    @click.option("--compress-images", is_flag=True, help=f"In run.mcap; {COMPRESSION_HELP}")
    @functools.wraps(command)
    def with_choice(*, record: bool, compress_images: bool, **others: Any) -> None:
        command(recording=RecordingChoice(compress_images) if record else None, **others)

    return with_choice


def start_recording(
    folder: Path, choice: RecordingChoice, *, bus: Bus, clock: Clock, known: Mapping[str, Any]
) -> Recorder:
    """Record all of a run beside its result. If the disk fails, the run goes on, and `recorded_as` tells.

    Raises:
        ConfigError: the folder holds a recording already, or cannot be written.
    """
    import yaml

    from microdrivers.recording.header import describe_recording
    from microdrivers.recording.recorder import Recorder

    folder.mkdir(parents=True, exist_ok=True)
    header = describe_recording(source="fake" if known["fake"] else "live", seed=known["seed"], rig=known["rig_name"])
    recorder = Recorder(folder / RECORDING, bus=bus, clock=clock, header=header, compress_images=choice.compress_images)
    recorder.attach(
        "rig.yaml", yaml.safe_dump(known["rig"], sort_keys=False, allow_unicode=True).encode(), "application/yaml"
    )
    if choice.calibration is not None:
        recorder.attach("calibration.json", choice.calibration.read_bytes(), "application/json")
    recorder.attach("provenance.json", json.dumps(dict(known), default=str).encode(), "application/json")
    return recorder


def recorded_as(recorder: Recorder | None) -> str:
    """What to say of a run's recording beside its other files; nothing if there is none."""
    if recorder is None:
        return ""
    lacks = f"; it lacks {recorder.dropped} samples that could not be written" if recorder.dropped else ""
    return f", {RECORDING} ({recorder.size / 1e6:.1f} MB{lacks})"


def recording_notes(recorder: Recorder | None) -> list[str]:
    """What a result has to tell of its recording: nothing if that is whole, or if there is none."""
    if recorder is None:
        return []
    if recorder.disturbance:
        return [f"The recording {RECORDING} is spoilt: while it was written {recorder.disturbance}."]
    if not (recorder.dropped or recorder.failure):
        return []
    why = f" ({recorder.failure.strerror or recorder.failure})" if recorder.failure is not None else ""
    lacks = f"lacks {recorder.dropped} samples" if recorder.dropped else "lacks its end or an attachment"
    return [f"The recording {RECORDING} {lacks} that could not be written{why}; this result was made from all samples."]


def write_results(folder: Path, files: Mapping[str, Callable[[Path], object]]) -> bool:
    """Write a result's files, each whole or not at all; what cannot be written is said, and the others are tried.

    Args:
        folder: where; made if it is not there.
        files: by name, what writes it.

    Returns:
        whether all are written.
    """
    from microdrivers.recording.output import whole_file

    failed = False
    for name, write in files.items():
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with whole_file(folder / name) as part:
                write(part)
        except OSError as error:
            failed = True
            click.secho("error: ", fg="red", bold=True, nl=False, err=True)
            click.echo(f"{folder / name} could not be written: {error.strerror or error}", err=True)
    return not failed


def exit_status(recorder: Recorder | None, *, complete: bool, written: bool) -> int:
    """Of a run: it also tells whether its result is written, and all of it recorded."""
    if not complete:
        return EXIT_INTERRUPTED
    return EXIT_ERROR if recording_notes(recorder) or not written else EXIT_OK


def tell_flaws(recording: Recording) -> None:
    """Say what is wrong with a recording that is about to be used; also with --json, on standard error."""
    for flaw in recording.flaws:
        click.echo(f"· {flaw}", err=True)


def describe_recorded(recording: Recording) -> dict[str, Any]:
    """The provenance of a run on a recording: that of the recorded run, as far as it is known."""
    recorded = recording.attachments.get("provenance.json")
    known: dict[str, Any] = json.loads(recorded) if recorded is not None else {}
    header = recording.header
    return known | {
        "source": f"recording {recording.file}, of {known.get('source', header.source)}",
        "clock": "recorded",
        "rig_name": header.rig,
        "fake": known.get("fake", header.source == "fake"),
        "seed": header.seed,
    }
