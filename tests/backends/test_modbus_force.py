"""What a force sensor on an analogue-input module reads, and when."""

from __future__ import annotations

import math

import pydantic
import pytest

from microdrivers.backends.modbus_analogue import ModbusForceSettings
from microdrivers.core.units import NS_PER_MS, NS_PER_S, Range
from microdrivers.devices.force_sensor import DISCONNECTED, SATURATED, UNTARED
from tests.backends.modbus_force_bench import RIG, ForceBench, SheetModule
from tests.backends.oriental_az_peer import with_crc

ADAM = {"model": "adam-4117", "range_V": Range(-5.0, 5.0), "resolution_uN": 0.01}


def test_the_bytes_of_opening_and_reading_and_nothing_is_written() -> None:
    bench = ForceBench(SheetModule(channel=3), channel=3).opened()
    bench.sensor.read()
    assert bench.module.requests == [
        with_crc(bytes.fromhex(body)) for body in ("010340000001", "010310020001", "010400020001", "010400020001")
    ]
    assert bench.sensor.info.model == "waveshare-8ch"
    assert bench.kinds == ["opened"]


def test_the_bytes_of_opening_an_adam() -> None:
    bench = ForceBench(SheetModule(family="adam", code=9, channel=8), channel=8, **ADAM).opened()
    assert bench.module.requests == [
        with_crc(bytes.fromhex(body)) for body in ("010300D20004", "010300CF0001", "010300DC0001", "010400070001")
    ]
    assert (bench.sensor.info.vendor, bench.sensor.info.firmware) == ("Advantech", "A200B001")


@pytest.mark.parametrize("framing", ["rtu", "tcp"])
@pytest.mark.parametrize("volts", [1.0, 2.5, 2.62, 4.3])
def test_millivolts_become_micronewtons(framing: str, volts: float) -> None:
    bench = ForceBench(framing=framing).opened()
    bench.module.volts = lambda _: volts
    bench.clock.sleep(0.1)
    sample = bench.sensor.read()
    assert sample.force_uN == sample.raw_uN == pytest.approx((volts - 2.5) * 50.0, abs=0.07)
    assert sample.flags == {UNTARED}


@pytest.mark.parametrize("volts", [-1.9, 0.4, 1.0, 4.4])
def test_offset_binary_becomes_micronewtons(volts: float) -> None:
    module = SheetModule(family="adam", code=9)
    module.volts = lambda _: volts
    sample = ForceBench(module, zero_V=1.25, **ADAM).opened().sensor.read()
    assert sample.raw_uN == pytest.approx((volts - 1.25) * 50.0, abs=0.008)


@pytest.mark.parametrize(("volts", "saturated"), [(0.0, True), (0.004, False), (4.99, False), (5.0, True), (9.0, True)])
def test_the_ends_of_the_converter_are_saturated(volts: float, saturated: bool) -> None:
    bench = ForceBench(sensitivity_uN_per_V=50.0, range_uN=Range(-125.0, 125.0)).opened()
    bench.module.volts = lambda _: volts
    bench.clock.sleep(0.1)
    sample = bench.sensor.read()
    assert (SATURATED in sample.flags) == math.isnan(sample.force_uN) == saturated
    assert not math.isnan(sample.raw_uN)


@pytest.mark.parametrize(("volts", "saturated"), [(-5.0, True), (-4.999, False), (4.999, False), (5.0, True)])
def test_the_ends_of_an_adam_are_saturated(volts: float, saturated: bool) -> None:
    module = SheetModule(family="adam", code=9)
    module.volts = lambda _: volts
    sample = ForceBench(module, zero_V=0.0, **ADAM | {"range_uN": Range(-250.0, 250.0)}).opened().sensor.read()
    assert (SATURATED in sample.flags) == saturated


def test_beyond_the_sensors_own_range_is_saturated() -> None:
    bench = ForceBench().opened()
    bench.module.volts = lambda _: 4.6
    bench.clock.sleep(0.1)
    sample = bench.sensor.read()
    assert sample.flags == {SATURATED, UNTARED}
    assert sample.raw_uN == pytest.approx(105.0, abs=0.1)


@pytest.mark.parametrize(
    ("volts", "flags"), [(0.0, {DISCONNECTED}), (0.97, {DISCONNECTED}), (1.0, {SATURATED}), (1.1, set())]
)
def test_less_than_the_live_zero_is_a_broken_wire(volts: float, flags: set[str]) -> None:
    module = SheetModule(code=1)
    module.volts = lambda _: volts
    bench = ForceBench(module, range_V=Range(1.0, 5.0), range_uN=Range(-75.0, 75.0)).opened()
    sample = bench.sensor.read()
    assert sample.flags - {UNTARED} == flags
    assert math.isnan(sample.force_uN) == bool(flags)


@pytest.mark.parametrize(("family", "rig"), [("waveshare", {}), ("adam", ADAM)])
def test_no_voltage_for_long_is_no_sensor(family: str, rig: dict[str, object]) -> None:
    module = SheetModule(family=family, code=9 if family == "adam" else 0)
    module.volts = lambda t_s: 0.0 if 0.5 < t_s < 2.0 else 2.5
    bench = ForceBench(module, **rig).opened()
    with bench.sensor.stream(20.0):
        bench.clock.run_for(3.0)
    found = {round(sample.t_ns / NS_PER_S, 2): sample.flags - {UNTARED} for sample in bench.samples}
    assert {flags for t_s, flags in found.items() if 0.55 < t_s < 0.95} == {frozenset({SATURATED})}
    assert {flags for t_s, flags in found.items() if 1.15 < t_s < 1.95} == {frozenset({DISCONNECTED})}
    assert {flags for t_s, flags in found.items() if t_s > 2.1} == {frozenset()}


def test_no_voltage_is_a_force_if_the_sensor_can_give_it() -> None:
    module = SheetModule(family="adam", code=9)
    module.volts = lambda _: 0.0
    bench = ForceBench(module, zero_V=0.5, **ADAM).opened()
    with bench.sensor.stream(20.0):
        bench.clock.run_for(2.0)
    assert {sample.flags for sample in bench.samples} == {frozenset({UNTARED})}


@pytest.mark.parametrize("framing", ["rtu", "tcp"])
@pytest.mark.parametrize(("rate_hz", "conversion_ms"), [(30.0, None), (7.3, 90.0)])
def test_the_conversion_lies_within_the_stamp(framing: str, rate_hz: float, conversion_ms: float | None) -> None:
    bench = ForceBench(framing=framing, conversion_ms=conversion_ms)
    if conversion_ms:
        bench.module.conversion_ns = round(conversion_ms * NS_PER_MS)
    bench.opened()
    with bench.sensor.stream(rate_hz):
        bench.clock.run_for(4.0)
    assert len(bench.samples) >= 4 * rate_hz - 1
    converted = bench.module.converted_ns[1:]
    for sample, true_ns in zip(bench.samples, converted, strict=False):
        assert abs(sample.t_ns - true_ns) <= sample.dt_ns
        assert sample.dt_ns <= bench.module.conversion_ns / 2 + 4 * NS_PER_MS


def test_an_adam_takes_longer_for_more_channels() -> None:
    one, four = (SheetModule(family="adam", code=9) for _ in range(2))
    four.holding[220] = 0b1011_0001
    dt_ns = [ForceBench(module, **ADAM).opened().sensor.read().dt_ns for module in (one, four)]
    assert [round(ns / NS_PER_MS) for ns in dt_ns] == [pytest.approx(50, abs=3), pytest.approx(200, abs=3)]


def test_a_tare_over_the_wire() -> None:
    bench = ForceBench().opened()
    bench.module.volts = lambda _: 2.9
    tare = bench.sensor.tare(0.5)
    assert tare.n == pytest.approx(15, abs=1)
    assert tare.offset_uN == pytest.approx(20.0, abs=0.07)
    assert bench.sensor.read().force_uN == pytest.approx(0.0, abs=1e-9)


# ---------------------------------------------------------------------- the rig file


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"range_V": Range(0.0, 10.0)}, r"\[0, 10\] is none of waveshare-8ch, which has \[0, 5\], \[1, 5\]"),
        ({"zero_V": 7.0}, "does not cover"),
        ({"sensitivity_uN_per_V": 0.05}, "does not cover"),
        ({"range_uN": Range(-2000.0, 2000.0)}, r"-125 to 125 µN, which does not cover range_uN \[-2000, 2000\]"),
        ({"range_uN": Range(100.0, -100.0)}, "runs backwards"),
        ({"sensitivity_uN_per_V": 50_000.0}, "finer than a step of the module's 12-bit converter, 61 µN"),
        ({"axis": (1.0, 1.0, 0.0)}, "unit vector"),
        ({"rate_hz": 300.0}, "115200 baud can carry, 208 readings a second"),
        ({"channel": 9}, "less than or equal to 8"),
        ({"sensitivity_uN_per_V": -50.0}, "greater than 0"),
        ({"model": "adam-4118"}, "adam-4117"),
    ],
)
def test_implausible_settings(changes: dict[str, object], match: str) -> None:
    with pytest.raises(pydantic.ValidationError, match=match):
        ModbusForceSettings.model_validate({"connection": {"port": "/dev/ttyUSB2"}} | RIG | changes)


def test_a_slow_line_carries_less() -> None:
    connection = {"port": "/dev/ttyUSB2", "baudrate": 9600}
    with pytest.raises(pydantic.ValidationError, match="9600 baud can carry, 44 readings"):
        ModbusForceSettings.model_validate({"connection": connection} | RIG | {"rate_hz": 50.0})
    ModbusForceSettings.model_validate({"connection": connection} | RIG)
