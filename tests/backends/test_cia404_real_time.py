"""A force sensor whose frames come in a thread of their own."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from microdrivers.core.clock import SystemClock
from microdrivers.core.samples import ForceSample
from microdrivers.devices.force_sensor import STALE, UNTARED
from tests.backends.cia404_bench import ForceBench

pytestmark = pytest.mark.xdist_group("real_time")


@pytest.fixture(params=[False, True], ids=["event timer", "sync"])
def bench(request: pytest.FixtureRequest) -> Iterator[ForceBench]:
    clock = SystemClock()
    with ForceBench(clock=clock, sync=request.param, timeout_s=0.5).opened() as bench:
        bench.amplifier.force_uN = lambda t_s: t_s % 1000
        yield bench
    clock.close()
    clock.check()


def test_samples_come_in_order_while_others_read(bench: ForceBench) -> None:
    reads: list[ForceSample] = []
    with bench.sensor.stream(200.0):
        readers = [
            threading.Thread(target=lambda: reads.extend(bench.sensor.read() for _ in range(5))) for _ in range(2)
        ]
        for reader in readers:
            reader.start()
        for reader in readers:
            reader.join(5.0)
        bench.clock.sleep(0.2)
    assert len(reads) == 10
    streamed = [sample for sample in bench.samples if sample not in reads]
    assert len(streamed) >= 20
    assert [sample.raw_uN for sample in streamed] == sorted(sample.raw_uN for sample in streamed)
    assert bench.amplifier.sent_ns
    count = len(bench.amplifier.sent_ns)
    bench.clock.sleep(0.05)
    assert len(bench.amplifier.sent_ns) == count


def test_a_subscriber_may_read_and_stop(bench: ForceBench) -> None:
    answers: list[ForceSample] = []

    def once(_: ForceSample) -> None:
        if not answers:
            answers.append(bench.samples[0])
            bench.sensor.stop()
            answers.append(bench.sensor.read())

    bench.sensor.topic.subscribe(once)
    with bench.sensor.stream(100.0):
        bench.clock.sleep(0.3)
    assert len(answers) == 2
    assert bench.sensor.topic.error_count == 0


def test_silence_is_stale_and_ends(bench: ForceBench) -> None:
    with bench.sensor.stream(100.0):
        bench.clock.sleep(0.1)
        bench.amplifier.silent = True
        wait_for(bench, lambda: any(STALE in sample.flags for sample in bench.samples))
        bench.amplifier.silent = False
        wait_for(bench, lambda: "link_back" in bench.kinds)
    assert bench.samples[-1].flags <= {UNTARED, STALE}


def wait_for(bench: ForceBench, reached: object) -> None:
    assert callable(reached)
    for _ in range(500):
        if reached():
            return
        bench.clock.sleep(0.01)
    pytest.fail("it did not happen within 5 s")
