"""A newer move that has fewer axes than the one it replaces ends when the device is at rest, and not before."""

import msgspec
import pytest

from microdrivers.core.errors import MoveSuperseded, NotReached
from tests.conformance.bench import stage_bench
from tests.conformance.tool_bench import fine_stage_bench

SLOW_UM_S = 50.0
BENCHES = {"XYθ stage": stage_bench, "fine stage": fine_stage_bench}


@pytest.fixture(params=BENCHES)
def bench(request):
    with BENCHES[request.param]() as bench:
        yield bench


def near(bench, **shifts):
    return {f"{axis}_um": bench.home[axis] + shift for axis, shift in shifts.items()}


def assert_at(bench, **shifts):
    for axis, shift in shifts.items():
        assert bench.truth(axis, bench.clock.now_ns()) == pytest.approx(bench.home[axis] + shift, abs=0.3)


def test_axes_that_it_does_not_name_have_their_own_time(bench):
    older = bench.stage.start_move_to(**near(bench, x=200.0, y=200.0), speed_um_s=SLOW_UM_S)
    bench.clock.sleep(0.3)
    newer = bench.stage.start_move_to(**near(bench, x=20.0), speed_um_s=1000.0)
    pose = newer.wait()
    assert pose.on_target
    assert not pose.moving
    assert_at(bench, x=20.0, y=200.0)
    assert newer.deadline_t_ns == older.deadline_t_ns
    with pytest.raises(MoveSuperseded):
        older.wait()


def test_time_is_handed_on_from_move_to_move(bench):
    bench.stage.start_move_to(**near(bench, x=20.0, y=200.0), speed_um_s=SLOW_UM_S)
    for shift in (10.0, 15.0):
        bench.clock.sleep(0.2)
        last = bench.stage.start_move_to(**near(bench, x=shift), speed_um_s=1000.0)
    assert last.wait().on_target
    assert_at(bench, x=15.0, y=200.0)


def test_time_ends_with_the_axis_a_stop_and_the_move(bench):
    """What was replaced as a whole, was stopped, or has arrived is not waited for."""
    slow = bench.stage.start_move_to(**near(bench, x=200.0, y=200.0), speed_um_s=SLOW_UM_S)
    both = bench.stage.start_move_to(**near(bench, x=20.0, y=20.0), speed_um_s=1000.0)
    assert both.deadline_t_ns < slow.deadline_t_ns
    bench.stage.stop()
    bench.clock.sleep(0.3)
    slow = bench.stage.start_move_to(**near(bench, y=120.0), speed_um_s=SLOW_UM_S)
    bench.stage.stop()
    bench.clock.sleep(0.3)
    after_stop = bench.stage.start_move_to(**near(bench, x=40.0), speed_um_s=1000.0)
    assert after_stop.deadline_t_ns < slow.deadline_t_ns
    after_stop.wait()
    slow = bench.stage.start_move_to(**near(bench, y=220.0), speed_um_s=SLOW_UM_S)
    slow.wait()
    after_arrival = bench.stage.start_move_to(**near(bench, x=45.0), speed_um_s=1000.0)
    assert after_arrival.due_ns.keys() == {"x"}
    after_arrival.wait()


def test_an_axis_that_never_arrives_is_late_all_the_same(bench):
    older = bench.stage.start_move_to(**near(bench, x=200.0, y=200.0), speed_um_s=SLOW_UM_S)
    read = bench.stage._read

    def read_without_rest():
        return msgspec.structs.replace(read(), moving=True, on_target=False)

    bench.stage._read = read_without_rest
    newer = bench.stage.start_move_to(**near(bench, x=20.0), speed_um_s=1000.0)
    with pytest.raises(NotReached, match="never reported on target"):
        newer.wait()
    assert bench.clock.now_ns() >= older.deadline_t_ns
