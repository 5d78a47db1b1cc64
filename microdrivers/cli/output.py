"""What commands write and tell: results as files, errors as JSON, and where a result comes from."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from microdrivers.core.errors import MicrodriversError
    from microdrivers.recording.reader import Recording
    from microdrivers.rig import Rig


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


def write_results(folder: Path, files: Mapping[str, Callable[[Path], object]]) -> bool:
    """Write a result's files, each whole or not at all; what cannot be written is said, and the others are tried.

    Args:
        folder: where; made if it is not there.
        files: by name, what writes it.

    Returns:
        whether all are written.
    """
    from microdrivers.recording.output import whole_file

    written: list[str] = []
    failed = False
    for name, write in files.items():
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with whole_file(folder / name) as part:
                write(part)
            written.append(name)
        except KeyboardInterrupt:
            click.echo(f"\n{folder}/ holds {', '.join(written) or 'nothing'} and lacks {name}", err=True)
            if written:
                click.echo("what is there stays: choose another --out folder to run it again", err=True)
            raise
        except OSError as error:
            failed = True
            click.secho("error: ", fg="red", bold=True, nl=False, err=True)
            click.echo(f"{folder / name} could not be written: {error.strerror or error}", err=True)
    return not failed


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
