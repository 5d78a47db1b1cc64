"""What the calibrations share: where results are written, and what is known of the rig or recording they come from."""

from __future__ import annotations

import functools
import json
import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click
from click.core import ParameterSource

if TYPE_CHECKING:
    from microdrivers.core.bus import Bus
    from microdrivers.core.clock import Clock
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


def refuse_options_given(reason: str, *, allowed: Collection[str]) -> None:
    """Refuse what the user has given beside an option that makes it void.

    Args:
        reason: what that option does, as `--images replaces the rig`.
        allowed: names of the parameters that keep their meaning.

    Raises:
        ConfigError: something else was given on the command line.
    """
    from microdrivers.core.errors import ConfigError

    context = click.get_current_context()
    given = [
        max(parameter.opts, key=len)
        for parameter in context.command.params
        if parameter.name is not None
        and parameter.name not in allowed
        and context.get_parameter_source(parameter.name) is ParameterSource.COMMANDLINE
    ]
    if given:
        raise ConfigError(f"{reason}, and there is no experiment to drive", remedy=f"leave out {', '.join(given)}")


def prepare_folder(folder: Path, *, new: bool) -> Path:
    """Find out before the experiment whether its result can be written.

    Args:
        folder: which need not exist.
        new: whether it must hold no result yet; of a live run that is recorded, its recording sees to that.

    Raises:
        ConfigError: it cannot, or another result is there.
    """
    from microdrivers.core.errors import ConfigError

    if new and (folder / RESULT).exists():
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
    """How a run is recorded."""

    compress_images: bool


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
    recorder.attach("provenance.json", json.dumps(dict(known), default=str).encode(), "application/json")
    return recorder


def recorded_as(recorder: Recorder | None) -> str:
    """What to say of a run's recording beside its other files; nothing if there is none."""
    if recorder is None:
        return ""
    dropped = sum(count.dropped for count in recorder.counts.values())
    lacks = f"; it lacks {dropped} samples that could not be written" if dropped else ""
    return f", {RECORDING} ({recorder.size / 1e6:.1f} MB{lacks})"


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
