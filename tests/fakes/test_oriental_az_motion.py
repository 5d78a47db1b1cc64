"""The emulated AZ drive: motion and its timing, stopping, homing and coordinates."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.fakes.modbus import frame
from tests.fakes.az_bench import (
    BUSY,
    FREE,
    HOME_END,
    IN_POSITION,
    MOVE,
    READY,
    STOP,
    UNIT,
    ZHOME,
    AzBench,
    write_request,
)


@pytest.fixture
def bench() -> AzBench:
    return AzBench()


def begin_and_end_ns(bench: AzBench) -> tuple[int, int]:
    """When the set-point of the last move began (to 0.05 ms) and ended to move."""
    begin_ns = bench.drive.log[-1][0]
    while bench.axis.setpoint_at(begin_ns)[1] == 0.0:
        begin_ns += 50_000
    return begin_ns, bench.axis.profile_end_ns


# ---------------------------------------------------------------------- moves


def test_a_move_takes_the_time_that_its_speed_and_rates_ask_for(bench: AzBench) -> None:
    assert bench.move(8500, speed=20_000, start_rate=100_000, stop_rate=100_000) == 0
    begin_ns, end_ns = begin_and_end_ns(bench)
    assert (end_ns - begin_ns) / NS_PER_S == pytest.approx(8500 / 20_000 + 20_000 / 100_000, abs=2e-4)
    assert begin_ns - bench.sent_ns <= round((2.5 + 0.8 + 2.0) * NS_PER_MS)
    assert bench.axis.setpoint_at(begin_ns + NS_PER_S // 4)[1] == pytest.approx(20_000)


@pytest.mark.parametrize(("start_rate", "stop_rate"), [(50_000, 400_000), (400_000, 50_000)])
@pytest.mark.parametrize("steps", [8500, -8500, 100, -1])
def test_starting_and_stopping_rates_differ(bench: AzBench, start_rate: int, stop_rate: int, steps: int) -> None:
    assert bench.move(steps, speed=20_000, start_rate=start_rate, stop_rate=stop_rate) == 0
    begin_ns, end_ns = begin_and_end_ns(bench)
    top = min(20_000.0, math.sqrt(2.0 * abs(steps) / (1.0 / start_rate + 1.0 / stop_rate)))
    ramps_s = top / start_rate + top / stop_rate
    expected_s = ramps_s + (abs(steps) - 0.5 * top * ramps_s) / top
    assert (end_ns - begin_ns) / NS_PER_S == pytest.approx(expected_s, abs=2e-4)
    assert bench.axis.setpoint_at(end_ns) == (steps, 0.0)


@given(
    first=st.integers(-20_000, 20_000),
    second=st.integers(-20_000, 20_000),
    pause_ms=st.floats(1.0, 900.0),
    rates=st.tuples(*[st.integers(20_000, 2_000_000)] * 4),
    speeds=st.tuples(*[st.integers(1000, 60_000)] * 2),
)
@settings(max_examples=80, deadline=None)
def test_a_move_changed_on_the_way_arrives(
    first: int, second: int, pause_ms: float, rates: tuple[int, ...], speeds: tuple[int, ...]
) -> None:
    bench = AzBench()
    bench.move(first, speed=speeds[0], start_rate=rates[0], stop_rate=rates[1])
    bench.wait_ms(pause_ms)
    bench.move(second, speed=speeds[1], start_rate=rates[2], stop_rate=rates[3])
    assert bench.axis.setpoint_at(bench.axis.profile_end_ns) == (second, 0.0)
    bench.wait_ms(100_000)
    assert bench.read(0xC6) == second
    assert bench.outputs() == IN_POSITION | READY | HOME_END


def test_types_count_from_zero_command_or_feedback(bench: AzBench) -> None:
    for kind, steps, command in ((1, 1000, 1000), (2, -300, 700), (2, 50, 750), (1, 400, 400)):
        assert bench.move(steps, kind=kind) == 0
        bench.wait_ms(500)
        assert bench.read(0xC6) == command
    assert bench.move(100, kind=3) == 0
    bench.wait_ms(500)
    assert abs(bench.read(0xC6) - 500) <= 1


def test_outputs_during_a_move() -> None:
    bench = AzBench(lag_s=0.03)
    bench.move(8500)
    assert bench.outputs() == MOVE | HOME_END
    bench.t_ns = bench.axis.profile_end_ns
    assert bench.outputs() == READY | HOME_END  # it has not settled
    bench.wait_ms(400)
    assert bench.outputs() == IN_POSITION | READY | HOME_END


def test_move_turns_on_a_moment_after_the_trigger(bench: AzBench) -> None:
    block = write_request(0x58, (0, 1, 8500, 20_000, 1_000_000, 1_000_000, 1000, 1))[2:-2]
    reply = bench.ask(frame(UNIT, bytes.fromhex("17 00 7E 00 02") + block))
    assert int.from_bytes(reply[3:7], "big") == IN_POSITION | READY | HOME_END
    assert bench.outputs() == MOVE | HOME_END


def test_monitors_agree_with_the_truth(bench: AzBench) -> None:
    bench.move(-8500, speed=12_000)
    bench.wait_ms(100)
    speeds = [bench.read(address) for address in (0xC8, 0xCA, 0xCE, 0xD0)]
    assert speeds == [-720, -12_000, -720, -12_000]
    bench.wait_ms(1000)
    readings = [bench.read(0xCC) for _ in range(30)]
    assert max(abs(reading + 8500) for reading in readings) <= 1
    assert (bench.read(0xC6), bench.read(0xCA), bench.read(0xD0)) == (-8500, 0, 0)
    assert 300 <= bench.read(0xFA) <= bench.read(0xF8) + 50 <= 450


def test_feedback_lags_behind_the_command() -> None:
    bench = AzBench(lag_s=0.05)
    bench.move(8500, speed=10_000)
    bench.wait_ms(300)
    reply = bench.ask(bytes.fromhex("01 03 00 C6 00 08 A4 31"))
    command, feedback = (int.from_bytes(reply[3 + 4 * i : 7 + 4 * i], "big") for i in (0, 3))
    assert command - feedback == pytest.approx(500, abs=2)


@pytest.mark.parametrize(("trigger", "address", "value"), [(-5, 0x5C, 600), (-4, 0x5E, 5000), (-7, 0x58, 3)])
def test_an_armed_trigger_starts_when_its_item_is_written(
    bench: AzBench, trigger: int, address: int, value: int
) -> None:
    assert bench.move(500, trigger=trigger) == 0
    assert bench.texts() == []
    assert bench.read(0x66) == trigger
    assert bench.write(0x62, 999_999) == 0
    assert bench.texts() == []
    assert bench.write(address, value) == 0
    assert bench.texts() == [f"move {value if address == 0x5C else 500}"]
    assert bench.read(0x66) == 0


def test_no_speed_is_an_operation_data_error(bench: AzBench) -> None:
    assert bench.move(100, speed=0) == 0
    assert bench.read(0x80) == 0x70
    assert bench.texts() == ["alarm 70"]


# ---------------------------------------------------------------------- stopping


def test_stop_brakes_with_the_stopping_rate_and_bars_starts(bench: AzBench) -> None:
    bench.move(100_000, speed=20_000, stop_rate=200_000)
    bench.wait_ms(500)
    assert bench.inputs(STOP) == 0
    (stop_ns, text) = bench.drive.log[-1]
    assert text == "stop"
    assert stop_ns - bench.sent_ns <= round(3.3 * NS_PER_MS)
    assert bench.axis.profile_end_ns - stop_ns == pytest.approx(0.1 * NS_PER_S, abs=2)
    bench.wait_ms(300)
    assert bench.outputs() == IN_POSITION | HOME_END
    assert bench.move(0) == 4
    assert bench.read(0xAC) == 0x8D
    assert bench.inputs(0) == 0
    assert bench.move(0) == 0
    assert bench.texts() == ["move 100000", "stop", "move 0"]


def test_a_held_stop_is_one_stop(bench: AzBench) -> None:
    for bits in (STOP, STOP, STOP | ZHOME, 0, STOP):
        bench.inputs(bits)
    assert bench.texts() == ["stop", "stop"]


def test_free_coasts_to_a_standstill_and_bars_starts(bench: AzBench) -> None:
    bench.move(100_000)
    bench.inputs(FREE)
    bench.wait_ms(500)
    assert not bench.outputs() & (MOVE | READY)
    assert bench.move(0) == 4
    bench.inputs(0)
    assert bench.outputs() & READY
    assert bench.texts() == ["move 100000", "free", "excite"]


def test_pulsed_inputs_clear_themselves(bench: AzBench) -> None:
    bench.move(100_000)
    assert bench.write(0x78, STOP) == 0
    bench.wait_ms(500)
    assert bench.read(0x78) == bench.read(0x7C) == 0
    assert bench.outputs() == IN_POSITION | READY | HOME_END
    assert bench.texts() == ["move 100000", "stop"]


# ---------------------------------------------------------------------- home, start, coordinates


def test_zhome_acts_on_its_edge(bench: AzBench) -> None:
    bench.move(3000)
    bench.inputs(ZHOME)  # ignored: it is moving
    bench.wait_ms(1000)
    assert bench.read(0xC6) == 3000
    bench.inputs(ZHOME)  # no edge
    bench.inputs(0)
    assert bench.texts() == ["move 3000"]
    bench.inputs(ZHOME)
    assert bench.outputs() & MOVE
    bench.wait_ms(1000)
    assert bench.read(0xC6) == 0
    assert bench.texts() == ["move 3000", "zhome"]


@pytest.mark.parametrize("absolute_move", [False, True])
def test_without_coordinates_there_is_no_way_home(bench: AzBench, absolute_move: bool) -> None:
    bench.move(3000)
    bench.wait_ms(1000)
    bench.drive.lose_coordinates(bench.t_ns)
    assert bench.read(0xC6) == 0
    assert not bench.outputs() & HOME_END
    assert (bench.move(10) if absolute_move else bench.inputs(ZHOME)) == 0
    assert bench.read(0x80) == 0x4A
    bench.wait_ms(500)
    assert bench.axis.position_at(bench.t_ns) == pytest.approx(3000)


def test_preset_establishes_coordinates(bench: AzBench) -> None:
    bench.drive.lose_coordinates(bench.t_ns)
    bench.move(250, kind=2)
    bench.wait_ms(500)
    assert bench.write(0x18A, 1) == 0
    assert bench.outputs() & (HOME_END | BUSY | READY) == HOME_END | BUSY
    assert bench.move(10) == 4
    assert bench.read(0xAC) == 0x8A
    bench.wait_ms(200)
    assert bench.read(0xC6) == 0
    assert bench.outputs() == IN_POSITION | READY | HOME_END
    assert bench.move(100) == 0
    bench.wait_ms(500)
    assert bench.axis.position_at(bench.t_ns) == pytest.approx(350)


def test_preset_and_configuration_wait_for_the_end_of_motion(bench: AzBench) -> None:
    bench.move(100_000)
    for address in (0x18A, 0x18C):
        assert bench.write(address, 1) == 4
    assert bench.read(0xAC) == 0x8D


def test_start_runs_the_selected_data(bench: AzBench) -> None:
    bench.inputs(0x3)
    assert bench.read(0xC2) == 3
    bench.inputs(0x3 | 0x8)
    assert bench.outputs() & 0xF == 0xB
    assert bench.texts() == ["start data 3"]
