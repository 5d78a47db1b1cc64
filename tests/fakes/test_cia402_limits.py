"""What keeps the emulated drive within its travel, and what it makes of a table that does not follow."""

from __future__ import annotations

import pytest

from microdrivers.core.units import NS_PER_MS
from microdrivers.fakes.cia402.following_error import FollowingErrorWatch
from tests.fakes.canopen_bench import shown
from tests.fakes.drive_bench import ENABLE, PP, DriveBench, ready_drive

REACHED, LIMITED, FOLLOWING_ERROR = 0x400, 0x800, 0x2000
HALT = 0x100


# ---------------------------------------------------------------------- limits


def set_limits(bench: DriveBench, low: int, high: int) -> None:
    assert bench.write(0x607D, low, 4, 1) == 0
    assert bench.write(0x607D, high, 4, 2) == 0


@pytest.mark.parametrize(("target", "end"), [(9000, 5000), (-9000, -4000), (4999, 4999)])
def test_targets_outside_the_software_limits_are_clamped_and_told(target: int, end: int) -> None:
    bench = ready_drive()
    set_limits(bench, -4000, 5000)
    bench.move(target)
    bench.until_reached()
    assert bench.position() == end
    assert bool(bench.status() & LIMITED) == (target != end)
    bench.move(0)
    assert not bench.status() & LIMITED


@pytest.mark.parametrize(("low", "high"), [(0, 0), (5000, -4000), (3, 3)])
def test_limits_that_are_none(low: int, high: int) -> None:
    bench = ready_drive()
    set_limits(bench, low, high)
    bench.move(9000)
    bench.until_reached()
    assert bench.position() == 9000


def test_software_limits_hold_only_after_homing_and_count_from_the_home_position() -> None:
    bench = ready_drive(homed=False)
    set_limits(bench, -4000, 5000)
    bench.move(6000)
    bench.until_reached()
    assert bench.position() == 6000
    bench.write(0x607C, 1000, 4)
    bench.home(37)
    assert bench.position() == -1000
    bench.enable(PP)
    bench.move(9000)
    bench.until_reached()
    assert bench.position() == 4000


def test_a_limit_switch_is_a_fault_and_the_way_back_is_open() -> None:
    bench = ready_drive()
    bench.move(14_000)
    bench.until(lambda: bench.status() & 0x4F == 0x08)
    assert 625.0 < bench.um() < 675.0
    assert bench.read(0x603F) == 0xFF66
    assert bench.read(0x60FD) & 3 == 2
    assert "085 [8] 66 FF 81 00 00 00 00 00" in [shown(due.frame) for due in bench.sent]
    bench.control(0)
    bench.control(0x80)
    bench.enable(PP)
    bench.move(14_000)
    bench.wait_ms(50)
    assert bench.status() & 0x4F == 0x08
    bench.control(0)
    bench.control(0x80)
    bench.enable(PP)
    bench.move(0)
    bench.until_reached()
    assert bench.position() == 0
    assert bench.read(0x60FD) & 3 == 0


@pytest.mark.parametrize("way", ["halt", "turn", "on"])
def test_no_ramp_is_so_long_that_the_table_hits_its_mechanical_ends(way: str) -> None:
    bench = ready_drive(at_um=400.0)
    bench.write(0x6081, 20_000, 4)
    bench.move(4200 if way != "on" else 5000)
    bench.until(lambda: bench.um() > 560.0)
    bench.write(0x6084, 2000, 4)  # 5 mm from full speed to rest
    bench.write(0x6085, 2000, 4)
    if way == "halt":
        bench.control(ENABLE | HALT)
    elif way == "turn":
        bench.move(-2000)
    farthest_um = 0.0
    for _ in range(1000):
        bench.wait_ms(1)
        farthest_um = max(farthest_um, bench.um())
    assert 627.0 < farthest_um <= 675.0
    assert bench.read(0x603F) == 0xFF66


def test_inputs_show_the_switches() -> None:
    bench = ready_drive()
    seen = {}
    for counts in (0, 1100, 1300):  # the home switch is at 50 µm, 1200 counts
        bench.move(counts)
        bench.until_reached()
        seen[counts] = bench.read(0x60FD)
    assert seen == {0: 0, 1100: 0, 1300: 4}
    assert DriveBench(at_um=-630.0).read(0x60FD) == 1


# ---------------------------------------------------------------------- following error


class _Lagging:
    """A motion with a given following error."""

    def __init__(self) -> None:
        self.error = 0
        self.jammed = False

    def moving_at(self, _t_ns: int) -> bool:
        return True

    def following_error_at(self, _t_ns: int) -> int:
        return self.error


def test_a_following_error_has_to_last() -> None:
    bench, motion = ready_drive(), _Lagging()
    watch = FollowingErrorWatch(motion, bench.drive.objects)  # type: ignore[arg-type]
    watch.start(0)
    verdicts = []
    for number in range(1, 60):  # every 4 ms: 20 times too large, once not, and so on
        motion.error = 0 if number % 21 == 0 else -2001
        verdicts.append(watch.advance(watch.due_ns or 0))
    assert not any(verdicts)
    motion.error = 2001
    assert any(watch.advance(watch.due_ns or 0) for _ in range(26))


def test_a_lag_beyond_the_window_is_a_following_error() -> None:
    bench = ready_drive(lag_s=0.010)
    bench.write(0x6065, 60, 4)  # 3 µm; at 500 µm/s the lag is 5 µm
    bench.write(0x6066, 50, 2)
    bench.move(10_000)
    begin_ns = bench.t_ns
    bench.until(lambda: bool(bench.status() & FOLLOWING_ERROR))
    assert bench.read(0x60F4, signed=True) > 60
    bench.until(lambda: bench.status() & 0x4F == 0x08)
    assert 80 <= (bench.t_ns - begin_ns) / NS_PER_MS <= 130
    assert bench.read(0x603F) == 0x8611


def test_a_slow_move_is_within_the_window() -> None:
    bench = ready_drive(lag_s=0.010)
    bench.write(0x6065, 60, 4)
    bench.write(0x6081, 5000, 4)
    bench.move(2000)
    bench.until_reached()
    assert bench.position() == pytest.approx(2000, abs=20)
    assert bench.texts()[-1] == "move 2000"


def test_a_table_that_is_held_has_a_following_error_and_is_not_at_its_target() -> None:
    bench = ready_drive()
    bench.move(10_000)
    bench.wait_ms(200)
    bench.drive.jam(bench.t_ns)
    held_um = bench.um()
    bench.until(lambda: bench.status() & 0x4F == 0x08)
    assert bench.read(0x603F) == 0x8611
    assert not bench.status() & REACHED
    assert bench.um() == pytest.approx(held_um, abs=3.0)
    bench.drive.release(bench.t_ns)
    bench.control(0)
    bench.control(0x80)
    bench.enable(PP)
    bench.move(0)
    bench.until_reached()
    assert bench.position() == 0


def test_a_table_that_is_released_in_time_goes_on() -> None:
    bench = ready_drive()
    bench.write(0x6066, 2000, 2)
    bench.move(10_000)
    bench.wait_ms(200)
    bench.drive.jam(bench.t_ns)
    bench.wait_ms(300)
    assert bench.status() & FOLLOWING_ERROR
    bench.drive.release(bench.t_ns)
    bench.until_reached()
    assert bench.position() == 10_000


def test_no_window_no_following_error() -> None:
    bench = ready_drive()
    bench.write(0x6065, 0xFFFFFFFF, 4)
    bench.drive.jam(bench.t_ns)
    bench.move(10_000)
    bench.wait_ms(3000)
    assert bench.status() & 0x6F == 0x27
    assert not bench.status() & REACHED
