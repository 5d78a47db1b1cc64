"""What every force sensor must do. The bench presses on the tip with a force that it knows."""

from __future__ import annotations

import math

import pytest

from microdrivers.core.errors import SaturatedData
from microdrivers.core.samples import ForceSample
from microdrivers.devices.force_sensor import DISCONNECTED, SATURATED, UNTARED
from tests.conformance.checks import Suite
from tests.conformance.tool_bench import ForceBench

SUITE = Suite()


def _streamed(bench: ForceBench, seconds: float) -> list[ForceSample]:
    samples: list[ForceSample] = []
    subscription = bench.sensor.topic.subscribe(samples.append)
    with bench.sensor.stream(bench.sensor.stream_rate_hz):
        bench.clock.sleep(seconds)
    subscription.cancel()
    return samples


def _mean(samples: list[ForceSample]) -> float:
    """Of the valid readings, nearly all: in real time the computer that plays the device may pause."""
    valid = [sample.force_uN for sample in samples if not math.isnan(sample.force_uN)]
    assert len(valid) >= 0.8 * len(samples)
    return sum(valid) / len(valid)


@SUITE.check
def shows_the_force_that_presses(bench: ForceBench) -> None:
    """Sign, unit and size, after a tare without load."""
    bench.press(0.0)
    bench.clock.sleep(bench.settle_s)
    bench.sensor.tare(bench.tare_s)
    for force_uN in (20.0, 80.0, 0.0):
        bench.press(force_uN)
        bench.clock.sleep(bench.settle_s)
        found = _mean(_streamed(bench, bench.tare_s))
        assert found == pytest.approx(bench.true_uN(bench.clock.now_ns()), abs=bench.noise_uN + 0.01 * force_uN)


@SUITE.check
def keeps_raw_tare_and_force_apart(bench: ForceBench) -> None:
    bench.press(0.0)
    bench.clock.sleep(bench.settle_s)
    assert bench.sensor.read().flags == {UNTARED}
    tare = bench.sensor.tare(bench.tare_s)
    sample = bench.sensor.read()
    assert sample.flags == frozenset()
    assert sample.tare_uN == tare.offset_uN
    assert sample.force_uN == sample.raw_uN - sample.tare_uN
    assert abs(sample.force_uN) <= 10 * bench.noise_uN
    bench.sensor.clear_tare()
    assert bench.sensor.read().force_uN == pytest.approx(sample.raw_uN, abs=10 * bench.noise_uN)


@SUITE.check
def streams_at_its_rate_in_order(bench: ForceBench) -> None:
    samples = _streamed(bench, 1.0)
    rate_hz = bench.sensor.stream_rate_hz
    assert len(samples) == pytest.approx(rate_hz, rel=0.1, abs=2)
    assert [sample.seq for sample in samples] == list(range(samples[0].seq, samples[0].seq + len(samples)))
    times_ns = [sample.t_ns for sample in samples]
    assert times_ns == sorted(times_ns)
    assert max(sample.dt_ns for sample in samples) <= 2e9 / rate_hz + 2e7


@SUITE.check
def says_when_it_is_saturated(bench: ForceBench) -> None:
    bench.press(2.0 * bench.sensor.range_uN.max)
    bench.clock.sleep(bench.settle_s)
    sample = bench.sensor.read()
    assert SATURATED in sample.flags
    assert math.isnan(sample.force_uN)
    with pytest.raises(SaturatedData):
        bench.sensor.tare(bench.tare_s)


@SUITE.check
def says_when_the_sensor_is_gone(bench: ForceBench) -> None:
    bench.need(bench.disconnect)()
    bench.clock.sleep(max(1.0, bench.settle_s))
    last = _streamed(bench, 1.0)[-1]
    assert DISCONNECTED in last.flags
    assert math.isnan(last.force_uN)


@SUITE.check
def keeps_the_old_zero_when_a_new_one_is_refused(bench: ForceBench) -> None:
    bench.press(0.0)
    bench.clock.sleep(bench.settle_s)
    old = bench.sensor.tare(bench.tare_s)
    bench.press(2.0 * bench.sensor.range_uN.max)
    bench.clock.sleep(bench.settle_s)
    with pytest.raises(SaturatedData):
        bench.sensor.tare(bench.tare_s)
    assert bench.sensor.tared is old
