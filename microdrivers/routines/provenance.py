"""Where a result comes from."""

from __future__ import annotations

import datetime
import platform
from collections.abc import Mapping
from typing import Any

from microdrivers import __version__
from microdrivers.results.record import Provenance


def describe_run(known: Mapping[str, Any], *, command: str, now: datetime.datetime) -> Provenance:
    """Complete what the caller knows of a run with versions, date and machine."""
    defaults: dict[str, Any] = {
        "rig_name": "",
        "rig_file": "",
        "rig": {},
        "fake": False,
        "seed": None,
        "devices": {},
        "settings": {},
    }
    return Provenance(
        microdrivers_version=__version__,
        created_utc=now.isoformat(timespec="seconds"),
        command=command,
        python=platform.python_version(),
        platform=platform.platform(),
        **(defaults | dict(known)),
    )
