"""The running, robust scatter of a series of readings about their own local trend."""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections import deque

_MEDIAN_TO_SIGMA = 1.4826
_MEAN_TO_SIGMA = math.sqrt(math.pi / 2.0)
_FEWEST = 8


class RunningScatter:
    """Standard deviation of one reading, from how far each lies off the straight line between its neighbours.

    A ramp adds nothing and a jump hardly anything, for the median is taken; where most readings repeat exactly, as
    behind a coarse quantisation, the mean. Noise is taken as independent from reading to reading; see `ScatterOfMeans`
    for a sensor that filters more slowly than it is read.

    Args:
        length: deviations that are remembered.
    """

    def __init__(self, *, length: int = 255) -> None:
        self._newest: deque[tuple[float, float]] = deque(maxlen=2)
        self._deviations: deque[float] = deque()
        self._sorted: list[float] = []
        self._length = length

    def add(self, time: float, value: float) -> None:
        """Take a reading at an instant in any unit; one that is not newer than its predecessor or NaN is ignored."""
        newest = self._newest
        if math.isnan(value) or (newest and time <= newest[-1][0]):
            return
        if len(newest) == 2:
            (before, first), (middle, second) = newest
            share = (middle - before) / (time - before)
            off = second - (1.0 - share) * first - share * value
            self._remember(abs(off) / math.sqrt(1.0 + (1.0 - share) ** 2 + share * share))
        newest.append((time, value))

    @property
    def sigma(self) -> float:
        """Standard deviation of one reading, in its own unit; NaN until ten readings have come."""
        values = self._sorted
        if len(values) < _FEWEST:
            return math.nan
        middle = values[len(values) // 2]
        return _MEDIAN_TO_SIGMA * middle if middle > 0.0 else _MEAN_TO_SIGMA * sum(values) / len(values)

    def _remember(self, deviation: float) -> None:
        if len(self._deviations) == self._length:
            oldest = self._deviations.popleft()
            del self._sorted[bisect_left(self._sorted, oldest)]
        self._deviations.append(deviation)
        insort(self._sorted, deviation)


class ScatterOfMeans:
    """Standard deviation of a mean over some time, from how such means scatter from one to the next.

    Readings that follow each other faster than the sensor's bandwidth are alike: the mean of n of them scatters by more
    than the n-th root says. How much more needs no knowledge of the filter where the means themselves are watched.

    Attributes:
        length_ns: the time over which is averaged; 0 takes each reading for itself.
    """

    def __init__(self) -> None:
        self.length_ns = 0
        self._scatter = RunningScatter()
        self._begin_ns = 0
        self._values: list[float] = []
        self._times_ns: list[int] = []
        self._means = 0
        self._averaged = 0

    def add(self, t_ns: int, value: float) -> None:
        """Take a reading, in order of time; NaN is ignored."""
        if math.isnan(value):
            return
        if self._values and t_ns - self._begin_ns > self.length_ns:
            n = len(self._values)
            self._scatter.add(sum(self._times_ns) / n, sum(self._values) / n)
            self._means += 1
            self._averaged += n
            self._values.clear()
            self._times_ns.clear()
        if not self._values:
            self._begin_ns = t_ns
        self._values.append(value)
        self._times_ns.append(t_ns)

    def sigma_of_mean(self, readings: int) -> float:
        """Standard deviation of the mean of as many readings, near as many as there usually are; NaN while unknown."""
        return self._scatter.sigma * math.sqrt(self._averaged / (self._means * readings)) if self._means else math.nan
