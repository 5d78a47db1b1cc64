"""A drive that is switched off and on in the middle of a move: who notices when, and what is refused from then on."""

import pytest

from microdrivers.core.errors import LinkError, LinkLost, MicrodriversError, NotReferenced, ReferenceLost
from microdrivers.core.units import NS_PER_S, seconds_to_ns
from microdrivers.fakes.can import medium_named
from tests.conformance.tool_bench import fine_stage_bench, served_fine_stage_bench

X_NODE, Y_NODE = 11, 12
QUICK_STOP = b"\x02\x00"


def passed(since_ns, who, cob_id):
    """Frames of the emulated bus, with its own times."""
    log = list(medium_named("socketcan:can0").log)
    return [(t_ns, frame) for t_ns, sender, frame in log if sender == who and frame.id == cob_id and t_ns > since_ns]


def wait_for(clock, condition, *, longest_s):
    end_ns = clock.now_ns() + seconds_to_ns(longest_s)
    while not condition():
        assert clock.now_ns() < end_ns
        clock.sleep(0.02)


def check_power_cycle_in_a_move(bench, *, phase):
    """Switch the drive of axis y off so many heartbeat intervals after its heartbeat; it comes back by itself."""
    stage, clock = bench.stage, bench.clock
    events = []
    stage.events.subscribe(events.append)
    move = stage.start_move_to(x_um=450.0, y_um=450.0, speed_um_s=100.0)
    clock.sleep(0.3)
    begin_ns = clock.now_ns()
    wait_for(clock, lambda: passed(begin_ns, "node", 0x700 + Y_NODE), longest_s=3 * bench.heartbeat_s)
    last_beat_ns = passed(begin_ns, "node", 0x700 + Y_NODE)[0][0]
    clock.sleep_until(last_beat_ns + round(phase * bench.heartbeat_s * NS_PER_S))
    off_ns = clock.now_ns()
    bench.power_cycle()
    with pytest.raises((ReferenceLost, LinkError)) as caught:
        move.wait()
    assert caught.value.device == "probe_stage"
    assert caught.value.remedy
    wait_for(clock, lambda: "reference_lost" in [event.kind for event in events], longest_s=4 * bench.heartbeat_s)
    clock.sleep(0.2)

    limit_ns = seconds_to_ns(2 * bench.heartbeat_s)
    noticed = next(event for event in events if event.kind == "reference_lost")
    assert noticed.t_ns - off_ns <= limit_ns
    assert f"axis y (node {Y_NODE})" in noticed.reason
    stops_ns = [t_ns for t_ns, frame in passed(off_ns, "host", 0x200 + X_NODE) if frame.data[:2] == QUICK_STOP]
    assert stops_ns[0] - off_ns <= limit_ns  # as the emulated bus saw it
    rest_um = bench.truth("x", clock.now_ns())
    assert rest_um < 400.0
    assert not stage.referenced["y"]
    with pytest.raises((LinkLost, NotReferenced)) as refused:
        stage.start_move_to(x_um=0.0, y_um=0.0)
    assert refused.value.moved == "no"

    wait_for(clock, lambda: reads(stage), longest_s=5.0)  # it is set up again by itself
    with pytest.raises(NotReferenced, match="axis y") as refused:
        stage.start_move_to(y_um=0.0)
    assert "reference(['y'])" in refused.value.remedy
    assert not stage.read().referenced
    clock.sleep(0.2)
    assert bench.truth("x", clock.now_ns()) == pytest.approx(rest_um, abs=0.3)
    assert stage.move_to(x_um=rest_um - 20.0).position["x"] == pytest.approx(rest_um - 20.0, abs=0.3)


def reads(stage):
    try:
        stage.read()
    except MicrodriversError:
        return False
    return True


@pytest.mark.parametrize("phase", [0.01, 0.2, 0.4, 0.99])
def test_it_is_noticed_within_two_heartbeats_in_process(phase):
    with fine_stage_bench(seed=3 + round(10 * phase)) as bench:
        check_power_cycle_in_a_move(bench, phase=phase)


@pytest.mark.ports  # with the machine to itself: in real time, drives and host watching each other
def test_it_is_noticed_within_two_heartbeats_behind_a_serial_adapter():
    with served_fine_stage_bench("pty") as bench:
        check_power_cycle_in_a_move(bench, phase=0.5)
