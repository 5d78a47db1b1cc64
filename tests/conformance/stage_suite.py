"""What every XYθ stage must do.

The bench has put the stage at `home`, referenced, with free travel of −400 … +4500 µm in x, −400 … +200 µm in y and
±0.5° around it.
"""

from __future__ import annotations

import math

import pytest

from microdrivers.core.errors import MoveCancelled, MoveSuperseded, NotReferenced, OutOfRange
from microdrivers.core.samples import XYThetaSample
from microdrivers.core.units import NS_PER_S
from tests.conformance.bench import StageBench
from tests.conformance.checks import Suite

SUITE = Suite()


def _near(bench: StageBench, **shifts: float) -> dict[str, float]:
    """Targets that lie so far from home."""
    axes = {"x_um": "x", "y_um": "y", "theta_deg": "theta"}
    return {name: bench.home[axes[name]] + shift for name, shift in shifts.items()}


def _truth(bench: StageBench) -> dict[str, float]:
    return _when_and_where(bench)[1]


def _when_and_where(bench: StageBench) -> tuple[int, dict[str, float]]:
    now_ns = bench.clock.now_ns()
    return now_ns, {axis: bench.truth(axis, now_ns) for axis in ("x", "y", "theta")}


@SUITE.check
def moves_each_axis_its_own_way(bench: StageBench) -> None:
    """Sign, axis and unit: +150 µm on x is +150 µm on x and nothing on y."""
    start = _truth(bench)
    bench.stage.move_to(**_near(bench, x_um=150.0))
    assert _truth(bench)["x"] - start["x"] == pytest.approx(150.0, abs=0.5)
    assert _truth(bench)["y"] - start["y"] == pytest.approx(0.0, abs=0.5)
    bench.stage.move_to(**_near(bench, y_um=-90.0))
    assert _truth(bench)["y"] - start["y"] == pytest.approx(-90.0, abs=0.5)
    bench.stage.move_to(**_near(bench, theta_deg=0.25))
    assert _truth(bench)["theta"] - start["theta"] == pytest.approx(0.25, abs=0.001)


@SUITE.check
def reads_where_it_is(bench: StageBench) -> None:
    """A reading at rest agrees with the truth on all axes, sign and unit included."""
    bench.stage.move_to(**_near(bench, x_um=112.3, y_um=-66.9, theta_deg=-0.5))
    bench.clock.sleep(0.2)
    pose = bench.stage.read()
    assert pose.x_um == pytest.approx(bench.truth("x", pose.t_ns), abs=bench.noise_um)
    assert pose.y_um == pytest.approx(bench.truth("y", pose.t_ns), abs=bench.noise_um)
    assert pose.theta_deg == pytest.approx(bench.truth("theta", pose.t_ns), abs=3e-4)


@SUITE.check
def stamps_the_instant_of_the_pose(bench: StageBench) -> None:
    """In motion at 1 mm/s, the pose is that of its stamp within noise and the stated (95 %) uncertainty of time."""
    samples: list[XYThetaSample] = []
    bench.stage.topic.subscribe(samples.append)
    move = bench.stage.start_move_to(**_near(bench, x_um=4000.0), speed_um_s=1000.0)
    wanted, before_ns = 0.3 * bench.pose_rate_hz, bench.clock.now_ns() + round(3.5 * NS_PER_S)
    with bench.stage.stream(bench.pose_rate_hz):
        while sum(sample.moving for sample in samples) <= wanted and bench.clock.now_ns() < before_ns:
            bench.clock.sleep(0.1)
    bench.stage.stop()
    with pytest.raises(MoveCancelled):
        move.wait()
    moving = [sample for sample in samples if sample.moving]
    assert len(moving) > wanted
    within = [
        abs(sample.x_um - bench.truth("x", sample.t_ns)) <= bench.noise_um + 1000.0 * 1.5e-9 * sample.dt_ns
        for sample in moving
    ]
    assert sum(within) >= 0.9 * len(within)
    assert [sample.seq for sample in samples] == list(range(samples[0].seq, samples[0].seq + len(samples)))
    assert max(sample.dt_ns for sample in moving) <= 1_000_000


@SUITE.check
def refuses_what_is_out_of_range_and_moves_nothing(bench: StageBench) -> None:
    start = _truth(bench)
    limits = bench.stage.limits
    for target in (
        {"x_um": limits["x"].max + 0.1},
        {"y_um": limits["y"].min - 0.1},
        {"theta_deg": limits["theta"].max + 0.01},
        {**_near(bench, x_um=100.0), "y_um": 1e6},
    ):
        with pytest.raises(OutOfRange):
            bench.stage.start_move_to(**target)
    bench.clock.sleep(0.3)
    assert _truth(bench) == pytest.approx(start, abs=1e-6)


@SUITE.check
def refuses_what_is_not_finite(bench: StageBench) -> None:
    start = _truth(bench)
    for bad in (math.nan, math.inf, -math.inf):
        with pytest.raises(OutOfRange):
            bench.stage.start_move_to(x_um=bad)
        with pytest.raises(OutOfRange):
            bench.stage.start_move_to(**_near(bench, x_um=100.0), speed_um_s=bad)
    bench.clock.sleep(0.3)
    assert _truth(bench) == pytest.approx(start, abs=1e-6)


@SUITE.check
def refuses_too_high_a_speed(bench: StageBench) -> None:
    with pytest.raises(OutOfRange):
        bench.stage.start_move_to(**_near(bench, x_um=100.0), speed_um_s=1e5)


@SUITE.check
def is_on_target_only_when_it_is_there(bench: StageBench) -> None:
    """No sample says "on target" before the table is within tolerance, and a finished move is at its target."""
    tolerance_um = bench.stage.axes["x"].tolerance + bench.noise_um
    samples: list[XYThetaSample] = []
    bench.stage.topic.subscribe(samples.append)
    for target in (bench.home["x"] + shift for shift in (600.0, 600.6, 400.0)):
        bench.stage.move_to(x_um=target)
        assert bench.truth("x", bench.clock.now_ns()) == pytest.approx(target, abs=tolerance_um)
        for sample in samples:
            if sample.on_target and sample.target_x_um == target:
                assert bench.truth("x", sample.t_ns) == pytest.approx(target, abs=tolerance_um)


@SUITE.check
def a_stop_ends_the_motion_and_the_move(bench: StageBench) -> None:
    """All axes stop, each from a motion of its own."""
    bench.stage.move_to(**_near(bench, y_um=-400.0, theta_deg=-0.5))
    move = bench.stage.start_move_to(
        **_near(bench, x_um=4500.0, y_um=200.0, theta_deg=0.5), speed_um_s=1400.0, theta_speed_deg_s=0.5
    )
    bench.clock.sleep(0.3)
    before = _truth(bench)
    bench.stage.stop()
    bench.clock.sleep(0.3)
    at_rest = _truth(bench)
    bench.clock.sleep(0.3)
    assert _truth(bench) == pytest.approx(at_rest, abs=0.01)
    assert at_rest["x"] < bench.home["x"] + 4000.0
    assert at_rest["y"] < bench.home["y"] + 100.0
    assert at_rest["theta"] < bench.home["theta"] + 0.4
    assert all(at_rest[axis] >= before[axis] - 0.01 for axis in at_rest)
    with pytest.raises(MoveCancelled):
        move.wait()
    bench.stage.move_to(**_near(bench, x_um=100.0))
    assert _truth(bench)["x"] == pytest.approx(bench.home["x"] + 100.0, abs=0.5)


@SUITE.check
def a_newer_move_supersedes_the_older(bench: StageBench) -> None:
    older = bench.stage.start_move_to(**_near(bench, x_um=1500.0))
    bench.clock.sleep(0.1)
    bench.stage.move_to(**_near(bench, x_um=-100.0))
    with pytest.raises(MoveSuperseded):
        older.wait()
    assert _truth(bench)["x"] == pytest.approx(bench.home["x"] - 100.0, abs=0.5)


@SUITE.check
def a_relative_move_counts_from_the_last_target(bench: StageBench) -> None:
    bench.stage.move_to(**_near(bench, x_um=100.0))
    for _ in range(5):
        bench.stage.move_by(dx_um=10.0)
    assert _truth(bench)["x"] == pytest.approx(bench.home["x"] + 150.0, abs=0.3)


@SUITE.check
def x_and_y_arrive_together_at_the_path_speed(bench: StageBench) -> None:
    bench.stage.start_move_to(**_near(bench, x_um=300.0, y_um=-400.0), speed_um_s=500.0)
    bench.clock.sleep(0.3)
    earlier_ns, earlier = _when_and_where(bench)
    bench.clock.sleep(0.3)
    later_ns, later = _when_and_where(bench)
    dx_um, dy_um = later["x"] - earlier["x"], later["y"] - earlier["y"]
    assert math.hypot(dx_um, dy_um) / (later_ns - earlier_ns) * NS_PER_S == pytest.approx(500.0, rel=0.1)
    assert dx_um / 300.0 == pytest.approx(-dy_um / 400.0, rel=0.05)


@SUITE.check
def an_unreferenced_axis_refuses_absolute_moves(bench: StageBench) -> None:
    assert all(bench.stage.referenced.values())
    bench.need(bench.power_cycle)()
    bench.stage.read()
    assert not any(bench.stage.referenced.values())
    start = _truth(bench)
    with pytest.raises(NotReferenced):
        bench.stage.start_move_to(**_near(bench, x_um=100.0))
    bench.clock.sleep(0.2)
    assert _truth(bench) == pytest.approx(start, abs=1e-6)
