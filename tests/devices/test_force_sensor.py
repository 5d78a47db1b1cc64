"""The tare, and what makes a reading invalid; on a sensor that reads what a test tells it."""

import json
import math
from collections.abc import Callable

import numpy as np
import pydantic
import pytest

from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.errors import LinkTimeout, OutOfRange, RefusedError, SaturatedData
from microdrivers.core.samples import ForceSample
from microdrivers.core.units import NS_PER_S, Range
from microdrivers.devices.base import DeviceInfo
from microdrivers.devices.force_sensor import DISCONNECTED, SATURATED, STALE, UNTARED, ForceSensor
from microdrivers.devices.force_sensor_settings import ForceSensorSettings

NOISE_UN = 0.05


class Told(ForceSensor):
    """Reads `raw_uN(t_s)` plus noise."""

    def __init__(self, raw_uN: Callable[[float], float]) -> None:
        super().__init__("probe_force", clock=SimulatedClock(), bus=Bus())
        self.raw_uN = raw_uN
        self.further: frozenset[str] = frozenset()
        self.range_uN = Range(-2000.0, 2000.0)
        self.resolution_uN = 0.01
        self.bandwidth_hz = 500.0
        self.stream_rate_hz = 1000.0
        self._random = np.random.default_rng(1)

    def _connect(self) -> None:
        """There is no line."""

    def _identify(self) -> DeviceInfo:
        return DeviceInfo(driver="told")

    def _close(self) -> None:
        """There is no line."""

    def _read(self) -> ForceSample:
        t_ns = self.clock.now_ns()
        raw = self.raw_uN(t_ns / NS_PER_S) + self._random.normal(0.0, NOISE_UN)
        return self._sample(raw, t_ns=t_ns, dt_ns=0, t_source="device", flags=self.further)


def opened(raw_uN: Callable[[float], float]) -> Told:
    sensor = Told(raw_uN)
    sensor.open()
    return sensor


def test_the_tare_is_subtracted_and_raw_stays_raw():
    sensor = opened(lambda _: 12.0)
    assert sensor.read().flags == {UNTARED}
    tare = sensor.tare(0.5)
    assert tare.n == pytest.approx(500, abs=2)
    assert tare.offset_uN == pytest.approx(12.0, abs=5 * NOISE_UN / math.sqrt(500))
    assert tare.sigma_uN == pytest.approx(NOISE_UN, rel=0.15)
    sample = sensor.read()
    assert sample.flags == frozenset()
    assert sample.force_uN == sample.raw_uN - sample.tare_uN
    assert abs(sample.force_uN) < 6 * NOISE_UN
    assert sample.raw_uN == pytest.approx(12.0, abs=6 * NOISE_UN)


def test_tares_are_remembered_and_can_be_cleared():
    sensor = opened(lambda t_s: 3.0 if t_s < 0.3 else 5.0)
    sensor.tare(0.2)
    sensor.clock.sleep(0.2)
    sensor.tare(0.2)
    assert [round(tare.offset_uN) for tare in sensor.tares] == [3, 5]
    sensor.clear_tare()
    assert sensor.tared is None
    assert sensor.read().tare_uN == 0.0
    assert len(sensor.tares) == 2


def test_no_zero_is_taken_while_the_reading_drifts():
    sensor = opened(lambda t_s: 0.5 * t_s)
    with pytest.raises(RefusedError, match="drifts"):
        sensor.tare(0.5)
    assert sensor.tared is None


def test_a_drift_that_cannot_be_told_from_noise_is_none():
    sensor = opened(lambda t_s: 0.004 * t_s)
    sensor.tare(0.5)


def test_no_zero_is_taken_at_the_end_of_the_range():
    sensor = opened(lambda _: 2100.0)
    with pytest.raises(SaturatedData, match="SATURATED"):
        sensor.tare(0.2)


def test_a_refused_zero_leaves_the_old_one_in_use():
    sensor = opened(lambda t_s: 1.0 if t_s < 0.25 else 2100.0)
    old = sensor.tare(0.2)
    sensor.clock.sleep(0.1)
    with pytest.raises(SaturatedData):
        sensor.tare(0.2)
    assert sensor.tared is old


@pytest.mark.parametrize(("raw_uN", "further", "flag"), [(2000.5, (), SATURATED), (0.0, (DISCONNECTED,), DISCONNECTED)])
def test_an_invalid_reading_is_no_number(raw_uN, further, flag):
    sensor = opened(lambda _: raw_uN)
    sensor.further = frozenset(further)
    sample = sensor.read()
    assert flag in sample.flags
    assert math.isnan(sample.force_uN)


def test_a_reading_that_is_no_number_is_invalid():
    sample = opened(lambda _: math.nan).read()
    assert SATURATED in sample.flags
    assert math.isnan(sample.force_uN)


def test_a_tare_needs_readings_and_a_sensible_time():
    sensor = opened(lambda _: 0.0)
    with pytest.raises(OutOfRange):
        sensor.tare(0.0)
    sensor.stream_rate_hz = 20.0
    with pytest.raises(LinkTimeout, match="readings"):
        sensor.tare(0.1)


@pytest.mark.parametrize("flag", [DISCONNECTED, STALE])
def test_where_there_is_no_sensor_nothing_is_saturated(flag):
    sensor = opened(lambda _: math.nan)
    sensor.further = frozenset({flag})
    assert sensor.read().flags == {flag, UNTARED}


def test_a_stream_without_readings_says_so_until_they_are_back():
    def raw_uN(t_s):
        if 0.3 <= t_s < 0.6:
            raise LinkTimeout("no answer")
        return 1.0

    sensor = opened(raw_uN)
    samples, kinds = [], []
    sensor.topic.subscribe(samples.append)
    sensor.events.subscribe(lambda event: kinds.append(event.kind))
    with sensor.stream(100.0):
        sensor.clock.run_for(1.0)
    stale = [sample for sample in samples if STALE in sample.flags]
    assert kinds == ["link_lost", "link_back"]
    assert len(samples) == 101
    assert len(stale) == 30
    assert all(0.3 <= sample.t_ns / NS_PER_S < 0.6 and math.isnan(sample.force_uN) for sample in stale)
    assert [sample.seq for sample in samples] == list(range(101))


# ---------------------------------------------------------------------- the rig file

SECTION = {
    "range_uN": Range(-2000.0, 2000.0), "resolution_uN": 0.01, "bandwidth_hz": 500.0, "stiffness_uN_per_um": 1000.0,
    "axis": (0.0, 0.6, 0.8), "rate_hz": 1000.0,
}  # fmt: skip


def test_the_rig_file_states_what_the_sensor_is():
    sensor = opened(lambda _: 0.0)
    settings = ForceSensorSettings.model_validate_json(json.dumps(SECTION | {"carried_by": "probe_stage"}))
    sensor._adopt(settings)
    assert (sensor.range_uN, sensor.stream_rate_hz) == (Range(-2000.0, 2000.0), 1000.0)
    assert math.hypot(*sensor.axis) == pytest.approx(1.0, abs=1e-12)


def test_a_rounded_unit_vector_is_one():
    axis = ForceSensorSettings.model_validate(SECTION | {"axis": (0.707, 0.0, 0.707)}).axis
    assert math.hypot(*axis) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"axis": (0.0, 0.0, 2.0)}, "length 2; write a unit vector"),
        ({"axis": (0.0, 0.0, 0.0)}, "unit vector"),
        ({"range_uN": Range(5.0, 5.0)}, "empty or runs backwards"),
        ({"resolution_uN": 0.0}, "greater than 0"),
        ({"carried_by": ""}, "at least 1 character"),
    ],
)
def test_what_cannot_be(changes, match):
    with pytest.raises(pydantic.ValidationError, match=match):
        ForceSensorSettings.model_validate(SECTION | changes)
