"""What every zoom motor must do."""

from __future__ import annotations

import math

import pytest

from microdrivers.core.errors import MoveCancelled, OutOfRange
from microdrivers.core.samples import ZoomSample
from tests.conformance.bench import ZoomBench
from tests.conformance.checks import Suite

SUITE = Suite()


@SUITE.check
def reaches_the_zoom_that_is_asked_for(bench: ZoomBench) -> None:
    for zoom in (0.9, 1.2, 4.0, 1.0):
        sample = bench.zoom.move_to(zoom=zoom)
        assert sample.zoom == pytest.approx(zoom, rel=1e-3)
        assert bench.true_steps(bench.clock.now_ns()) == pytest.approx(bench.zoom.curve.steps_at(zoom), abs=2)


@SUITE.check
def reads_where_it_is(bench: ZoomBench) -> None:
    bench.zoom.move_to(zoom=2.0)
    bench.clock.sleep(0.2)
    sample = bench.zoom.read()
    assert sample.position_steps == pytest.approx(bench.true_steps(sample.t_ns), abs=1.5)
    assert sample.zoom == pytest.approx(2.0, rel=1e-3)


@SUITE.check
def never_says_that_it_rests_while_it_moves(bench: ZoomBench) -> None:
    """The estimator's forgetting depends on it."""
    bench.zoom.move_to(zoom=0.9)
    samples: list[ZoomSample] = []
    bench.zoom.topic.subscribe(samples.append)
    with bench.zoom.stream(70.0):
        bench.clock.sleep(0.1)
        bench.zoom.start_move_to(zoom=1.2)
        bench.clock.sleep(0.4)
    assert any(sample.moving for sample in samples)
    for sample in samples:
        around = [bench.true_steps(sample.t_ns + shift_ns) for shift_ns in (-sample.dt_ns, sample.dt_ns)]
        if not sample.moving:
            assert abs(around[1] - around[0]) <= 2.0


@SUITE.check
def stamps_the_instant_of_the_position(bench: ZoomBench) -> None:
    bench.zoom.move_to(zoom=0.9)
    samples: list[ZoomSample] = []
    bench.zoom.topic.subscribe(samples.append)
    with bench.zoom.stream(70.0):
        bench.zoom.start_move_to(zoom=1.6)
        bench.clock.sleep(0.3)
    for sample in samples:
        early, late = bench.true_steps(sample.t_ns - sample.dt_ns), bench.true_steps(sample.t_ns + sample.dt_ns)
        assert min(early, late) - 2.0 <= sample.position_steps <= max(early, late) + 2.0


@SUITE.check
def is_on_target_only_when_it_is_there(bench: ZoomBench) -> None:
    bench.zoom.move_to(zoom=0.9)
    samples: list[ZoomSample] = []
    bench.zoom.topic.subscribe(samples.append)
    target_steps = bench.zoom.curve.steps_at(1.2)
    with bench.zoom.stream(70.0):
        bench.zoom.start_move_to(zoom=1.2)
        bench.clock.sleep(0.3)
    moved = [sample for sample in samples if sample.target_zoom == pytest.approx(1.2, rel=1e-3)]
    assert any(sample.on_target for sample in moved)
    for sample in moved:
        if sample.on_target:
            assert bench.true_steps(sample.t_ns) == pytest.approx(target_steps, abs=2.5)


@SUITE.check
def refuses_what_is_out_of_range_or_not_finite_and_moves_nothing(bench: ZoomBench) -> None:
    start = bench.true_steps(bench.clock.now_ns())
    for bad in (0.5, 12.0, math.nan, math.inf):
        with pytest.raises(OutOfRange):
            bench.zoom.start_move_to(zoom=bad)
        with pytest.raises(OutOfRange):
            bench.zoom.move_to(zoom=bad)
    bench.clock.sleep(0.2)
    assert bench.true_steps(bench.clock.now_ns()) == start


@SUITE.check
def a_stop_ends_the_motion_and_the_move(bench: ZoomBench) -> None:
    bench.zoom.move_to(zoom=0.9)
    move = bench.zoom.start_move_to(zoom=11.0)
    bench.clock.sleep(0.05)
    bench.zoom.stop()
    bench.clock.sleep(0.3)
    at_rest = bench.true_steps(bench.clock.now_ns())
    assert at_rest < bench.zoom.curve.steps_at(9.0)
    bench.clock.sleep(0.2)
    assert bench.true_steps(bench.clock.now_ns()) == pytest.approx(at_rest, abs=0.5)
    with pytest.raises(MoveCancelled):
        move.wait()
    bench.zoom.move_to(zoom=1.0)


@SUITE.check
def approaches_from_below(bench: ZoomBench) -> None:
    """Coming down, the motor first goes below its target, so that the gear's play always lies on one side."""
    bench.zoom.move_to(zoom=2.0)
    target = bench.zoom.curve.steps_at(1.0)
    lowest = [math.inf]
    timer = bench.clock.every(0.001, lambda: lowest.append(bench.true_steps(bench.clock.now_ns())))
    bench.zoom.move_to(zoom=1.0)
    timer.cancel()
    assert min(lowest) < target - 10
