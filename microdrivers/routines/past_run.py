"""What a recording tells of the run that it holds, beside its samples."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from microdrivers.recording.reader import Recording
from microdrivers.recording.replay import Note

INTERRUPTED = "it was interrupted"

_MOST_FLAWS = 8


class PastRun(NamedTuple):
    """What a result from a recording must carry; of a live run, nothing.

    Attributes:
        ended_by: what ended the recorded run early; empty if nothing did.
        flaws: what the recording lacks, or has wrong.
    """

    ended_by: str = ""
    flaws: tuple[str, ...] = ()

    def notes(self) -> list[str]:
        """The flaws as a result's notes."""
        told = [f"The result is from a recording with a flaw: {flaw}." for flaw in self.flaws[:_MOST_FLAWS]]
        more = len(self.flaws) - len(told)
        return [*told, f"The recording has {more} more flaws; `microdrivers info` lists them."] if more else told


def past_run(recording: Recording, done: Sequence[Note], *, missing: int, broken_off: str) -> PastRun:
    """What a recording tells of its run.

    Args:
        recording: what is replayed.
        done: the routine's notes of its end.
        missing: how many samples its estimators had and it does not hold.
        broken_off: what else says that the run ended early, where no note of the end is found; empty: nothing does.
    """
    ended_by = str(done[-1].content["ended_by"]) if done else broken_off
    lacks = [f"it lacks {missing} samples that the estimators had"] if missing else []
    return PastRun(ended_by, (*recording.flaws, *lacks))
