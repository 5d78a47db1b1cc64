"""Brings samples of different rates to one instant: interpolates between two neighbours, never extrapolates."""

from __future__ import annotations

from collections import deque
from typing import Generic

import msgspec

from microdrivers.core.samples import Sample, SampleT, XYThetaSample
from microdrivers.core.units import NS_PER_S


class Neighbours(Generic[SampleT]):
    """The recent samples of one stream, to find the two around an instant."""

    def __init__(self, *, length: int = 512) -> None:
        self._samples: deque[SampleT] = deque(maxlen=length)

    def add(self, sample: SampleT) -> None:
        """Append a sample; one that is not newer than its predecessor is ignored."""
        if not self._samples or sample.t_ns > self._samples[-1].t_ns:
            self._samples.append(sample)

    def reached(self, t_ns: int) -> bool:
        """Whether a sample at or after `t_ns` has come."""
        return bool(self._samples) and self._samples[-1].t_ns >= t_ns

    def around(self, t_ns: int) -> tuple[SampleT, SampleT] | None:
        """The last sample at or before `t_ns` and the first at or after it; None if one of them is missing."""
        after: SampleT | None = None
        for sample in reversed(self._samples):
            if sample.t_ns == t_ns:
                return sample, sample
            if sample.t_ns < t_ns:
                return (sample, after) if after is not None else None
            after = sample
        return None


class PoseAt(msgspec.Struct, frozen=True):
    """A stage pose at an instant between two samples, with the velocity between them.

    `dt_ns` is the larger half-width of the two samples' times.
    """

    t_ns: int
    dt_ns: int
    x_um: float
    y_um: float
    theta_deg: float
    velocity_x_um_s: float
    velocity_y_um_s: float
    gap_ns: int


def interpolate_pose(before: XYThetaSample, after: XYThetaSample, t_ns: int) -> PoseAt:
    """The pose on the straight line between two samples.

    Raises:
        ValueError: `t_ns` does not lie between them.
    """
    gap_ns = after.t_ns - before.t_ns
    if not before.t_ns <= t_ns <= after.t_ns:
        raise ValueError("a pose is interpolated between its neighbours, never extrapolated")
    share = (t_ns - before.t_ns) / gap_ns if gap_ns else 0.0
    rate_per_s = NS_PER_S / gap_ns if gap_ns else 0.0
    dx_um, dy_um = after.x_um - before.x_um, after.y_um - before.y_um
    return PoseAt(
        t_ns=t_ns,
        dt_ns=max(before.dt_ns, after.dt_ns),
        x_um=before.x_um + share * dx_um,
        y_um=before.y_um + share * dy_um,
        theta_deg=before.theta_deg + share * (after.theta_deg - before.theta_deg),
        velocity_x_um_s=dx_um * rate_per_s,
        velocity_y_um_s=dy_um * rate_per_s,
        gap_ns=gap_ns,
    )


class Synchroniser(Generic[SampleT]):
    """Holds samples back until every reference stream brackets their instant.

    Args:
        references: names of the streams that must bracket a sample.
        max_waiting: samples that may wait; the oldest is given up and counted in `unmatched` beyond that.
    """

    def __init__(self, references: tuple[str, ...], *, max_waiting: int = 64) -> None:
        self._streams: dict[str, Neighbours[Sample]] = {name: Neighbours() for name in references}
        self._waiting: deque[SampleT] = deque()
        self._max_waiting = max_waiting
        self.unmatched = 0

    @property
    def waiting(self) -> int:
        """How many samples wait for a reference after them."""
        return len(self._waiting)

    def add_reference(self, name: str, sample: Sample) -> None:
        """Take a sample of a reference stream."""
        self._streams[name].add(sample)

    def add(self, sample: SampleT) -> None:
        """Take a sample that is to be matched."""
        self._waiting.append(sample)
        if len(self._waiting) > self._max_waiting:
            self._waiting.popleft()
            self.unmatched += 1

    def release(self) -> list[tuple[SampleT, dict[str, tuple[Sample, Sample]]]]:
        """Samples whose instant is bracketed by every reference, oldest first, each with its neighbours.

        A sample older than all reference samples can never be bracketed: it is given up and counted.
        """
        released = []
        while self._waiting and all(stream.reached(self._waiting[0].t_ns) for stream in self._streams.values()):
            sample = self._waiting.popleft()
            neighbours: dict[str, tuple[Sample, Sample]] = {}
            for name, stream in self._streams.items():
                pair = stream.around(sample.t_ns)
                if pair is not None:
                    neighbours[name] = pair
            if len(neighbours) == len(self._streams):
                released.append((sample, neighbours))
            else:
                self.unmatched += 1
        return released
