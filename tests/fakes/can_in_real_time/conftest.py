"""A bus on a real clock; what has failed in a thread fails the test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from microdrivers.core.clock import SystemClock
from microdrivers.fakes.can import Medium, forget_medium, shared_medium


@pytest.fixture
def clock() -> Iterator[SystemClock]:
    clock = SystemClock()
    yield clock
    clock.close()
    clock.check()


@pytest.fixture
def medium(clock: SystemClock) -> Iterator[Medium]:
    medium = shared_medium("slcan:/dev/ttyACM0", clock=clock, bitrate=500_000, seed=1)
    yield medium
    forget_medium(medium.name, medium)
