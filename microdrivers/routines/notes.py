"""What routines note for a replay of their recording."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.core.samples import RoutineNote

TOPIC = "routine"


def note(bus: Bus, clock: Clock, kind: str, content: Mapping[str, Any]) -> None:
    """Publish what a routine has settled; `content` must be plain data."""
    topic = bus.topic(TOPIC, RoutineNote)
    seq = topic.latest.seq + 1 if topic.latest is not None else 0
    topic.publish(
        RoutineNote(
            t_ns=clock.now_ns(), device=TOPIC, t_source="computed", seq=seq, kind=kind,
            content=json.dumps(content, allow_nan=False),
        )
    )  # fmt: skip
