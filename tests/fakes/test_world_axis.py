"""The emulated axis: its profile keeps its limits, the table follows it, and play shows at reversals."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.fakes.world.axis import Axis, Encoder

LAG_S = 0.004
ROUNDING = 1e-5
"""µm: profiles begin on whole nanoseconds, at up to some thousand µm/s."""


class Order(NamedTuple):
    """A command `after_ms` the one before; `target` None means halt."""

    after_ms: float
    target: float | None
    speed: float
    acceleration: float
    deceleration: float


RATES = st.floats(2_000.0, 20_000.0)
ORDERS = st.lists(
    st.builds(
        Order,
        after_ms=st.floats(0.0, 60.0),
        target=st.sampled_from([None, -100.0, -10.0, 0.0, 10.0, 100.0]) | st.floats(-100.0, 100.0),
        speed=st.floats(200.0, 3000.0),
        acceleration=RATES,
        deceleration=RATES,
    ),
    min_size=1,
    max_size=8,
)


def run(axis: Axis, orders: list[Order]) -> tuple[list[int], int]:
    """Carry out the orders; their times, and when the last profile ends."""
    t_ns, end_ns, times = NS_PER_S, NS_PER_S, []
    for order in orders:
        t_ns += round(order.after_ms * NS_PER_MS)
        times.append(t_ns)
        end_ns = obey(axis, t_ns, order)
        times.append(end_ns)
    return times, end_ns


def obey(axis: Axis, t_ns: int, order: Order) -> int:
    if order.target is None:
        return axis.halt(t_ns, deceleration=order.deceleration)
    return axis.move(
        t_ns,
        order.target,
        speed=order.speed,
        acceleration=order.acceleration,
        deceleration=order.deceleration,
    )


# ---------------------------------------------------------------------- limits of the set-point


@settings(deadline=None, derandomize=True, max_examples=60)
@given(orders=ORDERS, lost_motion=st.sampled_from([0.0, 0.5]))
def test_setpoint_is_continuous_and_keeps_its_limits(orders: list[Order], lost_motion: float) -> None:
    axis = Axis(0.0, lag_s=LAG_S, lost_motion=lost_motion)
    times, end_ns = run(axis, orders)
    fastest = max(order.speed for order in orders)
    hardest = max(max(order.acceleration, order.deceleration) for order in orders)
    grid = {int(t) for t in np.linspace(times[0] - NS_PER_MS, end_ns + NS_PER_MS, 300)}
    grid |= {t + offset for t in times for offset in (-1, 0, 1)}
    states = [(t, *axis.setpoint_at(t)) for t in sorted(grid)]
    for (t0, p0, v0), (t1, p1, v1) in itertools.pairwise(states):
        s = (t1 - t0) / NS_PER_S
        assert abs(v1) <= fastest * (1 + 1e-9)
        assert abs(v1 - v0) <= hardest * (s + 4e-9)
        assert abs(p1 - p0 - 0.5 * (v0 + v1) * s) <= 0.25 * hardest * s * s + ROUNDING


@settings(deadline=None, derandomize=True, max_examples=60)
@given(orders=ORDERS, lost_motion=st.sampled_from([0.0, 0.5]))
def test_the_table_follows_with_a_first_order_lag(orders: list[Order], lost_motion: float) -> None:
    axis = Axis(0.0, lag_s=LAG_S, lost_motion=lost_motion)
    times, end_ns = run(axis, orders)
    for t in np.linspace(times[0], end_ns + 50 * NS_PER_MS, 200).astype(int).tolist():
        behind = axis.setpoint_at(t)[0] - axis.position_at(t)
        assert axis.speed_at(t) * LAG_S == pytest.approx(behind, abs=1e-6)
    for t in times:
        assert axis.position_at(t - 1) == pytest.approx(axis.position_at(t + 1), abs=ROUNDING)


@settings(deadline=None, derandomize=True, max_examples=60)
@given(orders=ORDERS)
def test_a_move_arrives_exactly_and_settles(orders: list[Order]) -> None:
    axis = Axis(0.0, lag_s=LAG_S, lost_motion=0.5)
    run(axis, orders)
    last = axis.profile_end_ns
    end_ns = axis.move(last - 10 * NS_PER_MS, 12.25, speed=800.0, acceleration=9000.0)
    assert axis.setpoint_at(end_ns) == (12.25, 0.0)
    assert axis.moving_at(end_ns - 1)
    assert not axis.moving_at(end_ns)
    assert axis.position_at(axis.settled_by_ns()) == pytest.approx(12.25, abs=0.01)
    assert axis.position_at(end_ns + NS_PER_S) == pytest.approx(12.25, abs=1e-9)


def test_a_long_move_takes_ramps_and_a_cruise() -> None:
    axis = Axis(0.0, lag_s=LAG_S)
    end_ns = axis.move(0, 100.0, speed=1000.0, acceleration=20_000.0, deceleration=50_000.0)
    # v/2a + v/2b of the time is lost against a move at full speed all the way.
    assert end_ns / NS_PER_S == pytest.approx(0.1 + 1000.0 / 40_000.0 + 1000.0 / 100_000.0)
    assert axis.setpoint_at(end_ns // 2)[1] == 1000.0


def test_a_slower_order_on_the_way_brakes_to_the_new_speed() -> None:
    axis = Axis(0.0, lag_s=LAG_S)
    axis.move(0, 100.0, speed=1000.0, acceleration=20_000.0)
    axis.move(60 * NS_PER_MS, 100.0, speed=200.0, acceleration=20_000.0)
    assert axis.setpoint_at(60 * NS_PER_MS)[1] == 1000.0
    assert axis.setpoint_at(100 * NS_PER_MS + 1)[1] == pytest.approx(200.0)


def test_halt_takes_the_braking_distance() -> None:
    axis = Axis(0.0, lag_s=LAG_S)
    axis.move(0, 1000.0, speed=1000.0, acceleration=20_000.0)
    before = axis.setpoint_at(200 * NS_PER_MS)[0]
    end_ns = axis.halt(200 * NS_PER_MS, deceleration=10_000.0)
    assert end_ns == 300 * NS_PER_MS
    assert axis.setpoint_at(end_ns)[0] == pytest.approx(before + 1000.0**2 / 20_000.0)
    assert not axis.moving_at(end_ns)
    assert axis.halt(end_ns + 5, deceleration=1.0) == end_ns + 5


@settings(deadline=None, derandomize=True, max_examples=40)
@given(distance=st.floats(0.01, 500.0), window=st.floats(1e-4, 1.0))
def test_within_from_is_the_last_crossing_of_the_window(distance: float, window: float) -> None:
    axis = Axis(0.0, lag_s=LAG_S)
    end_ns = axis.move(0, distance, speed=1500.0, acceleration=20_000.0)
    since_ns = axis.within_from_ns(window)
    for t in np.linspace(since_ns, since_ns + NS_PER_S, 50).astype(int).tolist():
        assert abs(axis.position_at(t) - distance) <= window
    assert since_ns >= end_ns
    if since_ns > end_ns:
        assert abs(axis.position_at(since_ns - 10) - distance) > window * (1.0 - 1e-5)


# ---------------------------------------------------------------------- lost motion


PLAY = 0.5
RATE = 10_000.0
DEAD_NS = round(math.sqrt(2.0 * PLAY / RATE) * NS_PER_S)


@pytest.fixture
def axis_moved_forward() -> Axis:
    axis = Axis(0.0, lag_s=LAG_S, lost_motion=PLAY)
    axis.move(0, 20.0, speed=500.0, acceleration=RATE)
    return axis


def go(axis: Axis, t_ns: int, target: float) -> int:
    return axis.move(t_ns, target, speed=500.0, acceleration=RATE)


def test_the_first_move_crosses_half_the_play(axis_moved_forward: Axis) -> None:
    half_ns = round(math.sqrt(PLAY / RATE) * NS_PER_S)
    assert axis_moved_forward.setpoint_at(half_ns) == (0.0, 0.0)
    assert axis_moved_forward.setpoint_at(half_ns + 1000)[1] > 0.0


def test_reversal_rests_until_the_play_is_crossed(axis_moved_forward: Axis) -> None:
    t_ns = NS_PER_S
    same_way = go(axis_moved_forward, t_ns, 25.0) - t_ns
    t_ns = 2 * NS_PER_S
    back = go(axis_moved_forward, t_ns, 20.0) - t_ns
    assert back == same_way + DEAD_NS
    assert axis_moved_forward.position_at(t_ns + DEAD_NS) == pytest.approx(25.0, abs=1e-9)
    assert axis_moved_forward.moving_at(t_ns + 1)


def test_a_new_order_in_the_play_does_not_shorten_it(axis_moved_forward: Axis) -> None:
    t_ns = NS_PER_S
    first_end_ns = go(axis_moved_forward, t_ns, 15.0)
    for part in range(1, 4):
        assert go(axis_moved_forward, t_ns + part * DEAD_NS // 8, 15.0) >= first_end_ns
    assert axis_moved_forward.setpoint_at(t_ns + DEAD_NS)[0] == 20.0


def test_halting_in_the_play_and_going_on_forward_does_not_cross_it_twice(axis_moved_forward: Axis) -> None:
    go(axis_moved_forward, NS_PER_S, 15.0)
    axis_moved_forward.halt(NS_PER_S + DEAD_NS // 10, deceleration=RATE)
    end_ns = go(axis_moved_forward, 2 * NS_PER_S, 25.0)
    without_play = go(Axis(20.0, lag_s=LAG_S), 0, 25.0)
    assert without_play < end_ns - 2 * NS_PER_S < without_play + DEAD_NS // 2


def test_changing_ones_mind_while_braking_is_no_reversal(axis_moved_forward: Axis) -> None:
    t_ns = 2 * NS_PER_S
    go(axis_moved_forward, t_ns, 100.0)
    go(axis_moved_forward, t_ns + 90 * NS_PER_MS, 20.0)
    go(axis_moved_forward, t_ns + 100 * NS_PER_MS, 100.0)
    speeds = [axis_moved_forward.setpoint_at(t_ns + ms * NS_PER_MS)[1] for ms in range(60, 150)]
    assert min(speeds) == pytest.approx(400.0, abs=1.0)


def test_repeating_a_target_while_braking_is_no_reversal(axis_moved_forward: Axis) -> None:
    end_ns = go(axis_moved_forward, NS_PER_S, 60.0)
    for ms in range(45, 0, -1):
        assert go(axis_moved_forward, end_ns - ms * NS_PER_MS, 60.0) == pytest.approx(end_ns, abs=2)
    assert go(axis_moved_forward, end_ns + 5, 60.0 + 1e-12) == end_ns + 5


# ---------------------------------------------------------------------- history and encoder


def test_without_lag_the_table_is_where_the_setpoint_is() -> None:
    axis = Axis(0.0, lag_s=0.0)
    end_ns = axis.move(0, 10.0, speed=100.0, acceleration=1000.0)
    for t in (end_ns // 3, end_ns // 2, end_ns + 1):
        assert axis.position_at(t) == axis.setpoint_at(t)[0]
        assert axis.speed_at(t) == axis.setpoint_at(t)[1]


def test_the_distant_past_is_forgotten_without_harm() -> None:
    axis = Axis(0.0, lag_s=LAG_S)
    for number in range(9000):
        axis.move(number * NS_PER_MS, float(number % 7), speed=1000.0, acceleration=1e6)
    assert abs(axis.position_at(0)) < 10.0
    assert abs(axis.speed_at(-NS_PER_S)) < 5000.0


def test_encoder_counts_noise_and_offset() -> None:
    axis = Axis(3.3, lag_s=LAG_S)
    quiet = Encoder(axis, resolution=0.05, noise=0.0, seed=1)
    assert quiet.counts_at(0) == 66
    assert quiet.position_at(0) == pytest.approx(3.3)
    shifted = Encoder(axis, resolution=0.05, noise=0.0, seed=1, offset=-3.3)
    assert shifted.counts_at(0) == 0
    noisy = Encoder(axis, resolution=1e-6, noise=0.02, seed=1)
    readings = np.array([noisy.position_at(0) for _ in range(2000)])
    assert readings.std() == pytest.approx(0.02, rel=0.1)
    assert readings.mean() == pytest.approx(3.3, abs=0.002)
