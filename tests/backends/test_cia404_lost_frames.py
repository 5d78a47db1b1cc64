"""Frames of an amplifier that others keep waiting are late, and not lost."""

from __future__ import annotations

import itertools

import pytest

from microdrivers.fakes.can import Due, Frame
from tests.backends.cia404_bench import ForceBench


class Bursts:
    """Sends several frames of the highest rank at once, again and again."""

    def __init__(self, frames: int, every_ns: int) -> None:
        self._frames = frames
        self._every_ns = every_ns
        self._due_ns = 0

    def receive(self, frame: Frame, t_ns: int) -> list[Due]:
        return []

    def advance(self, t_ns: int) -> list[Due]:
        due_ns, self._due_ns = self._due_ns, self._due_ns + self._every_ns
        return [Due(due_ns, Frame(0x001, bytes(8))) for _ in range(self._frames)]

    def next_event_ns(self) -> int | None:
        return self._due_ns


def lost_between_bursts(bench: ForceBench) -> int:
    """What waits in a burst counts as lost until it has come."""
    looks = []
    for _ in range(3):
        bench.clock.run_for(0.0049)
        looks.append(bench.sensor.lost_frames)
    return min(looks)


@pytest.mark.parametrize(("frames", "every_ns"), [(3, 7_310_000), (6, 9_870_000), (12, 31_007_000)])
def test_a_delay_is_no_loss_and_hides_none(frames: int, every_ns: int) -> None:
    with ForceBench(others=[Bursts(frames, every_ns)]).opened() as bench, bench.sensor.stream(1000.0):
        bench.clock.run_for(3.0)
        arrivals = [sample.t_ns for sample in bench.samples]
        latest_ms = max(later - sooner for sooner, later in itertools.pairwise(arrivals)) / 1e6
        assert latest_ms > 1.4
        assert lost_between_bursts(bench) == 0
        for before, dropped in ((0, 3), (3, 1)):
            bench.amplifier.drop = dropped
            bench.clock.run_for(0.5)
            assert lost_between_bursts(bench) == before + dropped
