"""What a recording holds, topic by topic."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from microdrivers.core.samples import Frame, Sample, WireTraffic
from microdrivers.core.units import NS_PER_S
from microdrivers.recording.recorded_channels import Action, ChannelReader, NoteReader, Stamps
from microdrivers.recording.schemas import Arrivals, Drops


class TopicSummary(msgspec.Struct, frozen=True, kw_only=True):
    """What there is of one topic.

    Attributes:
        sample_type: of its samples.
        count: how many samples can be read.
        first_t_ns, last_t_ns: earliest and latest instant, ns on the rig's clock; 0 if there are none.
        rate_hz: mean rate between these; NaN with fewer than two different instants.
        gaps: how many `seq` numbers are missing between the lowest and the highest.
        repeated: how many stand in the file once more, by their `order`.
        unsorted: how many samples describe an instant before their predecessor's. None on wires: what passes there
            stands in the order in which the computer handled it, and a frame may have arrived long before.
        dropped: how many the recorder itself has lost.
    """

    sample_type: type[Sample]
    count: int
    first_t_ns: int
    last_t_ns: int
    rate_hz: float
    gaps: int
    repeated: int
    unsorted: int
    dropped: int


def unexplained_gaps(topics: Mapping[str, TopicSummary]) -> list[str]:
    """Samples that are not there though the recorder has not dropped them, by topic."""
    return [
        f"missing: {topic.gaps - topic.dropped} samples of {name!r}, whose numbers are skipped"
        for name, topic in topics.items()
        if topic.gaps > topic.dropped
    ]


class Survey:
    """Counts messages as they go by.

    Attributes:
        arrivals: order numbers of the inbox of each estimator host.
    """

    def __init__(self) -> None:
        self.arrivals: dict[str, list[int]] = {}
        self._dropped: dict[str, int] = {}
        self._counts: dict[str, _Count] = {}

    def counter(self, reader: ChannelReader) -> Action[None]:
        """What counts the messages of a channel."""
        if isinstance(reader, NoteReader):
            return lambda data, _sequence: self._take_note(reader.note(data))

        def count(data: Any, sequence: int) -> None:
            stamps = reader.stamps(data, sequence)
            if stamps is not None and reader.sample_type is not None:
                self._count(reader.topic, reader.sample_type, stamps)

        return count

    def count_frame(self, topic: str, stamps: Stamps) -> None:
        """Count a frame that was read before."""
        self._count(topic, Frame, stamps)

    def _count(self, topic: str, sample_type: type[Sample], stamps: Stamps) -> None:
        counted = self._counts.get(topic)
        if counted is None:
            counted = self._counts[topic] = _Count(sample_type)
        counted.add(*stamps)

    def _take_note(self, note: Arrivals | Drops) -> None:
        if isinstance(note, Arrivals):
            self.arrivals.setdefault(note.host, []).extend(note.orders)
        else:
            self._dropped[note.topic] = note.dropped

    def topics(self) -> Mapping[str, TopicSummary]:
        """The summaries so far, in the order of each topic's first sample."""
        found = {topic: count.summary(self._dropped.get(topic, 0)) for topic, count in self._counts.items()}
        lost = {topic: number for topic, number in self._dropped.items() if topic not in found}
        return found | {topic: _Count(Sample).summary(number) for topic, number in lost.items()}


class _Count:
    """The running figures of one topic."""

    __slots__ = (
        "count", "first_ns", "first_seq", "last_ns", "last_seq", "orders", "previous_ns", "sample_type", "unsorted"
    )  # fmt: skip

    def __init__(self, sample_type: type[Sample]) -> None:
        self.sample_type = sample_type
        self.count = self.unsorted = self.first_seq = 0
        self.last_seq = -1
        self.first_ns = self.last_ns = self.previous_ns = 0
        self.orders = array("q")

    def add(self, t_ns: int, seq: int, order: int) -> None:
        if self.count:
            self.unsorted += t_ns < self.previous_ns
            self.first_ns = min(self.first_ns, t_ns)
            self.last_ns = max(self.last_ns, t_ns)
            if seq > self.last_seq:  # usually; threads publish side by side, and may overtake each other
                self.last_seq = seq
            elif seq < self.first_seq:
                self.first_seq = seq
        else:
            self.first_ns = self.last_ns = t_ns
            self.first_seq = self.last_seq = seq
        self.count += 1
        self.orders.append(order)
        self.previous_ns = t_ns

    def summary(self, dropped: int) -> TopicSummary:
        span_ns = self.last_ns - self.first_ns
        repeated = self.count - len(np.unique(self.orders))
        return TopicSummary(
            sample_type=self.sample_type, count=self.count, first_t_ns=self.first_ns, last_t_ns=self.last_ns,
            rate_hz=(self.count - 1) * NS_PER_S / span_ns if span_ns else float("nan"),
            gaps=max(0, self.last_seq - self.first_seq + 1 - self.count + repeated), repeated=repeated,
            unsorted=0 if self.sample_type is WireTraffic else self.unsorted, dropped=dropped,
        )  # fmt: skip
