"""What a force sensor on a CiA 404 amplifier reads, and when."""

from __future__ import annotations

import itertools
import math
import struct

import pydantic
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.backends.cia404 import Cia404ForceSettings
from microdrivers.backends.cia404.measurement_frame import STATUS_FLAGS, frame_time
from microdrivers.backends.cia404.physical_unit import uN_per_unit
from microdrivers.core.errors import OutOfRange
from microdrivers.core.units import NS_PER_MS, NS_PER_S, Range
from microdrivers.devices.force_sensor import DISCONNECTED, SATURATED, UNTARED
from microdrivers.fakes.can import Due, Frame, frame_bits
from tests.backends.cia404_bench import RIG, ForceBench
from tests.backends.cia404_peer import OPERATIONAL, PRE_OPERATIONAL, SheetAmplifier

CONNECTION = {"interface": "socketcan", "channel": "can0"}


# ---------------------------------------------------------------------- opening


def test_opening_maps_value_and_status_and_nothing_streams_yet() -> None:
    with ForceBench().opened() as bench:
        assert bench.amplifier.writes == [
            (0x1800, 1, 0x80000195), (0x1800, 2, 255), (0x1800, 3, 0), (0x1800, 5, 0), (0x1A00, 0, 0),
            (0x1A00, 1, 0x91300120), (0x1A00, 2, 0x61500108), (0x1A00, 0, 2), (0x1800, 1, 0x195), (0x1017, 0, 200),
        ]  # fmt: skip
        info = bench.sensor.info
        assert (info.model, info.serial_number, info.firmware) == ("Strain amplifier SA-1", "4711", "1.2")
        bench.clock.run_for(1.0)
        assert bench.amplifier.nmt == PRE_OPERATIONAL
        assert not bench.amplifier.sent_ns
        assert bench.kinds == ["opened"]


def test_the_bytes_of_the_sheet() -> None:
    with ForceBench().opened() as bench:
        frames = [
            f"{frame.id:03X}#{frame.data.hex().upper()}"
            for _, _, frame in bench.medium.log
            if frame.id & 0x780 in (0x580, 0x600)
        ]
        pairs = ["615#4000100000000000", "595#4300100094010200"], ["615#4031610100000000", "595#43316101000021F7"]
        for request, answer in pairs:
            assert frames[frames.index(request) + 1] == answer


def test_a_mapping_that_fits_is_left_alone() -> None:
    amplifier = SheetAmplifier()
    amplifier.objects |= {
        (0x1A00, 0): b"\2", (0x1A00, 1): struct.pack("<I", 0x91300120), (0x1A00, 2): struct.pack("<I", 0x61500108),
    }  # fmt: skip
    with ForceBench(amplifier).opened() as bench:
        assert amplifier.writes == [(0x1800, 2, 255), (0x1017, 0, 200)]
        with bench.sensor.stream(100.0):
            bench.clock.run_for(0.1)
        assert len(bench.samples) in (9, 10)


def test_other_pdos_are_switched_off() -> None:
    amplifier = SheetAmplifier()
    amplifier.objects[0x1801, 1] = struct.pack("<I", 0x295)
    with ForceBench(amplifier).opened():
        assert amplifier.objects[0x1801, 1] == struct.pack("<I", 0x80000295)


# ---------------------------------------------------------------------- values

FORMATS = [
    (0xF7210000, 0, 0x9130, True), (0xFA210000, 2, 0x9130, True), (0xFA210000, 3, 0x9130, False),
    (0xFD210000, 6, 0x9130, True), (0x00210000, 9, 0x9130, True), (0xF7210000, 0, 0x6130, True),
    (0xFA210000, 2, 0x6130, False), (0x00210000, 0, 0x6130, True), (0xFA210000, 1, 0x7130, True),
]  # fmt: skip


@pytest.mark.parametrize(("unit", "digits", "value", "status"), FORMATS)
def test_every_format_becomes_micronewtons(unit: int, digits: int, value: int, status: bool) -> None:
    amplifier = SheetAmplifier(unit=unit, digits=digits, value=value, status=status)
    amplifier.force_uN = lambda _: -1234.5
    with ForceBench(amplifier, resolution_uN=0.1).opened() as bench:
        assert bench.sensor.read().raw_uN == pytest.approx(-1234.5, abs=0.051)
        with bench.sensor.stream(100.0):
            bench.clock.run_for(0.1)
        assert bench.samples[-1].raw_uN == pytest.approx(-1234.5, abs=0.051)
        assert bench.samples[-1].flags == {UNTARED}


@pytest.mark.parametrize(
    ("code", "factor"),
    [
        (0x00210000, 1e6), (0xFD210000, 1e3), (0xFA210000, 1.0), (0xF7210000, 1e-3),
        (0x03210000, None), (0x00260000, None), (0xFA010100, None), (0x00210100, None), (0x00210001, None), (0, None),
    ],
)  # fmt: skip
def test_units_of_force(code: int, factor: float | None) -> None:
    assert uN_per_unit(code) == (None if factor is None else pytest.approx(factor, rel=1e-12))


@pytest.mark.parametrize(
    ("status", "flags"),
    [(0, set()), (1, {DISCONNECTED}), (3, {SATURATED}), (5, {SATURATED}), (2, {SATURATED}), (0x80, {DISCONNECTED})],
)
def test_the_status_becomes_flags(status: int, flags: set[str]) -> None:
    assert STATUS_FLAGS[status] == flags
    amplifier = SheetAmplifier()
    amplifier.status = status
    with ForceBench(amplifier).opened() as bench:
        samples = [bench.sensor.read()]
        with bench.sensor.stream(100.0):
            bench.clock.run_for(0.05)
        for sample in (*samples, *bench.samples):
            assert sample.flags == flags | {UNTARED}
            assert math.isnan(sample.force_uN) == bool(flags)


def test_beyond_the_range_is_saturated() -> None:
    amplifier = SheetAmplifier()
    amplifier.force_uN = lambda _: 2000.5
    with ForceBench(amplifier).opened() as bench:
        assert bench.sensor.read().flags == {SATURATED, UNTARED}


def test_the_tare_is_the_hosts_affair() -> None:
    amplifier = SheetAmplifier()
    amplifier.force_uN = lambda t_s: 20.0 + 0.02 * math.sin(2000 * t_s)
    with ForceBench(amplifier).opened() as bench:
        tare = bench.sensor.tare(0.3)
        assert tare.n == pytest.approx(300, abs=2)
        assert tare.offset_uN == pytest.approx(20.0, abs=0.01)
        assert bench.sensor.read().force_uN == pytest.approx(0.0, abs=0.05)
        assert not any(index == 0x6125 for index, _, _ in amplifier.writes)


# ---------------------------------------------------------------------- streams


@pytest.mark.parametrize("sync", [False, True])
@pytest.mark.parametrize("rate_hz", [1000.0, 100.0])
def test_a_stream_loses_doubles_and_reorders_nothing(sync: bool, rate_hz: float) -> None:
    amplifier = SheetAmplifier()
    amplifier.force_uN = lambda t_s: round(1000 * t_s) - 1000.0  # which conversion it is
    with ForceBench(amplifier, sync=sync).opened() as bench:
        with bench.sensor.stream(rate_hz):
            bench.clock.run_for(2.0)
            assert amplifier.nmt == OPERATIONAL
        bench.clock.run_for(0.1)
        assert amplifier.nmt == PRE_OPERATIONAL
        samples = bench.samples
        assert len(samples) == pytest.approx(2 * rate_hz, abs=2)
        assert [sample.seq for sample in samples] == list(range(len(samples)))
        steps = {round(later.raw_uN - sample.raw_uN) for sample, later in itertools.pairwise(samples)}
        assert steps <= {round(1000 / rate_hz) + off for off in ((-1, 0, 1) if sync else (0,))}
        assert bench.sensor.lost_frames == 0
        assert bench.kinds == ["opened"]
        for sample, true_ns in zip(samples, amplifier.sampled_ns, strict=False):
            assert abs(sample.t_ns - true_ns) <= sample.dt_ns
            assert sample.dt_ns < 0.75 * NS_PER_MS


def test_the_stamp_holds_while_others_use_the_bus() -> None:
    chatter = _Chatter()
    with ForceBench(others=[chatter]).opened() as bench:
        with bench.sensor.stream(1000.0):
            bench.clock.run_for(1.0)
        for sample, true_ns in zip(bench.samples, bench.amplifier.sampled_ns, strict=False):
            assert abs(sample.t_ns - true_ns) <= sample.dt_ns
        assert bench.medium.load() > 0.5


class _Chatter:
    """Sends 8 bytes of the lowest rank every 0.613 ms."""

    def __init__(self) -> None:
        self._due_ns = 0

    def receive(self, frame: Frame, t_ns: int) -> list[Due]:
        return []

    def advance(self, t_ns: int) -> list[Due]:
        due_ns, self._due_ns = self._due_ns, self._due_ns + 613_000
        return [Due(due_ns, Frame(0x7F0, bytes(8)))]

    def next_event_ns(self) -> int | None:
        return self._due_ns


@pytest.mark.parametrize("sync", [False, True])
def test_a_read_within_a_stream_is_fresh_and_shared_with_it(sync: bool) -> None:
    amplifier = SheetAmplifier()
    amplifier.force_uN = lambda t_s: 100.0 * t_s
    with ForceBench(amplifier, sync=sync).opened() as bench, bench.sensor.stream(200.0):
        for _ in range(60):
            bench.clock.run_for(0.0051)
            asked_ns = bench.clock.now_ns()
            sample = bench.sensor.read()
            assert sample.t_ns + sample.dt_ns >= asked_ns
            assert sync or sample.t_ns >= asked_ns
            assert sample.raw_uN >= 100.0 * (asked_ns / NS_PER_S - 0.001) - 0.01
            assert sample in bench.samples
        assert [sample.seq for sample in bench.samples] == list(range(len(bench.samples)))


def test_a_read_without_a_stream_states_when_it_was_measured() -> None:
    amplifier = SheetAmplifier()
    amplifier.force_uN = lambda t_s: 100.0 * t_s
    with ForceBench(amplifier).opened() as bench:
        for _ in range(20):
            bench.clock.run_for(0.0123)
            sample = bench.sensor.read()
            assert abs(sample.raw_uN / 100.0 * NS_PER_S - sample.t_ns) <= sample.dt_ns + 10_000
            assert sample.dt_ns < 2 * NS_PER_MS


@pytest.mark.parametrize(("asked_hz", "event_ms"), [(1000.0, 1), (300.0, 3), (30.0, 33), (0.5, 2000)])
def test_the_event_timer_counts_milliseconds(asked_hz: float, event_ms: int) -> None:
    with ForceBench().opened() as bench:
        with bench.sensor.stream(asked_hz):
            bench.clock.run_for(4 / asked_hz)
        assert (0x1800, 5, event_ms) in bench.amplifier.writes
        assert bench.kinds == ["opened"]
        assert len(bench.samples) >= 3


def test_lost_frames_are_counted() -> None:
    with ForceBench().opened() as bench:
        with bench.sensor.stream(1000.0):
            bench.clock.run_for(0.1)
            bench.amplifier.drop = 3
            bench.clock.run_for(0.1)
            assert bench.sensor.lost_frames == 3
        with bench.sensor.stream(100.0):
            bench.clock.run_for(0.1)
            bench.amplifier.drop = 1
            bench.clock.run_for(0.1)
        assert bench.sensor.lost_frames == 4


def test_lost_answers_to_sync_are_counted() -> None:
    with ForceBench(sync=True).opened() as bench, bench.sensor.stream(50.0):
        bench.clock.run_for(0.5)
        bench.amplifier.drop = 1
        bench.clock.run_for(0.5)
        assert bench.sensor.lost_frames >= 1


def test_a_stream_is_shared_and_the_fastest_wish_holds() -> None:
    with ForceBench().opened() as bench:

        def rate_hz() -> float:
            bench.clock.run_for(0.02)
            before = len(bench.samples)
            bench.clock.run_for(0.5)
            return 2.0 * (len(bench.samples) - before)

        with bench.sensor.stream(100.0):
            assert rate_hz() == pytest.approx(100.0, abs=4)
            with bench.sensor.stream(50.0):
                assert rate_hz() == pytest.approx(100.0, abs=4)
            with bench.sensor.stream(500.0):
                assert rate_hz() == pytest.approx(500.0, abs=4)
                with pytest.raises(OutOfRange), bench.sensor.stream(1e6):
                    pass
                assert rate_hz() == pytest.approx(500.0, abs=4)
            assert bench.sensor.streaming
        assert not bench.sensor.streaming
        assert rate_hz() == 0.0


def test_a_sensor_that_was_closed_streams_again_for_others() -> None:
    with ForceBench().opened() as bench, bench.sensor.stream(100.0):
        bench.sensor.close()
        bench.sensor.open()
        assert not bench.sensor.streaming
        with bench.sensor.stream(50.0):
            bench.clock.run_for(0.1)
        assert bench.samples[-1].seq > 0


def test_a_rate_that_the_bus_or_the_amplifier_cannot_carry() -> None:
    with ForceBench(bitrate=125_000, rate_hz=100.0).opened() as bench:
        with pytest.raises(OutOfRange, match="1000 Hz load the bus with 84%") as caught, bench.sensor.stream(1000.0):
            pass
        assert "833 Hz" in caught.value.remedy
        with pytest.raises(OutOfRange, match="stream rate = 2000 Hz"), bench.sensor.stream(2000.0):
            pass
        assert not bench.sensor.streaming


def test_closing_within_a_stream_ends_it() -> None:
    with ForceBench().opened() as bench:
        with bench.sensor.stream(100.0):
            bench.clock.run_for(0.1)
            bench.sensor.close()
            assert bench.kinds == ["opened", "closed"]
            assert not bench.sensor.streaming
        assert bench.amplifier.nmt == PRE_OPERATIONAL
        bench.sensor.open()
        with bench.sensor.stream(100.0):
            bench.clock.run_for(0.1)
        assert bench.kinds == ["opened", "closed", "opened"]


# ---------------------------------------------------------------------- the rig file


@pytest.mark.parametrize(
    ("bitrate", "rate_hz", "sync", "match"),
    [
        (125_000, 1000.0, False, "1000 loads the bus with 84% of its 125 kbit/s.*833 Hz or less"),
        (125_000, 600.0, True, "77%"),
        (20_000, 1000.0, False, "525%"),
        (250_000, 1000.0, False, ""),
        (125_000, 500.0, True, ""),
    ],
)
def test_rates_that_the_bit_rate_cannot_carry(bitrate: int, rate_hz: float, sync: bool, match: str) -> None:
    rig = {"connection": CONNECTION | {"bitrate": bitrate}} | RIG | {"rate_hz": rate_hz, "sync": sync}
    if not match:
        Cia404ForceSettings.model_validate(rig)
        return
    with pytest.raises(pydantic.ValidationError, match=match):
        Cia404ForceSettings.model_validate(rig)


@pytest.mark.parametrize(
    "changes", [{"node_id": 0}, {"node_id": 128}, {"rate_hz": 1001.0}, {"channel": 9}, {"range_uN": Range(1.0, 0.0)}]
)
def test_settings_that_cannot_be(changes: dict[str, object]) -> None:
    with pytest.raises(pydantic.ValidationError):
        Cia404ForceSettings.model_validate({"connection": CONNECTION} | RIG | changes)


@settings(deadline=None, max_examples=100)
@given(data=st.binary(max_size=8), identifier=st.integers(0, 0x7FF))
def test_the_time_of_a_frame_is_within_what_is_stated(data: bytes, identifier: int) -> None:
    stated = frame_time(len(data), bitrate=500_000)
    assert abs(frame_bits(Frame(identifier, data)) * 2000 - stated.ns) <= stated.half_width_ns
