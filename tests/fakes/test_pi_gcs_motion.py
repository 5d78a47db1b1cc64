"""The emulated controller in motion: when it samples, when it is on target, what stops it, what it forgets."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.fakes.pi_gcs.controller import REPLY_DELAY_S
from tests.fakes.gcs_bench import NOT_READY, READY, BenchWorld, GcsBench

WINDOW_UM = 0.15
SETTLING_NS = 20 * NS_PER_MS


@pytest.fixture
def ready() -> GcsBench:
    bench = GcsBench()
    bench.reference()
    return bench


def events(bench: GcsBench) -> list[str]:
    return [text for _, text in bench.controller.events]


# ---------------------------------------------------------------------- time


def test_replies_leave_within_the_stated_delay_and_in_order(ready: GcsBench) -> None:
    delays = []
    for _ in range(200):
        ready.wait(0.01)
        (reply,) = ready.put(b"POS?\n")
        delays.append((reply.t_ns - ready.t_ns) / NS_PER_S)
    low, high = REPLY_DELAY_S
    assert low <= min(delays) < 1.1 * low
    assert 0.9 * high < max(delays) <= high
    ready.wait(0.01)
    first, second, third = ready.put(b"POS?\n\x04MOV 1 7.1\nERR?\n")
    assert first.data.startswith(b"1=7.5")
    assert second.data.startswith(b"0x")
    assert third.data == b"0\n"
    assert first.t_ns <= second.t_ns <= third.t_ns


def test_the_position_is_sampled_after_the_requests_last_byte() -> None:
    bench = GcsBench(BenchWorld(latch_delay_s=0.0004))
    bench.reference()
    bench.line("MOV 1 0 2 15 3 100")
    for _ in range(50):
        bench.wait(0.0137)
        (reply,) = bench.put(b"POS?\n")
        x_mm, y_mm, theta_deg = (float(row.split("=")[1]) for row in reply.data.decode().split(" \n"))
        latch_ns = bench.t_ns + 400_000
        true = {key: axis.position_at(latch_ns) for key, axis in bench.world.stage_axes.items()}
        # The axis travels 0.6 µm (12 counts) during the delay: no other instant would do.
        assert 1000.0 * x_mm == pytest.approx(true["x"], abs=0.0251)
        assert 1000.0 * y_mm == pytest.approx(true["y"], abs=0.0251)
        assert theta_deg == pytest.approx(true["theta"], abs=2.26e-5)
        assert reply.t_ns >= latch_ns


def test_commands_act_when_their_line_feed_arrives(ready: GcsBench) -> None:
    begin_ns = ready.t_ns
    ready.put(b"MOV 1 7.1\nMOV 2 7.2\n\x18")
    byte_ns = (ready.t_ns - begin_ns) // 21
    assert ready.controller.events[-3:] == [
        (begin_ns + 10 * byte_ns, "move x 7.1"),
        (begin_ns + 20 * byte_ns, "move y 7.2"),
        (begin_ns + 21 * byte_ns, "stop #24"),
    ]


@settings(deadline=None, derandomize=True, max_examples=30)
@given(
    targets_um=st.lists(st.floats(7300.0, 7700.0), min_size=1, max_size=3),
    between_ms=st.floats(0.0, 60.0),
    play_um=st.sampled_from([0.0, 0.5]),
)
def test_on_target_is_never_early(targets_um: list[float], between_ms: float, play_um: float) -> None:
    bench = GcsBench(BenchWorld(lost_motion_um=play_um))
    bench.reference()
    for number, target_um in enumerate(targets_um):
        bench.wait(between_ms / 1000 if number else 0.0)
        bench.line(f"MOV 1 {target_um / 1000:.9f}")
    axis = bench.world.stage_axes["x"]
    was_on = False
    for _ in range(1500):
        on = bench.line("ONT? 1") == "1=1"
        assert on or not was_on
        if on:
            since_ns = bench.t_ns - SETTLING_NS
            for t in np.linspace(since_ns, bench.t_ns + NS_PER_S, 200).astype(int).tolist():
                assert abs(axis.position_at(t) - target_um) <= WINDOW_UM + 0.025
            assert not axis.moving_at(since_ns)
        if on and not was_on:
            assert bench.t_ns - axis.profile_end_ns < SETTLING_NS + 30 * NS_PER_MS
        if on and was_on:
            break
        was_on = on
        bench.wait(0.001)
    assert was_on


def test_on_target_obeys_window_and_settling_time(ready: GcsBench) -> None:
    axis = ready.world.stage_axes["x"]
    for window, settling_ms, latest_ms in ((3, 20, 30), (3, 200, 210), (0, 20, 40), (1000, 0, 1)):
        ready.line(f"SPA 1 0x36 {window} 1 0x3F {settling_ms / 1000}")
        assert ready.error_after("MVR 1 0.1") == 0
        assert ready.line("ONT? 1") == "1=0"
        ready.t_ns = axis.profile_end_ns + settling_ms * NS_PER_MS - 300_000 * 3
        assert ready.line("ONT? 1") == "1=0"
        ready.t_ns = axis.profile_end_ns + latest_ms * NS_PER_MS
        assert ready.line("ONT? 1") == "1=1"


def test_on_target_needs_the_servo(ready: GcsBench) -> None:
    ready.line("SVO 1 0")
    assert ready.line("ONT? 1 2") == "1=0 \n2=1"
    ready.line("SVO 1 1")
    assert ready.line("ONT? 1") == "1=0"
    ready.wait(0.021)
    assert ready.line("ONT? 1") == "1=1"


# ---------------------------------------------------------------------- profiles


def test_velocity_and_rates_shape_the_motion(ready: GcsBench) -> None:
    axis = ready.world.stage_axes["x"]
    assert ready.error_after("VEL 1 1.2") == 0
    assert ready.error_after("ACC 1 10") == 0
    assert ready.error_after("DEC 1 2.5") == 0
    ready.line("MOV 1 5")
    begin_ns = ready.t_ns
    assert axis.setpoint_at(begin_ns + 100 * NS_PER_MS)[1] == pytest.approx(-1000.0)
    assert axis.setpoint_at(begin_ns + 200 * NS_PER_MS)[1] == pytest.approx(-1200.0)
    assert axis.setpoint_at(axis.profile_end_ns - 100 * NS_PER_MS)[1] == pytest.approx(-250.0)


def test_targets_are_whole_counts_but_relative_moves_add_up(ready: GcsBench) -> None:
    for _ in range(5):
        ready.line("MVR 1 0.00001")
        ready.wait(0.1)
    assert ready.line("MOV? 1") == "1=7.5000500"
    assert ready.true_position("x") == pytest.approx(7500.05, abs=1e-6)


def test_readings_are_noisy_and_repeat_with_the_seed() -> None:
    runs = []
    for seed in (1, 1, 2):
        bench = GcsBench(BenchWorld(noise_um=0.2), seed=seed)
        bench.reference()
        runs.append([float(bench.line("POS? 1").removeprefix("1=")) for _ in range(300)])
    assert runs[0] == runs[1] != runs[2]
    spread_um = 1000.0 * np.std(runs[0])
    assert spread_um == pytest.approx(0.2, rel=0.15)


# ---------------------------------------------------------------------- stopping


@pytest.mark.parametrize(
    ("request_", "event", "within_um"),
    [
        (b"\x18", "stop #24", 2.0),
        (b"STP\n", "stop STP", 2.0),
        (b"HLT 1\n", "halt x", 57.0),
        (b"HLT\n", "halt theta", 57.0),
    ],
)
def test_stop_during_a_move(ready: GcsBench, request_: bytes, event: str, within_um: float) -> None:
    ready.line("MOV 1 0")
    ready.wait(1.0)
    axis = ready.world.stage_axes["x"]
    ready.put(request_)
    begun_um = axis.setpoint_at(ready.t_ns)[0]
    assert events(ready)[-1] == event
    assert ready.error() == 10
    ready.wait(0.2)
    assert begun_um - within_um <= ready.true_position("x") <= begun_um
    assert axis.speed_at(ready.t_ns) == pytest.approx(0.0, abs=1e-6)
    assert ready.line("MOV? 1") == ready.line("MOV? 1")
    assert float(ready.line("MOV? 1").removeprefix("1=")) * 1000.0 == pytest.approx(ready.true_position("x"), abs=0.1)
    assert ready.line("ONT? 1") == "1=1"
    assert ready.line("FRF? 1") == "1=1"


def test_halting_one_axis_leaves_the_others_alone(ready: GcsBench) -> None:
    ready.line("MOV 1 0 2 0")
    ready.wait(0.5)
    ready.line("HLT 1")
    ready.wait(0.2)
    assert ready.ask(b"\x05") == b"2\n"


def test_a_weak_deceleration_does_not_run_past_the_end(ready: GcsBench) -> None:
    ready.line("MOV 1 0")
    ready.wait(4.85)
    ready.line("DEC 1 0.01")
    ready.line("HLT 1")
    ready.wait(1000.0)
    assert ready.true_position("x") == pytest.approx(0.0, abs=0.1)
    assert not ready.world.stage_axes["x"].moving_at(ready.t_ns)


def test_servo_off_ends_the_motion(ready: GcsBench) -> None:
    ready.line("MOV 1 0")
    ready.wait(1.0)
    before_um = ready.true_position("x")
    ready.line("SVO 1 0")
    ready.wait(1.0)
    assert ready.true_position("x") == pytest.approx(before_um, abs=10.0)
    assert events(ready)[-1] == "servo x off"
    assert ready.error_after("MOV 1 1") == 5


def test_a_motion_error_switches_the_servo_off(ready: GcsBench) -> None:
    ready.line("MOV 1 0 2 0")
    ready.wait(1.0)
    before_um = ready.true_position("x")
    ready.controller.motion_error("x", ready.t_ns)
    assert ready.line("SVO?") == "1=0 \n2=1 \n3=1"
    ready.wait(0.01)
    assert ready.ask(b"\x04")[:6] == b"0x0100"
    assert ready.error() == 1024
    assert ready.error() == 0
    ready.wait(0.1)
    assert ready.true_position("x") == pytest.approx(before_um, abs=10.0)
    assert ready.ask(b"\x05") == b"2\n"
    assert "motion error x" in events(ready)
    assert ready.line("FRF? 1") == "1=1"
    assert ready.error_after("MOV 1 1") == 5
    assert ready.error_after("SVO 1 1") == 0
    assert ready.error_after("MOV 1 1") == 0


def test_an_axis_whose_servo_is_off_cannot_fail_to_follow(ready: GcsBench) -> None:
    ready.line("SVO 1 0")
    ready.controller.motion_error("x", ready.t_ns)
    assert ready.error() == 0


def test_a_motion_error_while_referencing_leaves_the_axis_unreferenced() -> None:
    bench = GcsBench()
    bench.line("SVO 1 1")
    bench.line("FRF 1")
    bench.wait(0.5)
    bench.controller.motion_error("x", bench.t_ns)
    assert bench.ask(b"\x07") == READY
    assert bench.line("FRF? 1") == "1=0"


# ---------------------------------------------------------------------- referencing


@pytest.mark.parametrize(("mode", "end_um"), [("FRF", 7500.0), ("FNL", 0.0), ("FPL", 15000.0)])
def test_reference_moves_take_their_time_and_make_positions_true(mode: str, end_um: float) -> None:
    bench = GcsBench()
    bench.line("SVO 1 1")
    assert bench.line("POS? 1") == "1=0.0000000"
    assert bench.error_after(f"{mode} 1") == 0
    needed_s = abs(end_um - 6000.0) / 750.0
    bench.wait(needed_s - 0.1)
    assert bench.ask(b"\x07") == NOT_READY
    assert bench.ask(b"\x05") == b"1\n"
    assert bench.line("FRF? 1") == "1=0"
    assert bench.line("ONT? 1") == "1=0"
    assert float(bench.line("POS? 1").removeprefix("1=")) * 1000 == pytest.approx(end_um - 6000.0, abs=100.0)
    assert bench.error_after("MOV 1 3") == 5
    bench.wait(0.3)
    assert bench.ask(b"\x07") == READY
    assert bench.line("FRF? 1") == "1=1"
    assert bench.line("POS? 1") == bench.line("MOV? 1") == f"1={end_um / 1000:.7f}"
    assert bench.true_position("x") == pytest.approx(end_um, abs=0.01)
    assert events(bench)[-2:] == [f"reference x {mode}", "referenced x"]


@pytest.mark.parametrize("stop", [b"\x18", b"STP\n", b"HLT 1\n", b"SVO 1 0\n"])
def test_a_stop_while_referencing_leaves_the_axis_unreferenced(stop: bytes) -> None:
    bench = GcsBench()
    bench.line("SVO 1 1")
    bench.line("FRF 1")
    bench.wait(1.0)
    bench.put(stop)
    assert bench.error() == (0 if stop.startswith(b"SVO") else 10)
    bench.wait(5.0)
    assert bench.ask(b"\x07") == READY
    assert bench.line("FRF? 1") == "1=0"
    assert bench.true_position("x") == pytest.approx(6750.0, abs=20.0)
    bench.line("SVO 1 1")
    assert bench.error_after("MOV 1 1") == 5


def test_a_new_reference_move_gives_up_the_old_reference(ready: GcsBench) -> None:
    ready.line("MOV 1 3")
    ready.wait(5.0)
    ready.line("FRF 1")
    assert ready.line("FRF? 1 2") == "1=0 \n2=1"
    ready.put(b"\x18")
    assert ready.line("FRF? 1") == "1=0"


@pytest.mark.parametrize("how", ["power_cycle", "RBT"])
def test_a_power_cycle_forgets_everything(ready: GcsBench, how: str) -> None:
    ready.line("SPA 1 0x36 9")
    ready.line("RON 2 0")
    ready.line("MOV 1 3")
    ready.wait(0.5)
    ready.line("FOO")
    if how == "RBT":
        ready.line("RBT")
    else:
        ready.put(b"POS?")
        ready.controller.power_cycle(ready.t_ns)
    ready.wait(1.0)
    assert ready.error() == 0
    assert ready.line("SVO?") == "1=0 \n2=0 \n3=0"
    assert ready.line("FRF?") == "1=0 \n2=0 \n3=0"
    assert ready.line("RON? 2") == "2=1"
    assert ready.line("SPA? 1 0x36") == "1 0x36=3"
    assert ready.line("VEL? 1") == "1=0.7500000"
    assert ready.line("POS? 1 2") == "1=0.0000000 \n2=0.0000000"
    assert ready.true_position("x") == pytest.approx(6840.0, abs=50.0)
    assert events(ready)[-1] == "power cycle"


def test_a_reversed_axis_is_converted_at_the_boundary() -> None:
    bench = GcsBench(direction=-1)
    bench.reference()
    assert bench.line("TMN? 1 3") == "1=-15.0000000 \n3=-180.0000000"
    assert bench.line("TMX? 1") == "1=0.0000000"
    assert bench.line("POS? 1") == "1=-7.5000000"
    assert bench.error_after("MOV 1 0.1") == 7
    assert bench.error_after("MOV 1 -3") == 0
    bench.wait(5.0)
    assert bench.true_position("x") == pytest.approx(3000.0, abs=0.01)
    bench.line("FNL 1")
    bench.wait(30.0)
    assert bench.true_position("x") == pytest.approx(15000.0, abs=0.01)
    assert bench.ask(b"\x04").startswith(b"0x9001")
    assert bench.line("POS? 1") == "1=-15.0000000"
