"""What the calibrations share: where results are written, and what is known of the rig that they come from."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from microdrivers.rig import Rig


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
