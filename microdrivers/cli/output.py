"""What the calibrations share: where results are written, and what is known of the rig that they come from."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from microdrivers.core.bus import Bus
    from microdrivers.core.clock import Clock
    from microdrivers.recording.reader import Recording
    from microdrivers.recording.recorder import Recorder
    from microdrivers.rig import Rig

RECORDING = "run.mcap"


def prepare_folder(folder: Path) -> Path:
    """Find out before the experiment whether its result can be written."""
    from microdrivers.core.errors import ConfigError

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


def start_recording(folder: Path, *, bus: Bus, clock: Clock, known: Mapping[str, Any]) -> Recorder:
    """Record all of a run beside its result.

    Raises:
        ConfigError: the folder holds a recording already, or cannot be written.
    """
    import yaml

    from microdrivers.recording.header import describe_recording
    from microdrivers.recording.recorder import Recorder

    folder.mkdir(parents=True, exist_ok=True)
    header = describe_recording(source="fake" if known["fake"] else "live", seed=known["seed"], rig=known["rig_name"])
    recorder = Recorder(folder / RECORDING, bus=bus, clock=clock, header=header)
    recorder.attach(
        "rig.yaml", yaml.safe_dump(known["rig"], sort_keys=False, allow_unicode=True).encode(), "application/yaml"
    )
    recorder.attach("provenance.json", json.dumps(dict(known), default=str).encode(), "application/json")
    return recorder


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
