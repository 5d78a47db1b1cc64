"""The emulated measuring amplifier: process values, units, zero, saturation, a sensor that is not there."""

from __future__ import annotations

import struct

import pytest

from microdrivers.core.units import NS_PER_MS
from microdrivers.fakes.canopen import PROMPT, Temper
from microdrivers.fakes.cia404 import Amplifier, InputSpec
from tests.fakes.canopen_bench import NodeBench, shown

SPEC = InputSpec(zero_V=2.25, sensitivity_uN_per_V=1000.0, input_V=(0.05, 4.45), resolution_V=1e-5)
ZERO_KEY = 0x6F72657A


class AmplifierBench(NodeBench):
    """A probe with `force_uN` on it, 1000 µN/V, and a converter with steps of 0.01 µN."""

    def __init__(self, *, temper: Temper = PROMPT) -> None:
        self.force_uN = 0.0
        self.asked_ns: list[int] = []
        self.amplifier = Amplifier(self.voltage_at, SPEC, node_id=21, seed=4, temper=temper)
        super().__init__(self.amplifier.node)

    def voltage_at(self, t_ns: int) -> float:
        self.asked_ns.append(t_ns)
        return min(max(2.25 + self.force_uN / 1000.0, 0.05), 4.45)

    def push(self, force_uN: float) -> None:
        self.force_uN = force_uN
        self.wait_ms(1)

    def value_nN(self) -> int:
        return self.read(0x9130, 1, signed=True)

    def set_real(self, index: int, value: float) -> int:
        return self.write(index, int.from_bytes(struct.pack("<f", value), "little"), 4, 1)

    @property
    def status(self) -> int:
        return self.read(0x6150, 1)


def test_who_it_is() -> None:
    bench = AmplifierBench()
    assert bench.read(0x1000) == 0x00020194
    assert bench.read(0x1018, 4) == 4_040_021
    assert [bench.read(index) for index in (0x6130, 0x9130, 0x6131, 0x6150)] == [1, 1, 1, 1]
    assert bench.read(0x6131, 1) == 0xF7210000
    assert bench.ask("40 30 91 02 00 00 00 00") == "80 30 91 02 11 00 09 06"


@pytest.mark.parametrize("force_uN", [0.0, 12.34, -1999.99, 2000.0])
def test_values_in_both_formats(force_uN: float) -> None:
    bench = AmplifierBench()
    bench.push(force_uN)
    assert bench.value_nN() == pytest.approx(1000 * force_uN, abs=0.6)
    assert bench.read_real(0x6130, 1) == pytest.approx(1000 * force_uN, abs=0.6)
    assert bench.read_real(0x6100, 1) == pytest.approx(2.25 + force_uN / 1000, abs=6e-6)
    assert bench.status == 0


def test_the_converter_has_steps() -> None:
    bench = AmplifierBench()
    seen = set()
    for step in range(40):
        bench.push(0.001 * step)
        seen.add(bench.value_nN())
    assert seen <= {0, 10, 20, 30, 40}
    assert len(seen) >= 4


@pytest.mark.parametrize(
    ("unit", "factor", "digits", "integer"),
    [(0xFA210000, 1000.0, 2, 12_346), (0xFD210000, 1.0, 6, 123_457), (0x00210000, 1e-3, 6, 123)],
)
def test_units_digits_and_scaling_belong_together(unit: int, factor: float, digits: int, integer: int) -> None:
    bench = AmplifierBench()
    assert bench.write(0x6131, unit, 4, 1) == 0
    assert bench.write(0x6132, digits, 1, 1) == 0
    assert bench.set_real(0x6126, factor) == 0
    assert bench.set_real(0x6127, -2.25 * factor) == 0
    bench.push(123.457)
    assert bench.value_nN() == pytest.approx(integer, abs=0.01 * integer / 123)
    assert bench.write(0x6131, 0xF8210000, 4, 1) == 0x06090030
    assert bench.write(0x6132, 7, 1, 1) == 0x06090031


# ---------------------------------------------------------------------- zero


def test_zero_is_the_mean_of_the_next_milliseconds() -> None:
    bench = AmplifierBench()
    bench.push(50.0)
    assert bench.write(0x6125, ZERO_KEY, 4, 1) == 0
    assert bench.value_nN() == 50_000
    bench.wait_ms(4)
    bench.push(52.0)
    bench.wait_ms(10)
    assert 50_000 < 52_000 - bench.value_nN() < 52_000
    assert [text for _, text in bench.amplifier.log] == ["tare"]
    bench.push(0.0)
    assert bench.value_nN() < -50_000
    bench.amplifier.power_cycle(bench.t_ns)
    bench.wait_ms(10)
    assert bench.value_nN() == 0


def test_a_wrong_key_or_a_saturated_input_gives_no_zero() -> None:
    bench = AmplifierBench()
    assert bench.write(0x6125, 0x6F72657B, 4, 1) == 0x06090030
    assert bench.ask("40 25 61 01 00 00 00 00") == "80 25 61 01 01 00 01 06"
    bench.push(9000.0)
    assert bench.write(0x6125, ZERO_KEY, 4, 1) == 0x08000022
    bench.wait_ms(20)
    assert bench.amplifier.log == []


# ---------------------------------------------------------------------- what is not valid


@pytest.mark.parametrize(("force_uN", "status", "shows_nN"), [(5000.0, 0x03, 2_200_000), (-5000.0, 0x05, -2_200_000)])
def test_saturation(force_uN: float, status: int, shows_nN: int) -> None:
    bench = AmplifierBench()
    bench.push(force_uN)
    assert bench.status == status
    assert bench.value_nN() == shows_nN
    bench.push(0.0)
    assert bench.status == 0
    assert bench.sent[1:] == [due for due in bench.sent[1:] if due.frame.id == 0x595]  # no emergency


def test_a_missing_sensor_shows_in_the_status_only() -> None:
    bench = AmplifierBench()
    bench.push(500.0)
    bench.amplifier.disconnect_sensor(bench.t_ns)
    assert [shown(frame) for frame in bench.wait_ms(1)] == ["095 [8] 00 73 21 00 00 00 00 00"]
    assert bench.status == 0x01
    assert abs(bench.value_nN()) < 50_000
    assert bench.read(0x1001) == 0x21
    bench.amplifier.power_cycle(bench.t_ns)
    assert [shown(frame) for frame in bench.wait_ms(10)] == ["715 [1] 00", "095 [8] 00 73 21 00 00 00 00 00"]
    bench.amplifier.connect_sensor(bench.t_ns)
    assert [shown(frame) for frame in bench.wait_ms(1)] == ["095 [8] 00 00 00 00 00 00 00 00"]
    assert bench.status == 0
    assert bench.value_nN() == 500_000


def test_switched_off_it_shows_the_last_value() -> None:
    bench = AmplifierBench()
    bench.push(500.0)
    assert bench.value_nN() == 500_000
    bench.write(0x6112, 0, 1, 1)
    bench.push(0.0)
    assert bench.status == 0x01
    assert bench.value_nN() == 500_000


# ---------------------------------------------------------------------- PDOs


def test_a_thousand_values_a_second_by_the_event_timer() -> None:
    bench = AmplifierBench(temper=Temper())
    for index, value, size, sub in ((0x1800, 0x80000195, 4, 1), (0x1800, 254, 1, 2), (0x1800, 1, 2, 5)):
        assert bench.write(index, value, size, sub) == 0
    assert bench.write(0x1800, 0x195, 4, 1) == 0
    bench.operational()
    bench.push(7.0)
    sent = [frame for frame in bench.wait_ms(1000) if frame.id == 0x195]
    assert 999 <= len(sent) <= 1001
    assert {shown(frame) for frame in sent} == {"195 [5] 58 1B 00 00 00"}
    bench.nmt(0x80)
    assert bench.wait_ms(100) == []


def test_by_sync_a_value_is_of_the_syncs_instant() -> None:
    bench = AmplifierBench()
    bench.operational()
    assert bench.wait_ms(100) == []  # changes alone send nothing
    (frame,) = bench.sync()
    assert frame.id == 0x195
    assert 0 <= bench.t_ns - bench.asked_ns[-1] < NS_PER_MS // 10  # the newest sample
    assert bench.asked_ns == sorted(bench.asked_ns)


def test_the_masters_heartbeat_is_watched() -> None:
    bench = AmplifierBench()
    bench.write(0x1016, 1 << 16 | 100, 4, 1)
    bench.operational()
    bench.put(0x701, "05")
    assert [shown(frame) for frame in bench.wait_ms(300)] == ["095 [8] 30 81 11 01 00 00 00 00"]
    assert [shown(frame) for frame in bench.put(0x701, "05")] == ["095 [8] 00 00 00 00 00 00 00 00"]


def test_an_error_of_the_device() -> None:
    bench = AmplifierBench()
    bench.amplifier.inject_fault(bench.t_ns, 0x5000, info=b"\x07")
    assert [shown(frame) for frame in bench.wait_ms(1)] == ["095 [8] 00 50 01 07 00 00 00 00"]
