"""The emulated drive's homing mode."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.fakes.drive_bench import ENABLE, HM, PP, SPEC, DriveBench

START, HALT = 0x10, 0x100
RUNNING, NOT_STARTED, ATTAINED, DONE, ERROR = 0x0237, 0x0637, 0x1237, 0x1637, 0x2637
HOME_UM = SPEC.home_um


def begin(method: int, *, at_um: float = -10.0, direction: int = 1, offset: int = 0) -> DriveBench:
    bench = DriveBench(spec=replace(SPEC, direction=direction), at_um=at_um)
    bench.enable(HM)
    assert bench.write(0x6098, method, 1) == 0
    assert bench.write(0x607C, offset, 4) == 0
    bench.control(ENABLE | START)
    return bench


def finish(bench: DriveBench) -> list[int]:
    """The status words until it is over, without repetitions."""
    words = [bench.status()]
    for _ in range(5000):
        bench.wait_ms(20)
        if (word := bench.status()) != words[-1]:
            words.append(word)
        if words[-1] in (DONE, ERROR):
            bench.wait_ms(20)
            return words
    raise AssertionError(f"homing does not end: {words}")


@pytest.mark.parametrize(
    ("method", "at_um", "edge_um", "side"),
    [
        (17, -10.0, -625.0, 1),
        (17, -640.0, -625.0, 1),
        (18, -10.0, 625.0, -1),
        (18, 640.0, 625.0, -1),
        (24, -10.0, HOME_UM, -1),
        (24, 300.0, HOME_UM, -1),
        (28, 300.0, HOME_UM, 1),
        (28, -300.0, HOME_UM, 1),
        (33, 300.0, HOME_UM, -1),
        (33, -300.0, HOME_UM, 1),  # by way of the limit switch
        (34, -300.0, HOME_UM, 1),
        (34, 300.0, HOME_UM, -1),
    ],
)
@pytest.mark.parametrize("direction", [1, -1])
def test_the_edge_becomes_the_zero(method: int, at_um: float, edge_um: float, side: int, direction: int) -> None:
    if direction < 0 and method in (17, 18):
        at_um, edge_um = -at_um, -edge_um
    elif direction < 0:  # what lies on the one side for the stage lies on the other for the drive
        at_um = 2 * HOME_UM - at_um
    bench = begin(method, at_um=at_um, direction=direction)
    words = finish(bench)
    assert words[0] == RUNNING
    assert words[-1] == DONE
    assert set(words) <= {RUNNING, ATTAINED, DONE}
    assert direction * (bench.um() - edge_um) * side == pytest.approx(0.22, abs=0.03)  # a little beyond
    assert bench.position() == pytest.approx(direction * (bench.um() - edge_um) * 20, abs=1.01)
    assert bench.drive.homing.homed
    assert bench.texts()[-2:] == [f"home {method}", "homed"]


@pytest.mark.parametrize("method", [35, 37])
def test_here_is_home(method: int) -> None:
    bench = begin(method)
    assert bench.status() == DONE
    assert bench.position() == 0
    assert bench.um() == -10.0


@pytest.mark.parametrize("offset", [12_500, -300])
def test_the_home_position_is_minus_the_offset(offset: int) -> None:
    bench = begin(17, offset=offset)
    finish(bench)
    assert bench.position() + offset == pytest.approx((bench.um() + 625.0) * 20, abs=1.01)


def test_the_switch_is_sought_fast_and_left_slowly() -> None:
    bench = begin(17)
    speeds = []
    while bench.status() & 0x3400 == 0:
        speeds.append(bench.read(0x606C, signed=True))
        bench.wait_ms(20)
    assert min(speeds) == -5000
    assert max(speeds) == pytest.approx(1000, abs=1)
    assert bench.read(0x60FD) == 0
    assert bench.write(0x6099, 20_001, 4, 1) == 0x06090031
    assert bench.write(0x6099, 0, 4, 2) == 0x06090032


def test_no_method_no_home() -> None:
    bench = begin(0)
    assert bench.status() == ERROR
    assert bench.texts()[-2:] == ["home 0", "home error"]
    for method in (1, 19, 36, -1):
        assert bench.write(0x6098, method, 1) == 0x06090030


@pytest.mark.parametrize("word", [ENABLE, ENABLE | START | HALT])
def test_taking_the_start_back_or_halting_interrupts(word: int) -> None:
    bench = begin(17)
    bench.wait_ms(200)
    bench.control(word)
    bench.wait_ms(200)
    assert bench.status() == NOT_STARTED
    assert bench.read(0x606C, signed=True) == 0
    assert not bench.drive.homing.homed
    assert bench.texts()[-1] == "home interrupted"
    bench.control(ENABLE)
    bench.control(ENABLE | START)
    assert finish(bench)[-1] == DONE


def test_the_start_bit_needs_an_edge() -> None:
    bench = begin(37)
    bench.control(ENABLE | START)
    bench.mode(PP)
    bench.mode(HM)
    bench.control(ENABLE | START)
    assert bench.texts().count("home 37") == 1
    assert bench.status() == DONE  # the zero is still known
    bench.control(ENABLE)
    bench.control(ENABLE | START)
    assert bench.texts().count("home 37") == 2


def test_power_off_interrupts() -> None:
    bench = begin(18)
    bench.wait_ms(100)
    bench.control(0)
    bench.wait_ms(100)
    assert bench.status() == 0x0650
    assert bench.read(0x606C, signed=True) == 0


def test_a_table_that_is_held_never_gets_home() -> None:
    bench = begin(17)
    bench.wait_ms(100)
    bench.drive.jam(bench.t_ns)
    bench.until(lambda: bench.status() & 0x4F == 0x08)
    assert bench.status() & 0x3400 == 0x2400
    assert bench.read(0x603F) == 0x8611
    assert not bench.drive.homing.homed


def test_a_table_that_is_held_finds_nothing_even_if_the_drive_does_not_mind() -> None:
    bench = begin(17)
    bench.write(0x6065, 0xFFFFFFFF, 4)
    bench.wait_ms(100)
    bench.drive.jam(bench.t_ns)
    bench.wait_ms(10_000)
    assert bench.status() == RUNNING
    assert not bench.drive.homing.homed


def test_homing_loses_an_earlier_zero_until_it_is_done() -> None:
    bench = begin(37)
    bench.control(ENABLE)
    bench.write(0x6098, 18, 1)
    bench.control(ENABLE | START)
    assert not bench.drive.homing.homed
    finish(bench)
    assert bench.position() == pytest.approx((bench.um() - 625.0) * 20, abs=1.01)
