"""The emulated drive's profile position mode on an axis of the world."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.units import NS_PER_MS, NS_PER_S
from tests.fakes.drive_bench import ENABLE, PP, SPEC, DriveBench, ready_drive

REACHED, ACKNOWLEDGED = 0x400, 0x1000
HALT, START, IMMEDIATELY, RELATIVE = 0x100, 0x10, 0x20, 0x40


# ---------------------------------------------------------------------- the hand-over


def test_set_point_handshake() -> None:
    bench = ready_drive()
    bench.wait_ms(50)
    assert bench.status() == 0x0637
    bench.write(0x607A, 2000, 4)
    assert bench.control(ENABLE | START | IMMEDIATELY) == 0x1237
    bench.wait_ms(50)
    assert bench.status() == 0x1237  # until the start bit is taken back
    assert bench.control(ENABLE | IMMEDIATELY) == 0x0237
    bench.until_reached()
    assert bench.status() == 0x0637
    assert bench.position() == 2000
    assert bench.um() == pytest.approx(90.0, abs=0.06)
    assert bench.texts()[-1] == "move 2000"


def test_no_edge_no_move() -> None:
    bench = ready_drive()
    bench.move(2000)
    bench.until_reached()
    bench.control(ENABLE | START)
    bench.write(0x607A, 4000, 4)
    bench.control(ENABLE | START | IMMEDIATELY)
    bench.wait_ms(500)
    assert bench.position() == 2000
    assert bench.texts()[-2:] == ["move 2000", "move 2000"]


def test_a_second_set_point_waits_its_turn_and_a_third_is_not_taken() -> None:
    bench = ready_drive()
    assert bench.move(2000, bits=0) & ACKNOWLEDGED
    assert not bench.status() & ACKNOWLEDGED
    assert bench.move(-2000, bits=0) & ACKNOWLEDGED
    assert bench.status() & ACKNOWLEDGED  # no room for another
    bench.move(5000, bits=0)
    highest = 0
    while not bench.status() & REACHED or bench.status() & ACKNOWLEDGED:
        highest = max(highest, bench.position())
        bench.wait_ms(1)
    assert highest == pytest.approx(2000, abs=2)
    assert bench.position() == -2000
    assert bench.texts()[-2:] == ["move 2000", "move -2000"]


def test_change_immediately_replaces_all() -> None:
    bench = ready_drive()
    bench.move(10_000)
    bench.wait_ms(100)
    bench.move(12_000, bits=0)
    bench.move(-1000)
    assert not bench.status() & ACKNOWLEDGED
    bench.until_reached()
    assert bench.position() == -1000
    assert bench.texts()[-2:] == ["move 10000", "move -1000"]


@pytest.mark.parametrize(("relative_to", "end"), [(0, 6000), (1, 4000), (2, 4000)])
def test_relative_to_the_last_target_to_the_demand_or_to_where_it_is(relative_to: int, end: int) -> None:
    bench = ready_drive()
    bench.write(0x60F2, relative_to, 2)
    bench.move(4000)
    bench.wait_ms(150)
    demand = bench.read(0x6062, signed=True)
    bench.move(2000, bits=IMMEDIATELY | RELATIVE)
    bench.until_reached()
    assert bench.position() == (end if relative_to == 0 else pytest.approx(demand + 2000, abs=60))


def test_nothing_moves_without_power_or_in_another_mode() -> None:
    bench = DriveBench()
    bench.mode(PP)
    bench.write(0x607A, 1000, 4)
    bench.control(ENABLE | START)
    bench.enable(0)
    bench.control(ENABLE | START)
    bench.wait_ms(200)
    assert bench.um() == -10.0


def test_a_change_of_mode_stops() -> None:
    bench = ready_drive()
    bench.move(10_000)
    bench.wait_ms(200)
    bench.mode(0)
    bench.wait_ms(300)
    assert bench.read(0x606C, signed=True) == 0
    assert bench.position() < 5000
    assert bench.write(0x6060, 3, 1) == 0x06090030
    assert bench.write(0x6060, 8, 1) == 0x06090030


# ---------------------------------------------------------------------- halt


def test_halt_keeps_the_target() -> None:
    bench = ready_drive()
    bench.move(10_000)
    bench.wait_ms(200)
    bench.control(ENABLE | HALT)
    assert not bench.status() & REACHED
    bench.wait_ms(200)
    assert bench.status() & REACHED  # while halted: it stands
    stood = bench.position()
    assert 0 < stood < 9000
    bench.control(ENABLE)
    assert not bench.status() & REACHED
    bench.until_reached()
    assert bench.position() == 10_000
    assert bench.texts()[-3:] == ["move 10000", "halt", "go on"]


def test_a_set_point_during_halt_is_followed_after_it() -> None:
    bench = ready_drive()
    bench.control(ENABLE | HALT)
    bench.write(0x607A, 1000, 4)
    assert bench.control(ENABLE | HALT | START) & ACKNOWLEDGED
    bench.wait_ms(200)
    assert bench.position() == 0
    bench.control(ENABLE)
    bench.until_reached()
    assert bench.position() == 1000


# ---------------------------------------------------------------------- how it moves


def test_speed_and_ramps_are_those_of_the_set_point() -> None:
    bench = ready_drive()
    bench.write(0x6081, 4000, 4)
    bench.write(0x6083, 40_000, 4)
    bench.write(0x6084, 20_000, 4)
    begin_ns = bench.t_ns
    bench.move(8000)
    bench.write(0x6081, 1000, 4)  # for the next one
    fastest = 0
    while not bench.status() & REACHED:
        bench.wait_ms(1)
        fastest = max(fastest, bench.read(0x606C, signed=True))
    assert fastest == pytest.approx(4000, abs=5)
    # 0.1 s and 0.2 s of ramps, 600 counts together; then the rest at full speed, and settling.
    assert (bench.t_ns - begin_ns) / NS_PER_S == pytest.approx(0.3 + 7400 / 4000, abs=0.03)


def test_607f_bounds_the_speed() -> None:
    bench = ready_drive()
    bench.write(0x6081, 20_000, 4)
    bench.write(0x607F, 2000, 4)
    bench.move(2000)
    bench.wait_ms(500)
    assert bench.read(0x606C, signed=True) == pytest.approx(2000, abs=2)
    assert bench.write(0x607F, 20_001, 4) == 0x06090031
    for index in (0x6081, 0x6083, 0x6084, 0x6085, 0x609A):
        assert bench.write(index, 0, 4) == 0x06090032


def test_target_reached_is_never_early_and_asks_for_window_and_time() -> None:
    bench = ready_drive(lag_s=0.010)
    bench.write(0x6067, 3, 4)
    bench.write(0x6068, 20, 2)
    bench.move(5000)
    inside_since_ns: int | None = None
    while not bench.status() & REACHED:
        if abs(bench.um() - 240.0) > 0.15:
            inside_since_ns = None
        elif inside_since_ns is None:
            inside_since_ns = bench.t_ns
        bench.wait_ms(0.5)
    assert inside_since_ns is not None
    assert 20 * NS_PER_MS <= bench.t_ns - inside_since_ns + NS_PER_MS // 2 <= 23 * NS_PER_MS


def test_counts_against_the_stages_axis() -> None:
    bench = ready_drive(spec=replace(SPEC, direction=-1))
    bench.move(2000)
    bench.until_reached()
    assert bench.position() == 2000
    assert bench.um() == pytest.approx(-110.0, abs=0.06)


def test_the_reading_has_noise_and_whole_counts() -> None:
    bench = ready_drive(noise_um=0.05)
    bench.move(1000)
    bench.until_reached()
    readings = {bench.position() for _ in range(200)}
    assert len(readings) >= 4
    assert abs(sum(readings) / len(readings) - 1000) < 3


@given(targets=st.lists(st.integers(-10_000, 10_000), min_size=1, max_size=4), lag_ms=st.floats(0.5, 10.0))
@settings(deadline=None, max_examples=12)
def test_any_target_is_reached_to_a_count(targets: list[int], lag_ms: float) -> None:
    bench = ready_drive(lag_s=lag_ms / 1000)
    bench.write(0x6067, 1, 4)
    for target in targets:
        bench.move(target)
        bench.until(lambda: bool(bench.status() & REACHED), step_ms=20)
        assert abs(bench.position() - target) <= 1
        assert bench.um() == pytest.approx(-10 + target / 20, abs=0.06)
