"""Publishes a recording again, in the order in which an estimator's inbox got the samples."""

from __future__ import annotations

import heapq
import itertools
import json
from collections.abc import Collection, Iterator
from typing import Any, NamedTuple

from microdrivers.core.bus import Bus, Topic
from microdrivers.core.clock import Clock
from microdrivers.core.samples import Frame, RoutineNote, Sample
from microdrivers.recording.reader import Recording

ROUTINE = "routine"
ESTIMATES = ("estimate/*", "*/track", "*/deformation", ROUTINE)
"""What estimators made of the samples, and a replay makes again."""

_READ_AHEAD = 2000
"""Samples by which the file's order may differ from the bus's: threads publish side by side."""
_FRAMES_AHEAD = 64
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
        for _, sample in recording.samples((ROUTINE,))
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

    Attributes:
        published: number of samples so far. missing: samples that an inbox got and the recording does not hold.
    """

    def __init__(
        self,
        recording: Recording,
        bus: Bus,
        *,
        leave_out: Collection[str] = ESTIMATES,
        clock: Clock | None = None,
        speed: float | None = None,
    ) -> None:
        self.published = 0
        self.missing = 0
        self._bus = bus
        self._source: Iterator[tuple[str, Sample]] = recording.samples(leave_out=leave_out)
        self._waiting: list[tuple[int, int, str, Sample]] = []
        self._frames_waiting = 0
        self._topics: dict[str, Topic[Any]] = {}
        self._ties = itertools.count()
        self._recording = recording
        self._clock = clock
        self._speed = speed
        self._began_ns: tuple[int, int] | None = None

    def up_to(self, order: int | None) -> None:
        """Publish all that was published on the bus before `order`; None: all that is left."""
        while self._fill() and (order is None or self._waiting[0][0] < order):
            self._publish_next()

    def as_arrived(self, host: str, order: int | None) -> None:
        """As `up_to`, with the samples of one inbox in the order in which it got them."""
        arrivals = self._recording.arrivals
        if host not in arrivals:
            self.up_to(order)
            return
        first = self._waiting[0][0] if self._fill() else 0
        ordered = [each for each in arrivals[host] if each >= first and (order is None or each < order)]
        members = set(ordered)
        early: dict[int, tuple[str, Sample]] = {}
        for wanted in ordered:
            while wanted not in early and self._fill() and self._waiting[0][0] <= wanted:
                number, topic, sample = self._take_next()
                if number in members:
                    early[number] = (topic, sample)
                else:
                    self._publish(topic, sample)
            if wanted in early:
                self._publish(*early.pop(wanted))
            else:
                self.missing += 1
        self.up_to(order)

    def _fill(self) -> bool:
        """Read ahead; tells whether anything is left."""
        while len(self._waiting) < _READ_AHEAD and self._frames_waiting < _FRAMES_AHEAD:
            entry = next(self._source, None)
            if entry is None:
                break
            topic, sample = entry
            self._frames_waiting += isinstance(sample, Frame)
            heapq.heappush(self._waiting, (sample.order, next(self._ties), topic, sample))
        return bool(self._waiting)

    def _take_next(self) -> tuple[int, str, Sample]:
        number, _, topic, sample = heapq.heappop(self._waiting)
        self._frames_waiting -= isinstance(sample, Frame)
        return number, topic, sample

    def _publish_next(self) -> None:
        _, topic, sample = self._take_next()
        self._publish(topic, sample)

    def _publish(self, topic: str, sample: Sample) -> None:
        if self._speed is not None and self._clock is not None:
            self._keep_pace(sample, self._clock, self._speed)
        self.published += 1
        found = self._topics.get(topic)
        if found is None or found.sample_type is not type(sample):
            found = self._topics[topic] = self._bus.topic(topic, type(sample))
        found.publish(sample)

    def _keep_pace(self, sample: Sample, clock: Clock, speed: float) -> None:
        if self._began_ns is None:
            self._began_ns = clock.now_ns(), sample.t_ns
        start_ns, first_ns = self._began_ns
        clock.sleep_until(start_ns + round((sample.t_ns - first_ns) / speed))
