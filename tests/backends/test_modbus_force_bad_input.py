"""What can go wrong between the driver and an analogue-input module."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.errors import ConfigError, LinkLost, LinkTimeout, ProtocolError, SaturatedData, UnsupportedError
from microdrivers.core.units import Range
from microdrivers.devices.force_sensor import STALE, UNTARED
from tests.backends.modbus_bench import spoiled
from tests.backends.modbus_force_bench import ForceBench, SheetModule

ADAM = {"model": "adam-4117", "range_V": Range(-5.0, 5.0)}


# ---------------------------------------------------------------------- opening


@pytest.mark.parametrize(
    ("code", "shown"), [(1, "1 to 5 V (code 01h"), (2, "no voltage range"), (3, "no voltage range"), (4, "no voltage")]
)
def test_another_range_than_the_rig_files(code: int, shown: str) -> None:
    bench = ForceBench(SheetModule(code=code))
    with pytest.raises(ConfigError) as caught:
        bench.sensor.open()
    assert caught.value.key == "gripper_force.range_V"
    assert shown in str(caught.value)
    assert "register 1000h), the rig file has 0 to 5 V" in str(caught.value)
    assert "set the channel to code 00h" in caught.value.remedy
    assert ("range_V: [1, 5]" in caught.value.remedy) == (code == 1)
    assert (bench.sensor.link, bench.wire.in_use) == ("closed", False)


def test_a_channel_that_is_not_converted() -> None:
    module = SheetModule(family="adam", code=9, channel=2)
    module.holding[220] = 0b0000_1101
    with pytest.raises(ConfigError, match="does not convert channel 2: its mask is 0Dh") as caught:
        ForceBench(module, channel=2, **ADAM).sensor.open()
    assert caught.value.key == "gripper_force.channel"


def test_another_model_is_named() -> None:
    module = SheetModule(family="adam", code=9)
    module.holding[210] = 0x4017
    with pytest.raises(UnsupportedError, match="no adam-4117: it calls itself 4017h") as caught:
        ForceBench(module, **ADAM).sensor.open()
    assert caught.value.remedy == "write model: adam-4017+"
    module.holding[210] = 0x4056
    with pytest.raises(UnsupportedError, match="4056h") as caught:
        ForceBench(module, **ADAM).sensor.open()
    assert "unit_id" in caught.value.remedy


@pytest.mark.parametrize(("family", "rig"), [("adam", {}), ("waveshare", ADAM)])
def test_a_module_of_another_maker(family: str, rig: dict[str, object]) -> None:
    with pytest.raises(UnsupportedError, match=r"gripper_force: this is no .* exception 02") as caught:
        ForceBench(SheetModule(family=family, code=9 if family == "adam" else 0), **rig).sensor.open()
    assert "model" in caught.value.remedy


def test_a_module_with_another_address_in_that_register() -> None:
    module = SheetModule()
    module.holding[0x4000] = 0
    with pytest.raises(UnsupportedError, match="where that has its address, 1, there is 0 \\(register 4000h\\)"):
        ForceBench(module).sensor.open()


def test_another_unit_is_silence() -> None:
    with pytest.raises(LinkTimeout, match=r"gripper_force: unit 7 on .*4000h") as caught:
        ForceBench(unit_id=7).sensor.open()
    assert "unit_id" in caught.value.remedy


# ---------------------------------------------------------------------- reading


def test_a_bad_crc_is_read_again_behind_a_read_of_another_length() -> None:
    bench = ForceBench().opened()
    bench.module.spoil = [spoiled]
    assert bench.sensor.read().raw_uN == pytest.approx(0.0, abs=0.07)
    assert [data[1:6].hex() for data in bench.module.requests[-3:]] == ["0400000001", "0400000002", "0400000001"]


def test_a_bad_crc_twice_is_a_protocol_error() -> None:
    bench = ForceBench().opened()
    bench.module.spoil = [spoiled, lambda frame: frame, spoiled]
    with pytest.raises(ProtocolError, match=r"gripper_force: unit 1 .* read of 1 input registers at 0000h") as caught:
        bench.sensor.read()
    assert "parity" in caught.value.remedy


@pytest.mark.parametrize("exception", [1, 2, 3, 4, 6])
def test_an_exception_while_reading(exception: int) -> None:
    bench = ForceBench().opened()
    bench.module.refusal = exception
    with pytest.raises(ProtocolError, match=f"gripper_force: .*0000h with exception 0{exception}") as caught:
        bench.sensor.read()
    assert caught.value.remedy
    bench.module.refusal = 0
    assert bench.sensor.read().flags == {UNTARED}


def test_half_a_reply_is_a_timeout_that_shows_it() -> None:
    bench = ForceBench().opened()
    bench.module.spoil = [lambda frame: frame[:4], lambda frame: frame, lambda frame: frame[:4]]
    with pytest.raises(LinkTimeout, match="only a part of the reply"):
        bench.sensor.read()


@settings(deadline=None, max_examples=60)
@given(
    delays_s=st.lists(st.sampled_from([0.0, 0.0, 0.1, 0.19, 0.2, 0.22, 0.3, 0.45, None]), min_size=1, max_size=12),
    pauses_s=st.lists(st.floats(0.0, 0.3), min_size=1, max_size=6),
    seed=st.integers(0, 100),
)
def test_no_late_reply_is_taken_for_a_later_reading(
    delays_s: list[float | None], pauses_s: list[float], seed: int
) -> None:
    module = SheetModule()
    module.volts = lambda t_s: 1.0 + 0.25 * t_s
    bench = ForceBench(module, seed=seed).opened()
    module.delays_s = list(delays_s)
    for pause_s in pauses_s:
        bench.clock.sleep(pause_s)
        asked_s = bench.clock.now_ns() / 1e9
        try:
            sample = bench.sensor.read()
        except LinkTimeout:
            continue
        shown_s = (sample.raw_uN / 50.0 + 2.5 - 1.0) / 0.25
        assert shown_s >= asked_s - 0.020 - 0.006


def test_a_silent_module_is_usable_again_once_it_answers() -> None:
    bench = ForceBench().opened()
    bench.module.delays_s = [None] * 4
    for _ in range(2):
        with pytest.raises(LinkTimeout):
            bench.sensor.read()
    assert bench.sensor.read().flags == {UNTARED}


# ---------------------------------------------------------------------- streaming


def test_while_the_module_is_silent_the_stream_says_stale() -> None:
    bench = ForceBench().opened()
    with bench.sensor.stream(20.0):
        bench.clock.run_for(1.0)
        bench.module.unit_id = 9
        bench.clock.run_for(3.0)
        silent = [sample for sample in bench.samples if STALE in sample.flags]
        assert len(silent) >= 5
        assert all(math.isnan(sample.force_uN) and math.isnan(sample.raw_uN) for sample in silent)
        assert {sample.flags for sample in silent} == {frozenset({STALE, UNTARED})}
        assert bench.kinds == ["opened", "link_lost"]
        bench.module.unit_id = 1
        bench.clock.run_for(1.0)
    assert bench.kinds == ["opened", "link_lost", "link_back"]
    assert bench.samples[-1].flags == {UNTARED}
    assert [sample.seq for sample in bench.samples] == list(range(len(bench.samples)))
    times = [sample.t_ns for sample in bench.samples]
    assert times == sorted(times)


def test_a_refusal_in_a_stream_is_stale_too() -> None:
    bench = ForceBench().opened()
    bench.module.refusal = 4
    with bench.sensor.stream(20.0):
        bench.clock.run_for(0.5)
    assert {sample.flags for sample in bench.samples} == {frozenset({STALE, UNTARED})}


def test_a_pulled_cable_is_lost_and_stale() -> None:
    bench = ForceBench().opened()
    bench.wire.unplug()
    with pytest.raises(LinkLost, match="gripper_force"):
        bench.sensor.read()
    with bench.sensor.stream(20.0):
        bench.clock.run_for(0.5)
    assert bench.kinds == ["opened", "link_lost"]
    assert len(bench.samples) == 10 or len(bench.samples) == 11
    assert all(STALE in sample.flags for sample in bench.samples)


def test_no_zero_is_taken_of_stale_readings() -> None:
    bench = ForceBench().opened()
    bench.module.refusal = 4
    with pytest.raises(SaturatedData, match="STALE"):
        bench.sensor.tare(1.0)


def test_stop_is_harmless_and_close_releases_the_port() -> None:
    bench = ForceBench().opened()
    sent = len(bench.module.requests)
    bench.sensor.stop()
    bench.sensor.close()
    assert len(bench.module.requests) == sent
    assert not bench.wire.in_use
