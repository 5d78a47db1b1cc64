"""What every fine stage must do.

The bench has put the stage at `home`, referenced, with free travel of ±500 µm in x, y and z around it.
"""

from __future__ import annotations

import math

import pytest

from microdrivers.core.errors import LinkLost, MoveCancelled, MoveSuperseded, NotReferenced, OutOfRange
from microdrivers.core.samples import FineStageSample
from tests.conformance.checks import Suite
from tests.conformance.tool_bench import FineStageBench

SUITE = Suite()
AXES = ("x", "y", "z")
COUNT_UM = 0.05


def _near(bench: FineStageBench, **shifts: float) -> dict[str, float]:
    """Targets that lie so far from home."""
    return {f"{axis}_um": bench.home[axis] + shift for axis, shift in shifts.items()}


def _truth(bench: FineStageBench, t_ns: int | None = None) -> dict[str, float]:
    at_ns = bench.clock.now_ns() if t_ns is None else t_ns
    return {axis: bench.truth(axis, at_ns) for axis in AXES}


@SUITE.check
def moves_each_axis_its_own_way(bench: FineStageBench) -> None:
    """Sign, axis and unit: +150 µm on one axis is +150 µm on it and nothing on the others."""
    for axis in AXES:
        start = _truth(bench)
        bench.stage.move_to(**_near(bench, **{axis: 150.0}))
        for other in AXES:
            moved = _truth(bench)[other] - start[other]
            assert moved == pytest.approx(150.0 if other == axis else 0.0, abs=0.5)


@SUITE.check
def reads_where_it_is(bench: FineStageBench) -> None:
    bench.stage.move_to(**_near(bench, x=112.3, y=-66.9, z=41.05))
    bench.clock.sleep(0.2)
    pose = bench.stage.read()
    for axis, position in pose.position.items():
        assert position == pytest.approx(bench.truth(axis, pose.t_ns), abs=bench.noise_um)


@SUITE.check
def ends_within_one_count_of_its_target(bench: FineStageBench) -> None:
    for shift in (1000.0 / math.sqrt(3) - 300.0, -0.05, 333.333):
        pose = bench.stage.move_to(**_near(bench, x=shift, y=-shift, z=0.5 * shift))
        for axis, goal in pose.target.items():
            assert pose.position[axis] == pytest.approx(goal, abs=COUNT_UM + 1e-6)
            assert bench.truth(axis, bench.clock.now_ns()) == pytest.approx(goal, abs=2 * COUNT_UM)


@SUITE.check
def keeps_to_the_straight_line_between_start_and_target(bench: FineStageBench) -> None:
    """A coordinated move of 1 mm in space: all axes start and arrive together, at the path speed."""
    bench.stage.move_to(**_near(bench, x=-400.0, y=-300.0, z=-200.0))
    start = _truth(bench)
    way = {"x": 800.0, "y": 500.0, "z": 330.0}
    length_um = math.hypot(*way.values())
    assert length_um == pytest.approx(1000.0, abs=1.0)
    places: list[dict[str, float]] = []
    began_ns = bench.clock.now_ns()
    bench.stage.move_to(**_near(bench, x=400.0, y=200.0, z=130.0), speed_um_s=500.0)
    ended_ns = bench.clock.now_ns()
    places = [_truth(bench, began_ns + (ended_ns - began_ns) * k // 400) for k in range(401)]
    assert 2.0 <= (ended_ns - began_ns) / 1e9 <= 3.5
    for place in places:
        along = sum((place[axis] - start[axis]) * way[axis] for axis in AXES) / length_um
        aside = [place[axis] - start[axis] - along * way[axis] / length_um for axis in AXES]
        assert math.hypot(*aside) <= 2.0


@SUITE.check
def stamps_the_instant_of_the_pose(bench: FineStageBench) -> None:
    """In motion at 0.8 mm/s, the pose of all axes is that of its stamp within noise and stated (95 %) uncertainty."""
    bench.stage.move_to(**_near(bench, x=-450.0, y=-450.0))
    samples: list[FineStageSample] = []
    bench.stage.topic.subscribe(samples.append)
    with bench.stage.stream(bench.pose_rate_hz):
        move = bench.stage.start_move_to(**_near(bench, x=100.0, y=100.0), speed_um_s=800.0)
        bench.clock.sleep(0.6)
    move.wait()
    moving = [sample for sample in samples if sample.moving]
    assert len(moving) >= 0.6 * 0.6 * bench.pose_rate_hz
    slack_um = bench.noise_um + 800.0 * 1.5e-9 * max(sample.dt_ns for sample in moving)
    within = [
        all(abs(sample.position[axis] - bench.truth(axis, sample.t_ns)) <= slack_um for axis in AXES)
        for sample in moving
    ]
    assert sum(within) >= 0.9 * len(within)
    assert max(sample.dt_ns for sample in moving) <= 2_000_000


@SUITE.check
def refuses_what_is_out_of_range_or_not_finite_and_moves_nothing(bench: FineStageBench) -> None:
    start = _truth(bench)
    limits = bench.stage.limits
    for target in (
        {"x_um": limits["x"].max + 0.1},
        {"z_um": limits["z"].min - 0.1},
        {**_near(bench, x=100.0), "y_um": 1e6},
        {"x_um": math.nan},
        {"z_um": math.inf},
    ):
        with pytest.raises(OutOfRange):
            bench.stage.start_move_to(**target)
    for speed in (1e5, math.nan, 0.0, -1.0):
        with pytest.raises(OutOfRange):
            bench.stage.start_move_to(**_near(bench, x=10.0), speed_um_s=speed)
    bench.clock.sleep(0.3)
    assert _truth(bench) == pytest.approx(start, abs=1e-6)


@SUITE.check
def is_on_target_only_when_it_is_there(bench: FineStageBench) -> None:
    tolerance_um = bench.stage.axes["x"].tolerance + bench.noise_um
    samples: list[FineStageSample] = []
    bench.stage.topic.subscribe(samples.append)
    with bench.stage.stream(bench.pose_rate_hz):
        for target in (bench.home["x"] + shift for shift in (300.0, 300.5, 100.0)):
            bench.stage.move_to(x_um=target)
            assert bench.truth("x", bench.clock.now_ns()) == pytest.approx(target, abs=tolerance_um)
    assert any(sample.on_target for sample in samples)
    for sample in samples:
        if sample.on_target:
            assert bench.truth("x", sample.t_ns) == pytest.approx(sample.target_x_um, abs=tolerance_um)


@SUITE.check
def a_stop_ends_the_motion_and_the_move(bench: FineStageBench) -> None:
    bench.stage.move_to(**_near(bench, x=-450.0))
    move = bench.stage.start_move_to(**_near(bench, x=450.0, y=200.0), speed_um_s=400.0)
    bench.clock.sleep(0.3)
    bench.stage.stop()
    bench.clock.sleep(0.4)
    at_rest = _truth(bench)
    bench.clock.sleep(0.3)
    assert _truth(bench) == pytest.approx(at_rest, abs=0.01)
    assert at_rest["x"] < bench.home["x"] + 400.0
    with pytest.raises(MoveCancelled):
        move.wait()
    bench.stage.move_to(**_near(bench, x=100.0))
    assert _truth(bench)["x"] == pytest.approx(bench.home["x"] + 100.0, abs=0.5)


@SUITE.check
def a_newer_move_supersedes_the_older(bench: FineStageBench) -> None:
    older = bench.stage.start_move_to(**_near(bench, x=400.0))
    bench.clock.sleep(0.1)
    bench.stage.move_to(**_near(bench, x=-100.0))
    with pytest.raises(MoveSuperseded):
        older.wait()
    assert _truth(bench)["x"] == pytest.approx(bench.home["x"] - 100.0, abs=0.5)


@SUITE.check
def a_relative_move_counts_from_the_last_target(bench: FineStageBench) -> None:
    bench.stage.move_to(**_near(bench, z=50.0))
    for _ in range(5):
        bench.stage.move_by(dz_um=10.0)
    assert _truth(bench)["z"] == pytest.approx(bench.home["z"] + 100.0, abs=0.3)


@SUITE.check
def retracts_along_the_way_that_the_rig_file_states(bench: FineStageBench) -> None:
    way = bench.need(bench.stage.retract_um)
    bench.stage.move_to(**_near(bench, x=0.0, y=0.0, z=-100.0))
    start = _truth(bench)
    bench.stage.retract().wait()
    for axis, length in zip(AXES, way, strict=True):
        assert _truth(bench)[axis] - start[axis] == pytest.approx(length, abs=0.5)


@SUITE.check
def an_unreferenced_axis_refuses_absolute_moves(bench: FineStageBench) -> None:
    """One drive is switched off and on: within two heartbeats its axis counts as not referenced."""
    assert all(bench.stage.referenced.values())
    bench.need(bench.power_cycle)()
    bench.clock.sleep(2.5 * bench.heartbeat_s)
    assert not all(bench.stage.referenced.values())
    start = _truth(bench)
    with pytest.raises((NotReferenced, LinkLost)):
        bench.stage.start_move_to(**_near(bench, x=10.0, y=10.0, z=10.0))
    bench.clock.sleep(0.2)
    assert _truth(bench) == pytest.approx(start, abs=1e-6)
