"""What routines note for a replay of their recording."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.core.errors import MicrodriversError
from microdrivers.core.samples import RoutineNote

TOPIC = "routine"
INTERRUPTED = "it was interrupted"


class Ending:
    """How an experiment ended; `ended_by` is empty if it went to its end."""

    ended_by: str = "an error of the program"


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


@contextmanager
def noted_ending(bus: Bus, clock: Clock, kind: str, *, finish: Callable[[], object]) -> Iterator[Ending]:
    """Run an experiment, finish it, and note how it ended: Ctrl-C ends it and goes no farther, errors go on.

    Args:
        bus: of the run.
        clock: of the run.
        kind: of the note.
        finish: called before the note, however it ended; what it raises is noted and goes on, a second Ctrl-C too.
    """
    ending = Ending()
    try:
        yield ending
        ending.ended_by = ""
    except KeyboardInterrupt:
        ending.ended_by = INTERRUPTED
    except MicrodriversError as error:
        ending.ended_by = error.what
        raise
    finally:
        try:
            finish()
        except KeyboardInterrupt:
            ending.ended_by = ending.ended_by or INTERRUPTED
            raise
        except MicrodriversError as error:
            ending.ended_by = ending.ended_by or error.what
            raise
        finally:
            note(bus, clock, kind, {"ended_by": ending.ended_by})
