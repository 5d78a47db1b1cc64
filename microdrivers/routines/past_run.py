"""What a recording tells of the run that it holds, beside its samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from inspect import signature
from typing import NamedTuple, TypeVar

from microdrivers.core.errors import UnsupportedError
from microdrivers.recording.reader import Recording
from microdrivers.recording.replay import Note

_MOST_FLAWS = 8

SettingsT = TypeVar("SettingsT")
_LACKS_END = "the recording does not hold its end"


class PastRun(NamedTuple):
    """What a result from a recording must carry; of a live run, nothing.

    Attributes:
        ended_by: what ended the recorded run early, or why its end is not known; empty if all of it is recorded.
        flaws: what the recording lacks, or has wrong.
        missing: how many samples its estimators had and the recording lacks.
        lost_frames: how many of these are frames of the experiment, where that is counted.
        lost_last: how many of these are its last ones.
    """

    ended_by: str = ""
    flaws: tuple[str, ...] = ()
    missing: int = 0
    lost_frames: int = 0
    lost_last: int = 0

    def notes(self) -> list[str]:
        """The flaws as a result's notes."""
        told = [f"The result is from a recording with a flaw: {flaw}." for flaw in self.flaws[:_MOST_FLAWS]]
        more = len(self.flaws) - len(told)
        if not more:
            return told
        return [*told, f"The recording has {more} more flaw{'s' * (more > 1)}; `microdrivers info` lists all of them."]


def past_run(
    recording: Recording,
    done: Sequence[Note],
    *,
    missing: int,
    broken_off: str = "",
    lost_frames: int = 0,
    lost_last: int = 0,
) -> PastRun:
    """What a recording tells of its run.

    Args:
        recording: what is replayed.
        done: the routine's notes of its end.
        missing: how many samples its estimators had and it does not hold.
        broken_off: where the run breaks off, if no note of its end is found; empty: that is not known.
        lost_frames: how many of `missing` are frames, where that is counted.
        lost_last: how many of these are the last ones of the experiment.
    """
    if done:
        last = "frame" if lost_last == 1 else f"{lost_last} frames"
        ended_by = str(done[-1].content["ended_by"]) or (f"the recording lacks its last {last}" if lost_last else "")
    elif recording.complete:
        ended_by = broken_off or _LACKS_END
    else:
        ended_by = broken_off or "the recording was cut off, and does not tell the run's end"
    # First, as `info` does not tell it: what is behind the last flaw that has room is looked up there.
    frames = f", among them {lost_frames} frame{'s' * (lost_frames > 1)} of the experiment" if lost_frames else ""
    lacks = [f"it lacks {missing} sample{'s' * (missing > 1)} that the estimators had{frames}"] if missing else []
    unordered = [] if recording.arrivals else ["it does not tell in which order its estimators got their samples"]
    return PastRun(ended_by, (*lacks, *unordered, *recording.flaws), missing, lost_frames, lost_last)


def noted_settings(
    notes: Sequence[Note], kind: str, settings: Callable[..., SettingsT], *, before: Note
) -> SettingsT | None:
    """What the run's estimators were set to, settings left out that are not known any more; None if it does not tell.

    Args:
        notes: of its routine.
        kind: of the notes of its settings; the last of them counts.
        settings: their type.
        before: a later note does not belong to the run.
    """
    noted = [note.content for note in notes if note.kind == kind and note.order < before.order]
    known = signature(settings).parameters
    return settings(**{name: value for name, value in noted[-1].items() if name in known}) if noted else None


def refuse_unbegun(recording: Recording, notes: Sequence[Note], done: str) -> None:
    """Refuse a run that ended before anything was measured.

    Args:
        recording: of the run.
        notes: of its routine.
        done: kind of the routine's note of its end.

    Raises:
        UnsupportedError: there is such a note, and nothing of the file is damaged.
    """
    ended = [note.content["ended_by"] for note in notes if note.kind == done]
    if ended and ended[-1] and not recording.losses:
        raise UnsupportedError(
            f"the run that {recording.file} holds ended before anything was measured: {ended[-1]}",
            remedy="there is nothing to analyse: run it again",
        )
