"""What a recording holds, topic by topic."""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

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
        usual_rate_hz: that of the median interval from one instant to the next, so that pauses do not count; of a long
            recording, of a few thousand intervals, evenly spread. NaN as above.
        longest_gap_s: longest time from one instant to the next; NaN as above.
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
    usual_rate_hz: float
    longest_gap_s: float
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


_MOST_INTERVALS = 8192


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
        "count", "every", "first_ns", "first_seq", "intervals_ns", "last_ns", "last_seq", "longest_ns", "orders",
        "previous_ns", "sample_type", "steps", "unsorted",
    )  # fmt: skip

    def __init__(self, sample_type: type[Sample]) -> None:
        self.sample_type = sample_type
        self.count = self.unsorted = self.first_seq = 0
        self.last_seq = -1
        self.first_ns = self.last_ns = self.previous_ns = 0
        self.orders = array("q")
        self.longest_ns = self.steps = 0
        self.every = 1
        self.intervals_ns = array("d")
        """One of `every` intervals: enough for their median, however long the recording."""

    def add(self, t_ns: int, seq: int, order: int) -> None:
        if self.count:
            self.unsorted += t_ns < self.previous_ns
            self.first_ns = min(self.first_ns, t_ns)
            if t_ns > self.last_ns:
                self._add_interval(t_ns - self.last_ns)
                self.last_ns = t_ns
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

    def _add_interval(self, interval_ns: int) -> None:
        self.longest_ns = max(self.longest_ns, interval_ns)
        if self.steps % self.every == 0:
            self.intervals_ns.append(interval_ns)
            if len(self.intervals_ns) == _MOST_INTERVALS:
                del self.intervals_ns[1::2]
                self.every *= 2
        self.steps += 1

    def summary(self, dropped: int) -> TopicSummary:
        has_times = bool(self.intervals_ns)
        span_ns, usual_ns = self.last_ns - self.first_ns, np.median(self.intervals_ns) if has_times else math.nan
        repeated = _repeated(np.asarray(self.orders, dtype=np.int64))
        return TopicSummary(
            sample_type=self.sample_type, count=self.count, first_t_ns=self.first_ns, last_t_ns=self.last_ns,
            rate_hz=(self.count - 1) * NS_PER_S / span_ns if has_times else math.nan,
            usual_rate_hz=NS_PER_S / float(usual_ns),
            longest_gap_s=self.longest_ns / NS_PER_S if has_times else math.nan,
            gaps=max(0, self.last_seq - self.first_seq + 1 - self.count + repeated), repeated=repeated,
            unsorted=0 if self.sample_type is WireTraffic else self.unsorted, dropped=dropped,
        )  # fmt: skip


def _repeated(orders: npt.NDArray[np.int64]) -> int:
    """How many of these numbers stand there once more; those below 0 were never given."""
    if np.all(orders[1:] > orders[:-1]):
        return 0
    given = orders[orders >= 0]
    return len(given) - len(np.unique(given))
