"""The pose of a daisy chain: three readings of different instants, one time."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.backends.pi_gcs.chain_pose import LONGEST_INTERVAL_ROUNDS, PoseReader
from microdrivers.backends.pi_gcs.controller import Reading
from microdrivers.backends.pi_gcs.replies import AxisStatus
from microdrivers.core.errors import LinkTimeout, ProtocolError
from microdrivers.core.samples import XYThetaSample
from tests.backends.scripted_gcs_chain import ChainRig

ROUND = [b"1 POS?\n1 \x04\n", b"2 POS?\n2 \x04\n", b"3 POS?\n3 \x04\n"]

ACCELERATION = 20.0  # mm/s² and, for theta, deg/s²
RESOLUTION_UM = 1e-4  # POS? gives seven decimals of a millimetre


def moving(rig: ChainRig, trajectory: Callable[[float], float]) -> Callable[[int], float]:
    """Let all axes follow trajectories (mm or deg against seconds from now); returns that of a time in ns."""
    start_ns = rig.bench.clock.now_ns()

    def at(t_ns: int) -> float:
        return trajectory((t_ns - start_ns) / 1e9)

    for box in rig.chain.boxes.values():
        box.trajectory, box.moving, box.servo["1"] = at, True, True
    return at


def off_um(rig: ChainRig, pose: XYThetaSample, truth: Callable[[int], float]) -> float:
    """How far the pose is from where the axes were at its time, µm (a thousandth of a degree for theta)."""
    true_mm = truth(pose.t_ns)
    found_mm = pose.x_um / 1000, pose.y_um / 1000, pose.theta_deg
    return max(abs(position - true_mm) for position in found_mm) * 1000


# ---------------------------------------------------------------------- on the wire


def test_at_rest_a_pose_is_one_round_stamped_where_the_first_controller_latches() -> None:
    rig = ChainRig(latch={"delay_ms": 0.2, "uncertainty_ms": 0.03})
    rig.x.position["1"], rig.y.position["1"], rig.theta.position["1"] = 1.0, 2.0, 3.0
    start_ns = rig.bench.clock.now_ns()
    pose = rig.stage.read()
    assert rig.sent() == ROUND
    assert (pose.x_um, pose.y_um, pose.theta_deg) == (1000.0, 2000.0, 3.0)
    assert pose.t_ns == pytest.approx(start_ns + 7 * rig.bench.wire.byte_ns + 200_000, abs=5)
    assert (pose.dt_ns, pose.t_source, pose.moving) == (30_000, "request", False)


@pytest.mark.parametrize("speed", [1.5, -0.01])
def test_in_motion_all_axes_are_given_for_one_time(speed: float) -> None:
    rig = ChainRig()
    truth = moving(rig, lambda t_s: 5.0 + speed * t_s)
    first = rig.stage.read()
    assert rig.sent() == 2 * ROUND  # nothing is known from before
    second = rig.stage.read()
    assert rig.sent() == ROUND
    for pose in (first, second):
        assert off_um(rig, pose, truth) < abs(speed) * 1000 * 60e-6 + RESOLUTION_UM  # the latch is 50 µs off
        assert (pose.dt_ns, pose.t_source, pose.moving) == (50_000, "request", True)


@settings(deadline=None, derandomize=True, max_examples=40)
@given(st.floats(-1.0, 1.0), st.floats(0.0, 0.03), st.lists(st.floats(0.0, 0.05), min_size=2, max_size=6))
def test_acceleration_spoils_a_pose_no_more_than_stated(share: float, turn_s: float, pauses_s: list[float]) -> None:
    """Velocity changes with the full acceleration, which itself changes sign at a time."""
    rig = ChainRig(latch={"delay_ms": 0.0, "uncertainty_ms": 0.001})
    a = share * ACCELERATION

    def trajectory(t_s: float) -> float:
        late_s = max(0.0, t_s - turn_s)
        return 5.0 + a * t_s**2 / 2 - a * late_s**2

    truth = moving(rig, trajectory)
    for pause_s in pauses_s:
        rig.bench.clock.sleep(pause_s)
        rig.forget()
        start_ns = rig.bench.clock.now_ns()
        pose = rig.stage.read()
        rounds = len(rig.sent()) / 3
        round_s = (rig.bench.clock.now_ns() - start_ns) / 1e9 / rounds
        bound_mm = abs(a) * (LONGEST_INTERVAL_ROUNDS * round_s) ** 2 / 8
        assert off_um(rig, pose, truth) <= 1000 * bound_mm * 1.05 + 2 * RESOLUTION_UM


def test_an_old_reading_is_not_interpolated_from() -> None:
    rig = ChainRig()
    rig.stage.read()
    rig.bench.clock.sleep(0.1)
    truth = moving(rig, lambda t_s: 5.0 + 1.5 * t_s)
    rig.forget()
    assert off_um(rig, rig.stage.read(), truth) < 0.1
    assert rig.sent() == 2 * ROUND


def test_axes_that_have_just_stopped_are_asked_again() -> None:
    """Not moving, not yet on target: they may have moved when the first one was asked."""
    rig = ChainRig()
    rig.y.servo["1"], rig.y.on_target = True, False
    rig.stage.read()
    assert rig.sent() == 2 * ROUND


def test_a_stop_between_two_readings_is_not_interpolated_over() -> None:
    rig = ChainRig()
    truth = moving(rig, lambda t_s: 5.0 + 1.5 * t_s)
    rig.stage.read()
    rig.stage.stop()
    truth = moving(rig, lambda t_s: 8.0 - 0.5 * t_s)  # whatever they do now: it has no connection with before
    rig.forget()
    assert off_um(rig, rig.stage.read(), truth) < 0.1
    assert rig.sent() == 2 * ROUND


def test_a_position_that_jumps_with_the_servo_is_not_interpolated_over() -> None:
    rig = ChainRig()
    moving(rig, lambda t_s: 5.0)
    rig.stage.read()
    for box in rig.chain.boxes.values():
        box.trajectory, box.moving = None, False
    rig.theta.power_cycle()
    pose = rig.stage.read()
    assert pose.theta_deg == 0.0


def test_a_reference_move_gives_a_time_that_reaches_over_the_round() -> None:
    rig = ChainRig(latch={"delay_ms": 0.05, "uncertainty_ms": 0.05})
    rig.stage.read()
    rig.theta.script[b"\x04"] = b"0x7000\n"
    rig.theta.trajectory = lambda t_ns: t_ns * 1e-9
    rig.forget()
    pose = rig.stage.read()
    assert rig.sent() == ROUND  # a second one would not help
    latched_ns = rig.theta.trajectory and pose.theta_deg * 1e9
    assert abs(latched_ns - pose.t_ns) <= pose.dt_ns + 200
    assert 3_000_000 < pose.dt_ns < 8_000_000
    assert pose.t_source == "midpoint"
    assert pose.moving


def test_readers_that_take_turns_do_not_extrapolate() -> None:
    """A stream asks the controllers while the mover has asked only some of them."""
    rig = ChainRig()
    poses: list[XYThetaSample] = []
    rig.stage.topic.subscribe(poses.append)
    truth = moving(rig, lambda t_s: 5.0 + 1.5 * t_s)
    with rig.stage.stream(60.0):
        for _ in range(30):
            rig.stage.read()
            rig.bench.clock.sleep(0.003)
    assert len(poses) > 50
    assert max(off_um(rig, pose, truth) for pose in poses) < 0.1
    assert all(pose.dt_ns == 50_000 for pose in poses)


@pytest.mark.parametrize("reply", [b"0 2 1=#\n", b"0 2 1=1.0 \n2=1.0\n0 2 0\n", b"0 3 1=1.0\n", b"1=1.0\n"])
def test_a_malformed_answer_names_axis_and_address(reply: bytes) -> None:
    rig = ChainRig()
    rig.chain.script[b"2 POS?\n"] = reply
    with pytest.raises(ProtocolError, match="axis y") as caught:
        rig.stage.read()
    assert "address 2" in caught.value.what
    assert caught.value.device == "stage"
    assert caught.value.sent == ROUND[1]
    del rig.chain.script[b"2 POS?\n"]
    assert rig.stage.read().y_um == 0.0


def test_a_late_answer_of_one_controller_is_not_taken_for_anothers() -> None:
    """That of y comes when y has been given up, the line has been quiet, and theta is being asked."""
    rig = ChainRig()
    rig.stage.move_to(x_um=1000.0, y_um=2000.0, theta_deg=3.0)
    rig.chain.script = {b"2 POS?\n": None, b"2 \x04\n": None}
    rig.chain.delay_s[b"2 *IDN?\n"] = 0.132  # the last thing that y is asked in vain
    with pytest.raises(LinkTimeout, match="axis y, address 2"):
        rig.stage.read()
    rig.chain.script.clear()
    rig.stage.start_move_to(theta_deg=4.0)
    assert rig.theta.position["1"] == pytest.approx(4.0, abs=1e-4)
    assert rig.stage.read().y_um == 2000.0


def test_a_late_answer_of_another_controller_is_refused_by_both_names() -> None:
    rig = ChainRig()
    rig.y.position["1"] = 2.0
    rig.stage.read()
    rig.chain.script = {b"2 POS?\n": b"0 1 1=111.0\n", b"2 \x04\n": b"0 1 0x0000\n"}
    with pytest.raises(ProtocolError, match=r"axis y: .*address 2 was asked, and the answer is from address 1"):
        rig.stage.read()
    rig.chain.script.clear()
    assert rig.stage.read().y_um == 2000.0


def test_a_controller_that_is_switched_off_is_named_while_running() -> None:
    rig = ChainRig()
    rig.chain.off.add(3)
    with pytest.raises(LinkTimeout, match="axis theta, address 3: no reply") as caught:
        rig.stage.read()
    assert "DIP switches 1-4" in caught.value.remedy
    rig.chain.off.clear()
    assert rig.stage.read().referenced


def test_an_arrival_counts_when_both_readings_around_the_time_agree() -> None:
    rig = ChainRig()
    rig.stage.move_to(y_um=100.0)
    rig.y.moving, rig.y.on_target = True, False
    assert not rig.stage.read().on_target
    rig.y.moving, rig.y.on_target = False, True
    pose = rig.stage.read()
    assert (pose.moving, pose.on_target) == (True, False)  # at the time of x, y was still on its way
    assert rig.stage.read().on_target


def test_a_target_given_up_meanwhile_is_not_reported() -> None:
    rig = ChainRig()
    rig.stage.move_to(x_um=100.0, y_um=100.0)
    rig.theta.hooks[b"POS?"] = rig.stage.stop
    pose = rig.stage.read()
    assert math.isnan(pose.target_x_um)
    assert math.isnan(pose.target_y_um)


# ---------------------------------------------------------------------- the reader alone


def reading(
    axis: str, t_ns: int, position: float, *, mark: int = 0, moving: bool = True, jumping: bool = False
) -> Reading:
    status = AxisStatus(on_target=not moving, referencing=False, moving=moving, servo_on=True, error_flag=False)
    return Reading(
        t_ns, 10, "request", t_ns - 1000, t_ns + 1000, {axis: position}, {axis: math.nan}, {axis: status},
        (mark,), (mark,), jumping=jumping,
    )  # fmt: skip


times = st.integers(0, 20_000)


@settings(deadline=None, derandomize=True, max_examples=200)
@given(st.lists(st.tuples(times, times, times), min_size=1, max_size=8))
def test_whatever_is_read_in_whatever_order_nothing_is_extrapolated(rounds: list[tuple[int, int, int]]) -> None:
    """The position of each axis is its time, so that a pose is right if all its positions are its time."""
    asked = iter([tuple(sorted(times)) for times in rounds for _ in range(2)])

    def ask() -> list[Reading]:
        return [reading(axis, t, float(t)) for axis, t in zip(("x", "y", "theta"), next(asked), strict=True)]

    reader = PoseReader(ask)
    for _ in rounds:
        pose = reader.read()
        for position in pose.positions.values():
            assert abs(position - pose.t_ns) <= pose.dt_ns + 1e-6


def test_a_change_in_between_makes_a_pair_useless() -> None:
    marks = iter([0, 0, 1, 1, 1])
    t = iter(range(0, 100_000, 3000))

    def ask() -> list[Reading]:
        start, mark = next(t), next(marks)
        return [reading("x", start, start, mark=mark), reading("y", start + 1000, start + 1000.0, mark=mark)]

    reader = PoseReader(ask)
    assert reader.read().t_ns == 3000  # a second round, for there was none before
    pose = reader.read()  # another second round, because of the change
    assert (pose.t_ns, pose.positions) == (9000, {"x": 9000, "y": pytest.approx(9000.0)})
    assert (reader.read().t_ns, next(t)) == (12000, 15000)


@pytest.mark.parametrize("jumping", [(True, False), (False, True)])
def test_a_position_that_may_have_jumped_in_a_reference_move_is_not_interpolated(jumping: tuple[bool, bool]) -> None:
    rounds = iter([(0, 5.0, jumping[0]), (3000, 0.0, jumping[1])])

    def ask() -> list[Reading]:
        start_ns, position, jumps = next(rounds)
        return [
            reading("x", start_ns, 1.0, moving=False),
            reading("y", start_ns + 1000, position, moving=False, jumping=jumps),
        ]

    reader = PoseReader(ask)
    assert reader.read().positions["y"] == 5.0
    assert reader.read().positions["y"] == 0.0


def test_if_everything_changes_all_the_time_the_pose_says_how_uncertain_its_time_is() -> None:
    marks = iter(range(100))

    def ask() -> list[Reading]:
        return [reading("x", 0, 0.0, mark=next(marks)), reading("y", 5000, 5000.0, mark=next(marks))]

    pose = PoseReader(ask).read()
    assert (pose.t_ns, pose.dt_ns, pose.source) == (2500, 2510, "midpoint")


def test_the_least_certain_reading_decides_about_the_uncertainty_of_time() -> None:
    asked = iter(range(0, 100_000, 3000))

    def ask() -> list[Reading]:
        start_ns = next(asked)
        late = reading("y", start_ns + 1000, 0.0)._replace(dt_ns=70, source="midpoint")
        return [reading("x", start_ns, 0.0), late]

    pose = PoseReader(ask).read()
    assert (pose.t_ns, pose.dt_ns, pose.source) == (3000, 70, "midpoint")


def test_an_arrival_at_another_target_does_not_count() -> None:
    targets = iter([1.0, 2.0, 2.0])
    asked = iter(range(0, 100_000, 3000))

    def ask() -> list[Reading]:
        start_ns = next(asked)
        arrived = reading("y", start_ns + 1000, 0.0, moving=False)._replace(targets={"y": next(targets)})
        return [reading("x", start_ns, 0.0, moving=False), arrived]

    reader = PoseReader(ask)
    assert [reader.read().status["y"].on_target for _ in range(3)] == [True, False, True]


def test_whatever_may_make_positions_jump_changes_the_mark() -> None:
    rig = ChainRig()
    y = rig.stage._controllers[1]
    marks = [y.read().after]

    def changed() -> bool:
        marks.append(y.read().after)
        return marks[-1] != marks[-2]

    assert not changed()
    rig.stage.move_to(x_um=5.0)
    assert not changed()
    rig.stage.move_to(y_um=5.0)  # switches the servo on
    assert changed()
    rig.stage.move_to(y_um=10.0)
    assert not changed()
    rig.stage.stop()
    assert changed()
    rig.y.referenced["1"] = False
    y.examine()
    assert changed()
    rig.stage.reference(["y"])
    assert changed()
    y.state.begin_reference("y")
    assert y.read().jumping


def test_one_controller_needs_no_memory() -> None:
    pose = PoseReader(lambda: [reading("x", 7, 1.0)]).read()
    assert (pose.t_ns, pose.dt_ns, pose.source, pose.positions) == (7, 10, "request", {"x": 1.0})
