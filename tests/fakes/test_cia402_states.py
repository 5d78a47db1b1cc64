"""The emulated drive's state machine: every way from every state, options for stopping, faults and their reset."""

from __future__ import annotations

import pytest

from microdrivers.core.units import NS_PER_MS
from microdrivers.fakes.canopen import PROMPT, NmtState
from microdrivers.fakes.cia402 import Reaction
from microdrivers.fakes.cia402.states import State, commanded_state
from tests.fakes.canopen_bench import shown
from tests.fakes.drive_bench import (
    DISABLE_VOLTAGE,
    ENABLE,
    HM,
    NODE,
    PP,
    QUICK_STOP,
    RESET,
    SHUTDOWN,
    SWITCH_ON,
    DriveBench,
)

OFF, READY, ON, ENABLED, STOPPING = (
    State.SWITCH_ON_DISABLED, State.READY, State.SWITCHED_ON, State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE,
)  # fmt: skip
FAST = 12500


@pytest.mark.parametrize(
    ("state", "ways"),
    [
        (OFF, {SHUTDOWN: READY, SWITCH_ON: OFF, ENABLE: OFF, DISABLE_VOLTAGE: OFF, QUICK_STOP: OFF}),
        (READY, {SHUTDOWN: READY, SWITCH_ON: ON, ENABLE: ENABLED, DISABLE_VOLTAGE: OFF, QUICK_STOP: OFF}),
        (ON, {SHUTDOWN: READY, SWITCH_ON: ON, ENABLE: ENABLED, DISABLE_VOLTAGE: OFF, QUICK_STOP: OFF}),
        (ENABLED, {SHUTDOWN: READY, SWITCH_ON: ON, ENABLE: ENABLED, DISABLE_VOLTAGE: OFF, QUICK_STOP: STOPPING}),
        (STOPPING, {SHUTDOWN: STOPPING, SWITCH_ON: STOPPING, DISABLE_VOLTAGE: OFF, QUICK_STOP: STOPPING}),
        (State.FAULT, dict.fromkeys((SHUTDOWN, SWITCH_ON, ENABLE, DISABLE_VOLTAGE, QUICK_STOP), State.FAULT)),
    ],
)
def test_where_control_words_lead(state: State, ways: dict[int, State]) -> None:
    assert {word: commanded_state(state, word) for word in ways} == ways


def test_status_words_on_the_usual_way() -> None:
    bench = DriveBench()
    assert bench.status() == 0x0250
    assert bench.control(ENABLE) == 0x0250
    assert [bench.control(word) for word in (SHUTDOWN, SWITCH_ON, ENABLE)] == [0x0231, 0x0233, 0x0237]
    assert [bench.control(word) for word in (SWITCH_ON, SHUTDOWN, ENABLE)] == [0x0233, 0x0231, 0x0237]
    assert bench.control(DISABLE_VOLTAGE) == 0x0250
    assert bench.texts() == ["enable", "disable"] * 2


def test_a_drive_takes_a_moment_and_loses_nothing() -> None:
    bench = DriveBench(reaction=Reaction(control_s=(0.001, 0.001), enable_s=(0.005, 0.005)))
    for word in (SHUTDOWN, SWITCH_ON, ENABLE, DISABLE_VOLTAGE):
        bench.write(0x6040, word, 2)
    assert bench.status() == 0x0250
    bench.wait_ms(1)
    assert bench.status() == 0x0233
    bench.wait_ms(10)
    assert bench.texts() == ["enable", "disable"]
    (enabled_ns, _), (disabled_ns, _) = bench.drive.log
    assert disabled_ns == enabled_ns  # in their order, the later one not before the earlier


# ---------------------------------------------------------------------- stopping


def moving(bench: DriveBench | None = None, **options: int) -> DriveBench:
    """A drive at full speed, with options such as `x605A` set."""
    bench = bench or DriveBench()
    for name, value in options.items():
        assert bench.write(int(name[1:], 16), value, 2) == 0
    bench.home(37)
    bench.enable()
    bench.write(0x6081, 20000, 4)
    bench.move(FAST)
    bench.wait_ms(300)
    assert bench.read(0x606C, signed=True) == pytest.approx(20000, abs=20)
    return bench


def run_out_um(bench: DriveBench) -> float:
    """How far the table still goes."""
    before = bench.um()
    bench.wait_ms(1000)
    assert bench.read(0x606C, signed=True) == 0
    return bench.um() - before


SLOW_RAMP_UM, QUICK_RAMP_UM, LET_GO_UM = 50.0, 12.5, 5.0
"""From 1000 µm/s with 10 000, 40 000 and 100 000 µm/s²."""


@pytest.mark.parametrize(
    ("option", "word", "length_um", "state"),
    [
        ({"x605A": 0}, QUICK_STOP, LET_GO_UM, OFF),
        ({"x605A": 1}, QUICK_STOP, SLOW_RAMP_UM, OFF),
        ({"x605A": 2}, QUICK_STOP, QUICK_RAMP_UM, OFF),
        ({"x605A": 5}, QUICK_STOP, SLOW_RAMP_UM, STOPPING),
        ({"x605A": 6}, QUICK_STOP, QUICK_RAMP_UM, STOPPING),
        ({"x605B": 0}, SHUTDOWN, LET_GO_UM, READY),
        ({"x605B": 1}, SHUTDOWN, SLOW_RAMP_UM, READY),
        ({"x605C": 0}, SWITCH_ON, LET_GO_UM, ON),
        ({"x605C": 1}, SWITCH_ON, SLOW_RAMP_UM, ON),
        ({}, DISABLE_VOLTAGE, LET_GO_UM, OFF),
        ({"x605D": 1}, ENABLE | 0x100, SLOW_RAMP_UM, ENABLED),
        ({"x605D": 2}, ENABLE | 0x100, QUICK_RAMP_UM, ENABLED),
    ],
)
def test_how_a_drive_stops(option: dict[str, int], word: int, length_um: float, state: State) -> None:
    bench = moving(**option)
    bench.control(word)
    # The table lags 2 µm behind, and goes on for some frames before it is looked at.
    assert run_out_um(bench) == pytest.approx(length_um, abs=2.6)
    assert bench.drive.state is state
    assert bench.status() & 0x1000 == 0
    if state is not ENABLED:
        assert bench.status() & 0x400 == 0  # the target was not reached


def test_quick_stop_active_while_it_brakes() -> None:
    bench = moving()
    assert bench.control(QUICK_STOP) & 0x6F == 0x07
    assert bench.control(ENABLE) & 0x6F == 0x07  # it ends without power
    bench.wait_ms(100)
    assert bench.status() & 0x4F == 0x40
    assert bench.texts()[-3:] == [f"move {FAST}", "quick stop", "disable"]


def test_operation_goes_on_after_a_quick_stop_that_stays() -> None:
    bench = moving(x605A=6)
    bench.control(QUICK_STOP)
    bench.wait_ms(100)
    assert bench.control(ENABLE) & 0x6F == 0x27
    bench.move(0)
    bench.until_reached()
    assert bench.um() == pytest.approx(-10.0, abs=0.1)


def test_enabling_again_takes_a_disable_back() -> None:
    bench = moving()
    bench.control(SWITCH_ON)
    bench.control(ENABLE)
    bench.wait_ms(1000)
    assert bench.drive.state is ENABLED
    assert bench.position() < FAST


# ---------------------------------------------------------------------- faults


@pytest.mark.parametrize(("option", "length_um"), [(0, LET_GO_UM), (1, SLOW_RAMP_UM), (2, QUICK_RAMP_UM)])
def test_a_fault_stops_the_motion_as_605e_says(option: int, length_um: float) -> None:
    bench = moving(x605E=option)
    bench.drive.inject_fault(bench.t_ns, 0x2310)
    reaction = bench.status()
    assert reaction & 0x4F == (0x08 if option == 0 else 0x0F)
    assert [shown(due.frame) for due in bench.sent if due.frame.id == 0x085] == ["085 [8] 10 23 03 00 00 00 00 00"]
    assert run_out_um(bench) == pytest.approx(length_um, abs=2.6)
    assert bench.status() & 0x44F == 0x08
    assert bench.read(0x603F) == 0x2310
    assert bench.read(0x1001) == 0x03


def test_a_fault_is_left_with_an_edge_only_and_when_its_cause_is_gone() -> None:
    bench = DriveBench()
    bench.enable()
    bench.drive.inject_fault(bench.t_ns, 0x4310, lasting=True)
    assert bench.control(RESET) & 0x4F == 0x08
    bench.drive.remove_cause(bench.t_ns, 0x4310)
    assert bench.control(RESET) & 0x4F == 0x08  # no edge
    bench.control(0)
    bench.sent.clear()
    assert bench.control(RESET) & 0x4F == 0x40
    assert "085 [8] 00 00 00 00 00 00 00 00" in [shown(due.frame) for due in bench.sent]
    assert bench.read(0x603F) == 0
    assert bench.read(0x1001) == 0
    assert bench.texts() == ["enable", "fault 4310", "disable", "fault reset"]
    bench.control(RESET)
    assert bench.texts()[-1] == "fault reset"
    bench.enable()


def test_an_encoder_fault_loses_the_home_position() -> None:
    bench = DriveBench()
    assert bench.home(37) == 0x1637
    bench.drive.inject_fault(bench.t_ns, 0x7300)
    bench.control(0)
    bench.control(RESET)
    assert bench.status() == 0x0650


def test_a_fault_during_homing_ends_it_with_an_error() -> None:
    bench = DriveBench(at_um=-500.0)
    bench.enable(HM)
    bench.write(0x6098, 17, 1)
    bench.control(ENABLE | 0x10)
    bench.wait_ms(20)
    bench.drive.inject_fault(bench.t_ns, 0x3210)
    bench.wait_ms(200)
    assert bench.status() == 0x2618
    assert bench.texts()[-3:] == ["fault 3210", "home error", "disable"]
    assert not bench.drive.homing.homed


# ---------------------------------------------------------------------- communication


def test_the_drive_stops_when_the_masters_heartbeat_ends() -> None:
    bench = moving()
    bench.write(0x1016, 1 << 16 | 100, 4, 1)
    bench.operational()
    bench.put(0x701, "05")
    heard_ns = bench.t_ns
    bench.wait_ms(99)
    assert bench.drive.state is ENABLED
    bench.wait_ms(200)
    assert bench.status() & 0x4F == 0x08
    assert bench.drive.log[-2] == (heard_ns + 100 * NS_PER_MS, "fault 8130")
    assert bench.read(0x606C, signed=True) == 0
    emergencies = [shown(due.frame) for due in bench.sent if due.frame.id == 0x085]
    assert emergencies == ["085 [8] 30 81 11 01 00 00 00 00"]
    assert bench.node.state is NmtState.PRE_OPERATIONAL
    bench.put(0x701, "05")
    assert bench.status() & 0x4F == 0x08  # not before it is reset
    bench.control(0)
    assert bench.control(RESET) & 0x4F == 0x40


@pytest.mark.parametrize(
    ("option", "state"), [(0, ENABLED), (1, State.FAULT), (2, OFF), (3, OFF)]
)  # nothing, fault, disable voltage, quick stop
def test_what_a_missing_heartbeat_does_is_said_by_6007(option: int, state: State) -> None:
    bench = moving(x6007=option)
    bench.write(0x1016, 1 << 16 | 100, 4, 1)
    bench.put(0x701, "05")
    bench.wait_ms(200)
    assert bench.drive.state is state


@pytest.mark.parametrize("command", [0x02, 0x82])
def test_a_moving_drive_that_is_stopped_or_reset_by_the_network_has_a_fault(command: int) -> None:
    bench = moving()
    bench.nmt(command)
    bench.wait_ms(200)
    bench.nmt(0x80)
    assert bench.status() & 0x4F == 0x08
    assert bench.read(0x603F) == 0x8100
    assert bench.drive.homing.homed


@pytest.mark.parametrize("command", [0x02, 0x82])
def test_a_drive_without_power_does_not_mind(command: int) -> None:
    bench = DriveBench()
    bench.operational()
    bench.nmt(command)
    bench.nmt(0x80)
    assert bench.status() == 0x0250
    assert bench.texts() == []


def test_after_a_power_cycle_nothing_is_known() -> None:
    bench = moving(DriveBench(temper=PROMPT._replace(power_on_s=(0.5, 0.5))))
    bench.drive.power_cycle(bench.t_ns)
    before_um = bench.um()
    assert bench.wait_ms(499) == []
    assert [shown(frame) for frame in bench.wait_ms(2)] == [f"{0x700 + NODE:03X} [1] 00"]
    assert bench.um() - before_um == pytest.approx(LET_GO_UM, abs=2.5)
    bench.wait_ms(10)
    assert abs(bench.position()) <= 1
    assert bench.status() == 0x0250
    assert not bench.drive.homing.homed
    assert bench.texts()[-1] == "restart"
    bench.mode(PP)
    bench.enable()


def test_a_node_reset_by_the_network_forgets_as_much() -> None:
    bench = moving()
    bench.nmt(0x81)
    bench.wait_ms(100)
    assert bench.status() == 0x0250
    assert abs(bench.position()) <= 1
