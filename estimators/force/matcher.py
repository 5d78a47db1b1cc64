"""Brings what the camera sees and what the sensor feels to one instant: a frame's force is that of its exposure."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right, insort
from collections import Counter, deque
from itertools import pairwise
from typing import NamedTuple

from microdrivers.core.contact_samples import DeformationSample, IndentationSample
from microdrivers.core.errors import OutOfRange
from microdrivers.core.samples import ForceSample, Sample
from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.estimators.force.scatter import ScatterOfMeans

_SENSOR_FAULTS = ("NOT_MEASURED", "DISCONNECTED", "SATURATED", "STALE")
_REMEMBERED = 65536
"""Frames: 36 min at 30 Hz."""


class MatcherSettings(NamedTuple):
    """When a frame is matched.

    Attributes:
        lateness_s: readings may come this much later than newer ones of the same sensor; a frame waits as long.
        max_gap_s: a frame between readings further apart than this is given up.
        max_waiting: frames that may wait for readings. max_readings: readings that may wait for frames.
    """

    lateness_s: float = 0.005
    max_gap_s: float = 0.1
    max_waiting: int = 64
    max_readings: int = 8192

    def check(self) -> None:
        """Refuse times and numbers with which no frame could be matched.

        Raises:
            OutOfRange: a time is negative or not finite, `max_gap_s` is 0, or not even one frame and two readings may
                wait.
        """
        if not 0.0 <= self.lateness_s < math.inf:
            raise OutOfRange(f"lateness_s is {self.lateness_s}", remedy="give a time of 0 s or more")
        if not 0.0 < self.max_gap_s < math.inf:
            raise OutOfRange(f"max_gap_s is {self.max_gap_s}", remedy="give a time above 0 s")
        if not (self.max_waiting >= 1 and self.max_readings >= 2):
            raise OutOfRange(
                f"{self.max_waiting} frames and {self.max_readings} readings may wait",
                remedy="let at least one frame and the two readings around it wait",
            )


class GivenUp(NamedTuple):
    """A frame that was not matched, and why; `force_uN` is where a saturated sensor stood, NaN for other reasons."""

    t_ns: int
    reason: str
    force_uN: float


class IndentationMatcher:
    """Deformations and forces in, indentations out, each with the mean force over the exposure of its frame.

    It is that of a straight line through the readings within: few of them need not lie evenly about mid-exposure.

    A frame waits until readings lie on either side of its exposure. If none lies within it, because the sensor is
    slower than that, the force at mid-exposure is interpolated between the two around it; nothing is extrapolated.
    How the two streams interleave changes nothing in what comes out; within the sensor's stream, readings may come
    out of order by `lateness_s`. The stated scatter of a force is that of means over as long as the exposure.

    `unmatched` counts the frames that were given up, by reason: LOST (the contact point was not seen), SATURATED,
    NOT_MEASURED, STALE, DISCONNECTED or INVALID (such a reading lies in the exposure, or beside it where one would
    have to interpolate), GAP (readings too far apart), UNBRACKETED (older than all readings), OVERFLOW (too many were
    waiting), OUT_OF_ORDER (older than a frame that has been dealt with). `given_up` holds the newest of them.

    Args:
        settings: when a frame is matched.
        device: name under which the samples are published.

    Raises:
        OutOfRange: a setting makes no sense; see `MatcherSettings.check`.
    """

    def __init__(self, settings: MatcherSettings | None = None, *, device: str = "indentation") -> None:
        self.settings = settings or MatcherSettings()
        self.settings.check()
        self.device = device
        self.unmatched: Counter[str] = Counter()
        self.given_up: deque[GivenUp] = deque(maxlen=_REMEMBERED)
        self.late_readings = 0
        self._lateness_ns = round(self.settings.lateness_s * NS_PER_S)
        self._max_gap_ns = round(self.settings.max_gap_s * NS_PER_S)
        self._frames: list[DeformationSample] = []
        self._readings: list[ForceSample] = []
        self._newest_ns: int | None = None
        self._done_ns: int | None = None
        self._scatter = ScatterOfMeans()
        self._scattered = 0
        self._seq = 0

    @property
    def waiting(self) -> int:
        """Frames whose readings have not all come yet."""
        return len(self._frames)

    def update(self, sample: Sample) -> list[IndentationSample]:
        """Take one sample of either stream; others are ignored.

        Returns:
            The indentations that it completed, oldest first.
        """
        if isinstance(sample, DeformationSample):
            self._take_frame(sample)
        elif isinstance(sample, ForceSample):
            self._take_reading(sample)
        return self._completed(self._lateness_ns)

    def finish(self) -> list[IndentationSample]:
        """No more samples come: match the frames that wait only for readings that might be late.

        Returns:
            The last indentations, oldest first. Frames that end after the newest reading are UNBRACKETED.
        """
        matched = self._completed(0)
        for frame in self._frames:
            self._give_up(frame, "UNBRACKETED")
            self._done_ns = frame.t_ns
        self._frames.clear()
        return matched

    def _completed(self, lateness_ns: int) -> list[IndentationSample]:
        matched = []
        while self._frames and self._is_complete(self._frames[0], lateness_ns):
            frame = self._frames.pop(0)
            found = self._match(frame)
            self._done_ns = frame.t_ns
            if found is not None:
                matched.append(found)
        return matched

    # ------------------------------------------------------------------ taking

    def _take_frame(self, frame: DeformationSample) -> None:
        if self._done_ns is not None and frame.t_ns <= self._done_ns:
            self._give_up(frame, "OUT_OF_ORDER")
            return
        insort(self._frames, frame, key=_instant)
        if len(self._frames) > self.settings.max_waiting:
            self._done_ns = self._frames[0].t_ns
            self._give_up(self._frames.pop(0), "OVERFLOW")

    def _take_reading(self, reading: ForceSample) -> None:
        if self._newest_ns is not None and reading.t_ns < self._newest_ns - self._lateness_ns:
            self.late_readings += 1
            return
        if self._newest_ns is None or reading.t_ns > self._newest_ns:
            self._newest_ns = reading.t_ns
        insort(self._readings, reading, key=_instant)
        surplus = len(self._readings) - self.settings.max_readings
        if surplus > 0:
            self._forget(surplus)

    def _is_complete(self, frame: DeformationSample, lateness_ns: int) -> bool:
        """Whether no reading that matters can come any more."""
        if not frame.found:
            return True
        return self._newest_ns is not None and self._newest_ns >= _end_ns(frame) + lateness_ns

    # ------------------------------------------------------------------ one frame

    def _match(self, frame: DeformationSample) -> IndentationSample | None:
        if not frame.found:
            self._give_up(frame, "LOST")
            return None
        begin_ns, end_ns = 2 * frame.t_ns - _end_ns(frame), _end_ns(frame)
        first = bisect_left(self._readings, begin_ns, key=_instant)
        last = bisect_right(self._readings, end_ns, key=_instant)
        after = bisect_left(self._readings, end_ns, key=_instant)
        # Of an instant's several readings, any will do.
        before = min(bisect_right(self._readings, begin_ns, key=_instant) - 1, after)
        if before < 0:
            self._give_up(frame, "UNBRACKETED")
            return None
        within = self._readings[first:last]
        around = self._readings[before : after + 1]
        self._scatter.length_ns = end_ns - begin_ns
        self._settle(last)
        reason = _fault(within or around)
        if not reason and any(b.t_ns - a.t_ns > self._max_gap_ns for a, b in pairwise(around)):
            reason = "GAP"
        matched = None
        if reason:
            self._give_up(frame, reason, _stood_at_uN(around) if reason == "SATURATED" else math.nan)
        else:
            matched = self._sample(frame, within, around[0], around[-1])
        self._forget(before)
        return matched

    def _give_up(self, frame: DeformationSample, reason: str, force_uN: float = math.nan) -> None:
        self.unmatched[reason] += 1
        self.given_up.append(GivenUp(frame.t_ns, reason, force_uN))

    def _sample(
        self, frame: DeformationSample, within: list[ForceSample], before: ForceSample, after: ForceSample
    ) -> IndentationSample:
        if within:
            force_uN, widened = _at_middle(within, frame.t_ns)
            sigma_uN = widened * self._scatter.sigma_of_mean(len(within))
            used = within
        else:
            share = (frame.t_ns - before.t_ns) / (after.t_ns - before.t_ns)
            force_uN = (1.0 - share) * before.force_uN + share * after.force_uN
            sigma_uN = math.hypot(1.0 - share, share) * self._scatter.sigma_of_mean(1)
            used = [before, after]
        seq, self._seq = self._seq, self._seq + 1
        return IndentationSample(
            t_ns=frame.t_ns,
            dt_ns=frame.dt_ns,
            t_source="computed",
            device=self.device,
            seq=seq,
            flags=frame.flags.union(*(reading.flags for reading in used)),
            deformation_um=frame.deformation_um,
            deformation_sigma_um=frame.sigma_um,
            force_uN=force_uN,
            force_sigma_uN=sigma_uN,
            readings=len(within),
            frame_seq=frame.frame_seq,
        )

    def _settle(self, until: int) -> None:
        """Let the scatter see the readings before index `until`, in order of time."""
        for reading in self._readings[self._scattered : until]:
            self._scatter.add(reading.t_ns, reading.force_uN)
        self._scattered = max(self._scattered, until)

    def _forget(self, count: int) -> None:
        """Drop the oldest readings."""
        self._settle(count)
        del self._readings[:count]
        self._scattered -= count


def _instant(sample: Sample) -> int:
    return sample.t_ns


def _end_ns(frame: DeformationSample) -> int:
    return frame.t_ns + round(frame.exposure_ms * NS_PER_MS / 2.0)


def _at_middle(readings: list[ForceSample], middle_ns: int) -> tuple[float, float]:
    """Mean force of an exposure by a straight line through its readings, which need not lie evenly about its middle.

    The second is by how much that scatters more than the readings' mean does.
    """
    n = len(readings)
    mean_uN = sum(reading.force_uN for reading in readings) / n
    mean_ns = sum(reading.t_ns - middle_ns for reading in readings) / n
    off_ns = [reading.t_ns - middle_ns - mean_ns for reading in readings]
    spread = sum(t * t for t in off_ns)
    if spread == 0.0:
        return mean_uN, 1.0
    slope = sum(t * reading.force_uN for t, reading in zip(off_ns, readings, strict=True)) / spread
    return mean_uN - slope * mean_ns, math.sqrt(1.0 + n * mean_ns * mean_ns / spread)


def _fault(readings: list[ForceSample]) -> str:
    """What is wrong with the first reading that is not valid; empty if all are."""
    for reading in readings:
        for flag in _SENSOR_FAULTS:
            if flag in reading.flags:
                return flag
        if not math.isfinite(reading.force_uN):
            return "INVALID"
    return ""


def _stood_at_uN(readings: list[ForceSample]) -> float:
    """Where a sensor stood that was at the end of its range."""
    full = [reading.raw_uN - reading.tare_uN for reading in readings if "SATURATED" in reading.flags]
    return sum(full) / len(full) if full else math.nan
