"""The emulated AZ drive's alarms: what raises them, what they stop, what ends them."""

from __future__ import annotations

import pytest

from microdrivers.core.units import NS_PER_MS, NS_PER_S
from tests.fakes.az_bench import ALARM, ALARM_RESET, FREE, HOME_END, IN_POSITION, MOVE, READY, STOP, ZHOME, AzBench

NO_ALARM = "01 03 04 00 00 00 00 FA 33"


@pytest.fixture
def bench() -> AzBench:
    return AzBench()


@pytest.mark.parametrize(("limit", "frames", "alarm"), [(3, 2, 0), (3, 3, 0x84), (1, 1, 0x84), (0, 9, 0)])
def test_lost_frames_in_a_row_raise_an_alarm(bench: AzBench, limit: int, frames: int, alarm: int) -> None:
    assert bench.write(0x138C, limit) == 0
    for _ in range(frames):
        assert bench.ask_hex("01 03 00 7E 00 02 00 00") == ""
    assert bench.drive.alarm == alarm


def test_a_sound_frame_forgives_lost_ones(bench: AzBench) -> None:
    for _ in range(5):
        bench.ask(b"\x01\x03")
        bench.ask(b"\x01\x03")
        bench.outputs()
    assert bench.drive.alarm == 0


@pytest.mark.parametrize("by_register", [False, True])
@pytest.mark.parametrize(("code", "clears"), [(0x30, True), (0x26, True), (0x28, False), (0x41, False)])
def test_alarms_stop_the_motor_and_some_can_be_reset(
    bench: AzBench, code: int, clears: bool, by_register: bool
) -> None:
    bench.move(100_000)
    bench.wait_ms(100)
    bench.drive.raise_alarm(bench.t_ns, code)
    bench.wait_ms(500)
    assert bench.outputs() == IN_POSITION | ALARM | HOME_END
    assert bench.move(0) == 4
    assert bench.read(0xAC) == 0x8D
    if by_register:
        bench.write(0x180, 1)
    else:
        bench.inputs(ALARM_RESET)
    assert bench.read(0x80) == (0 if clears else code)
    assert bool(bench.outputs() & READY) is clears


def test_alarm_reset_needs_an_edge(bench: AzBench) -> None:
    bench.write(0x180, 1)
    bench.drive.raise_alarm(bench.t_ns, 0x30)
    bench.write(0x180, 1)
    assert bench.read(0x80) == 0x30
    bench.write(0x180, 0)
    bench.write(0x180, 1)
    assert bench.read(0x80) == 0


def test_alarm_history_keeps_the_newest_first_until_cleared(bench: AzBench) -> None:
    for code in (0x30, 0x26):
        bench.drive.raise_alarm(bench.t_ns, code)
        bench.inputs(ALARM_RESET)
        bench.inputs(0)
    assert [bench.read(address) for address in (0x80, 0x82, 0x84, 0x94)] == [0, 0x26, 0x30, 0]
    bench.write(0x184, 1)
    assert bench.read(0x82) == 0


def test_software_limits_stop_the_motor() -> None:
    bench = AzBench(software_limits_steps=(-100, 5000))
    bench.move(8500, stop_rate=500_000)
    bench.listen(1000)
    assert bench.read(0x80) == 0x67
    assert bench.read(0xC6) == pytest.approx(5000 + 20_000**2 / (2 * 500_000), abs=1)
    bench.inputs(ALARM_RESET)
    assert bench.move(0) == 0
    bench.listen(1000)
    assert bench.read(0xC6) == 0
    assert bench.texts() == ["move 8500", "alarm 67", "alarm reset", "move 0"]


def test_silence_of_the_host_is_an_alarm_if_asked_for(bench: AzBench) -> None:
    bench.wait_ms(60_000)
    assert bench.read(0x80) == 0
    bench.write(0x138A, 200)
    bench.move(100_000)
    bench.listen(100)
    assert bench.read(0x80) == 0
    (heard_ns,) = [t_ns for t_ns, text in bench.drive.log if text == "move 100000"]
    assert heard_ns < bench.sent_ns
    bench.listen(1000)
    t_ns, text = bench.drive.log[-1]
    assert text == "alarm 85"
    assert t_ns - bench.sent_ns == pytest.approx(202.5 * NS_PER_MS, abs=NS_PER_MS)
    assert not bench.outputs() & MOVE


# ---------------------------------------------------------------------- communication


def lose_three_frames(bench: AzBench) -> None:
    for _ in range(3):
        assert bench.ask_hex("01 03 00 7E 00 02 00 00") == ""


@pytest.mark.parametrize("code", [0x84, 0x85])
@pytest.mark.parametrize("by_register", [False, True])
def test_a_communication_alarm_brakes_the_motor_and_can_be_reset(bench: AzBench, code: int, by_register: bool) -> None:
    bench.write(0x138A, 400)
    bench.move(100_000, speed=20_000, stop_rate=100_000)
    bench.listen(150)
    if code == 0x84:
        lose_three_frames(bench)
    bench.listen(1000)
    (alarm_ns,) = [t_ns for t_ns, text in bench.drive.log if text == f"alarm {code:02X}"]
    before, speed_hz = bench.axis.setpoint_at(alarm_ns)
    assert speed_hz == pytest.approx(20_000)
    assert bench.axis.setpoint_at(alarm_ns + NS_PER_S // 10)[1] == pytest.approx(10_000)
    assert bench.axis.profile_end_ns - alarm_ns == pytest.approx(NS_PER_S // 5, abs=2)
    assert bench.read(0xC6) == pytest.approx(before + 2000, abs=1)
    assert bench.outputs() == IN_POSITION | ALARM | HOME_END
    assert bench.move(0) == 4
    assert [bench.read(0x80), bench.read(0x82)] == [code, code]
    assert (bench.write(0x180, 1) if by_register else bench.inputs(ALARM_RESET)) == 0
    assert [bench.read(0x80), bench.read(0x82)] == [0, code]
    assert bench.move(0) == 0
    bench.listen(1000)
    assert bench.drive.alarm == 0x85  # the time-out is watched again


def test_the_time_out_is_watched_from_the_first_frame_on(bench: AzBench) -> None:
    bench.drive.set_up(0x138A, 50)
    bench.listen(5000)
    bench.ask(b"\x07\x03\x00\x7e\x00\x02\xa4\x75")  # another unit's
    bench.listen(5000)
    assert bench.drive.alarm == 0
    bench.outputs()
    bench.listen(100)
    assert bench.drive.alarm == 0x85


def test_steady_traffic_keeps_the_time_out_away(bench: AzBench) -> None:
    bench.write(0x138A, 50)
    for _ in range(50):
        bench.outputs()  # one every 40 ms
    assert bench.drive.alarm == 0


# ---------------------------------------------------------------------- power


@pytest.mark.parametrize("code", [0x20, 0x28, 0x41, 0x42, 0xF0, 0x30])
def test_switching_off_ends_every_alarm(bench: AzBench, code: int) -> None:
    bench.move(3000)
    bench.wait_ms(1000)
    bench.drive.raise_alarm(bench.t_ns, code)
    bench.drive.power_cycle(bench.t_ns)
    bench.wait_ms(1000)
    assert [bench.read(0x80), bench.read(0x82)] == [0, code]
    assert bench.outputs() == IN_POSITION | READY | HOME_END
    assert bench.read(0xC6) == 3000
    assert bench.texts() == ["move 3000", f"alarm {code:02X}", "power on"]


def test_for_a_second_after_power_on_nothing_is_heard(bench: AzBench) -> None:
    bench.drive.power_cycle(bench.t_ns)
    bench.wait_ms(990)
    assert bench.ask_hex("01 03 00 80 00 02 C5 E3") == ""
    assert bench.ask_hex("01 03 00 80 00 02 C5 E3") == NO_ALARM
    bench.drive.power_cycle(bench.t_ns)
    lose_three_frames(bench)
    bench.wait_ms(1000)
    assert bench.read(0x80) == bench.read(0xAC) == 0


def test_power_off_stops_the_motor_and_forgets_what_a_host_has_written(bench: AzBench) -> None:
    bench.drive.set_up(0x138C, 5)
    bench.write(0x138A, 9000)
    bench.move(100_000)
    bench.inputs(STOP | ZHOME)
    bench.inputs(0)
    bench.move(100_000)
    bench.wait_ms(100)
    bench.inputs(FREE)
    bench.drive.power_cycle(bench.t_ns)
    bench.listen(20_000)
    assert [bench.read(address) for address in (0x138C, 0x138A, 0x7C, 0x5C, 0x80)] == [5, 0, 0, 0, 0]
    assert bench.outputs() == IN_POSITION | READY | HOME_END
