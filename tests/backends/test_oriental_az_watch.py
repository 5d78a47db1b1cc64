from __future__ import annotations

import pytest

from microdrivers.backends.oriental_az.drive import Motion, Output, Status
from microdrivers.backends.oriental_az.motion_watch import STATUS_PERIOD_S, MotionWatch
from microdrivers.core.units import NS_PER_MS, NS_PER_S

AT_REST = Output.IN_POS | Output.READY | Output.HOME_END


class Feed:
    """Feeds a watch with what a drive would report, a step of time for each."""

    def __init__(self) -> None:
        self.watch = MotionWatch(tolerance_steps=2, settle_s=0.1)
        self.t_ms = 0

    def status(self, outputs: Output) -> None:
        self.t_ms += 10
        self.watch.see_status(Status(outputs, self.t_ms * NS_PER_MS))

    def motion(self, command: int, feedback: int, *, speed: int = 0) -> bool:
        self.t_ms += 10
        self.watch.see_motion(Motion(command, speed, feedback, self.t_ms * NS_PER_MS, NS_PER_MS))
        return self.watch.moving


@pytest.fixture
def feed() -> Feed:
    """A drive that has rested for a second."""
    feed = Feed()
    feed.status(AT_REST)
    feed.motion(100, 100)
    feed.t_ms += 1000
    feed.status(AT_REST)
    assert not feed.motion(100, 100)
    assert feed.watch.in_position
    return feed


def test_nothing_is_said_before_the_drive_was_asked() -> None:
    watch = MotionWatch(tolerance_steps=2, settle_s=0.1)
    assert (watch.moving, watch.in_position, watch.referenced) == (True, False, False)
    assert watch.wants_status(0)


def test_moving_from_the_command_on(feed: Feed) -> None:
    feed.watch.commanded()
    assert feed.watch.moving
    assert not feed.watch.in_position
    assert feed.motion(100, 100)  # not started yet


def test_only_a_status_without_move_and_with_arrival_ends_a_motion(feed: Feed) -> None:
    feed.watch.commanded()
    assert feed.motion(150, 140, speed=500)
    assert not feed.watch.wants_status(feed.t_ms * NS_PER_MS)
    assert feed.motion(200, 195)
    for outputs in (Output.MOVE, Output.MOVE | Output.IN_POS, Output.READY):
        assert feed.watch.wants_status(feed.t_ms * NS_PER_MS)
        feed.status(outputs)
        assert feed.motion(200, 200)
        assert not feed.watch.in_position
    feed.status(AT_REST)
    assert not feed.motion(200, 200)
    assert feed.watch.in_position


def test_arrival_ends_a_motion_with_the_second_sample_that_shows_it(feed: Feed) -> None:
    """The interval of the first may have begun while the motor still moved."""
    feed.watch.commanded(200)
    assert feed.motion(150, 140, speed=500)
    assert feed.motion(200, 200)
    assert not feed.motion(200, 199)
    assert not feed.watch.in_position  # the drive's own word


def test_a_short_silence_is_no_restart(feed: Feed) -> None:
    for silence_ms, restarted in ((900, False), (1100, True)):
        feed.watch.link_failed()
        feed.t_ms += silence_ms - 10
        feed.status(AT_REST)
        assert feed.watch.may_have_restarted is restarted
    feed.status(AT_REST)
    assert not feed.watch.may_have_restarted


def test_a_motion_that_goes_on_outweighs_the_status_before_it(feed: Feed) -> None:
    feed.watch.commanded()
    feed.status(AT_REST)
    assert feed.motion(150, 140, speed=500)


def test_rest_before_the_command_is_no_rest_after_it(feed: Feed) -> None:
    feed.watch.commanded()
    feed.motion(100, 100)
    feed.status(Output.NONE)
    assert feed.motion(100, 100)


def test_after_a_stop_the_motor_must_be_seen_to_stand_still(feed: Feed) -> None:
    feed.watch.commanded()
    feed.motion(150, 140, speed=500)
    feed.motion(160, 155)
    moving = []
    for _ in range(8):
        feed.status(Output.HOME_END)
        moving.append(feed.motion(160, 160))
    assert moving == [True] * 5 + [False] * 3  # 0.1 s after the feedback came to rest
    assert not feed.watch.in_position


@pytest.mark.parametrize(("command", "feedback", "speed"), [(101, 100, 0), (100, 103, 0), (100, 97, 0), (100, 100, -1)])
def test_a_motor_at_rest_that_something_moves(feed: Feed, command: int, feedback: int, speed: int) -> None:
    assert feed.motion(command, feedback, speed=speed)
    feed.status(AT_REST)
    assert not feed.motion(command, feedback)


def test_wandering_within_the_tolerance_is_rest(feed: Feed) -> None:
    assert not any(feed.motion(100, 100 + offset) for offset in (1, -1, 2, -2, 0))


def test_slow_creeping_is_noticed(feed: Feed) -> None:
    assert [feed.motion(100, 100 + offset) for offset in (1, 2, 3)] == [False, False, True]


def test_the_status_is_wanted_again_after_half_a_second(feed: Feed) -> None:
    now_ns = feed.t_ms * NS_PER_MS
    assert not feed.watch.wants_status(now_ns)
    assert feed.watch.wants_status(now_ns + round(STATUS_PERIOD_S * NS_PER_S))
    feed.watch.link_failed()
    assert feed.watch.wants_status(now_ns)


def test_an_alarm_is_never_in_position(feed: Feed) -> None:
    feed.status(AT_REST | Output.ALM_A)
    feed.motion(100, 100)
    assert feed.watch.alarm
    assert not feed.watch.in_position


def test_home_end_may_go_off_by_an_operation_only(feed: Feed) -> None:
    feed.watch.commanded()
    feed.status(Output.MOVE)
    feed.motion(150, 140, speed=500)
    feed.status(Output.IN_POS | Output.READY)
    feed.motion(200, 200)
    assert feed.watch.referenced
    feed.status(AT_REST)
    feed.status(Output.IN_POS | Output.READY)
    assert not feed.watch.referenced
