"""Publishes a recording again, in the order in which an estimator's inbox got the samples."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Collection, Iterator
from typing import Any, NamedTuple

from microdrivers.core.bus import HISTORY_LENGTH, Bus, Topic
from microdrivers.core.clock import Clock
from microdrivers.core.errors import DataError, UnsupportedError
from microdrivers.core.samples import Frame, RoutineNote, Sample
from microdrivers.recording.reader import Recording

ROUTINE = "routine"
ESTIMATES = ("estimate/*", "*/track", "*/deformation", ROUTINE)
"""What estimators made of the samples, and a replay makes again."""

_READ_AHEAD = 2000
"""Samples by which the file's order may differ from the bus's: threads publish side by side."""
FRAME_HISTORY = 4
"""So many past frames stay on the bus: to keep them costs fresh memory for each."""
_FRAMES_AHEAD = 32
"""No more of them are frames: they are large."""


class Note(NamedTuple):
    """What a routine settled, and when in the bus's order."""

    kind: str
    content: Any
    order: int


def notes_of(recording: Recording) -> list[Note]:
    """All that routines have noted, in their order."""
    found = [
        Note(sample.kind, json.loads(sample.content), sample.order)
        for _, sample in recording.samples((ROUTINE,), required=False)
        if isinstance(sample, RoutineNote)
    ]
    return sorted(found, key=lambda note: note.order)


class Replay:
    """Publishes a recording's samples on a bus, once; samples keep their `order`.

    Args:
        recording: what to publish.
        bus: where.
        leave_out: topics, or patterns, that are not published.
        clock: samples are published at the distances of their times divided by `speed`, on this clock.
        speed: None publishes as fast as possible.
        admit: is asked, in their order, which samples are to be published; default: all.

    Attributes:
        published: number of samples so far. missing: samples that an inbox got and the recording does not hold.

    A sample that the file holds twice in a row, or nearly so, is published once. Where it holds one farther from its
    place than threads can overtake each other, whatever reaches that place raises `DataError`.
    """

    def __init__(
        self,
        recording: Recording,
        bus: Bus,
        *,
        leave_out: Collection[str] = ESTIMATES,
        clock: Clock | None = None,
        speed: float | None = None,
        admit: Callable[[str, Sample], bool] = lambda _topic, _sample: True,
    ) -> None:
        self.published = 0
        self.missing = 0
        self._bus = bus
        self._source: Iterator[tuple[str, Sample]] = recording.samples(leave_out=leave_out)
        self._waiting: deque[tuple[str, Sample]] = deque()
        self._frames_waiting = 0
        self._newest = self._taken = -1
        self._topics: dict[str, Topic[Any]] = {}
        self._recording = recording
        self._clock = clock
        self._speed = speed
        self._admit = admit
        self._began_ns: tuple[int, int] | None = None

    def up_to(self, order: int | None) -> None:
        """Publish all that was published on the bus before `order`; None: all that is left."""
        waiting = self._waiting
        while waiting or self._fill():
            if order is not None and waiting[0][1].order >= order:
                return
            topic, sample = self._take_next()
            self._publish(topic, sample)

    def as_arrived(self, host: str, topics: Collection[str], order: int | None) -> None:
        """Publish all that an inbox got, in the order in which it got it, and all else that was published meanwhile.

        The inbox's own `topics` are held back until it listened and after it was closed. Where the order of arrival is
        not known (at the end of a recording that was cut off, or anywhere in one without it), it is that of the bus,
        and ends before `order`.
        """
        arrivals = self._recording.arrivals
        if host not in arrivals:
            self.up_to(order)
            return
        waiting = self._waiting
        first = waiting[0][1].order if waiting or self._fill() else 0
        ordered = [each for each in arrivals[host] if each >= first]
        members = set(ordered)
        early: dict[int, tuple[str, Sample]] = {}
        listening = False
        for wanted in ordered:
            while wanted not in early and (waiting or self._fill()) and waiting[0][1].order <= wanted:
                topic, sample = self._take_next()
                if sample.order in members:
                    early[sample.order] = (topic, sample)
                elif listening or topic not in topics:
                    self._publish(topic, sample)
            if wanted in early:
                self._publish(*early.pop(wanted))
                listening = True
            else:
                self.missing += 1
        if not self._recording.complete:
            self.up_to(order)

    def require(self, *topics: Topic[Any]) -> None:
        """Refuse a recording that has published nothing on one of the topics.

        Raises:
            UnsupportedError: it lacks what its estimators need.
        """
        for topic in topics:
            if topic.latest is None:
                raise UnsupportedError(
                    f"{self._recording.file} has no samples of {topic.name!r}, which its analysis needs",
                    remedy="record all topics that the routine listens to; by default all are recorded",
                )

    def _fill(self) -> bool:
        """Read ahead; tells whether anything is left."""
        waiting = self._waiting
        if self._frames_waiting < _FRAMES_AHEAD:
            for entry in self._source:
                order = entry[1].order
                if order > self._newest:
                    waiting.append(entry)
                    self._newest = order
                elif order < 0:  # never published: it has no place
                    waiting.append(entry)
                elif not self._insert(entry):
                    continue
                self._frames_waiting += isinstance(entry[1], Frame)
                if len(waiting) >= 2 * _READ_AHEAD or self._frames_waiting >= _FRAMES_AHEAD:
                    break
        return bool(waiting)

    def _insert(self, entry: tuple[str, Sample]) -> bool:
        """Put it in its place behind those that are not newer; False if it is there already.

        Raises:
            DataError: what follows it has been published already.
        """
        waiting, order = self._waiting, entry[1].order
        place = len(waiting)
        while place and waiting[place - 1][1].order > order:
            place -= 1
        before = waiting[place - 1][1].order if place else self._taken
        if order == before:
            return False
        if order < before:
            raise DataError(
                f"{self._recording.file} does not hold its samples in the order in which they were published: one of "
                f"{entry[0]!r} stands, perhaps once more, far behind its place",
                remedy="another program has rewritten the file: have it sort the messages by their log time, each once",
            )
        waiting.insert(place, entry)
        return True

    def _take_next(self) -> tuple[str, Sample]:
        entry = self._waiting.popleft()
        if entry[1].order > self._taken:
            self._taken = entry[1].order
        if self._frames_waiting and isinstance(entry[1], Frame):
            self._frames_waiting -= 1
        if len(self._waiting) < _READ_AHEAD:
            self._fill()
        return entry

    def _publish(self, topic: str, sample: Sample) -> None:
        if not self._admit(topic, sample):
            return
        if self._speed is not None and self._clock is not None:
            self._keep_pace(sample, self._clock, self._speed)
        self.published += 1
        found = self._topics.get(topic)
        if found is None or found.sample_type is not type(sample):
            history = FRAME_HISTORY if isinstance(sample, Frame) else HISTORY_LENGTH
            found = self._topics[topic] = self._bus.topic(topic, type(sample), history=history)
        found.publish(sample)

    def _keep_pace(self, sample: Sample, clock: Clock, speed: float) -> None:
        if self._began_ns is None:
            self._began_ns = clock.now_ns(), sample.t_ns
        start_ns, first_ns = self._began_ns
        clock.sleep_until(start_ns + round((sample.t_ns - first_ns) / speed))
