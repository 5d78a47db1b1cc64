"""The simulated clock: order, local time of exchanges, and no way to run backwards."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.clock import ClockError, SimulatedClock

MS = 1_000_000


def test_calls_happen_in_time_order_and_ties_keep_their_order_of_entry():
    clock, seen = SimulatedClock(), []
    for t_ms, name in ((3, "c"), (1, "a"), (2, "b1"), (2, "b2")):
        clock.call_at(t_ms * MS, lambda name=name: seen.append((clock.now_ns() // MS, name)))
    clock.sleep(0.01)
    assert seen == [(1, "a"), (2, "b1"), (2, "b2"), (3, "c")]
    assert clock.now_ns() == 10 * MS


@settings(deadline=None, max_examples=50)
@given(st.lists(st.integers(0, 50), max_size=20), st.lists(st.integers(0, 30), max_size=5))
def test_time_never_runs_backwards(due_ms, sleeps_ms):
    clock, seen = SimulatedClock(), []
    for t_ms in due_ms:
        clock.call_at(t_ms * MS, lambda: seen.append(clock.now_ns()))
    for pause_ms in sleeps_ms:
        clock.sleep(pause_ms / 1000)
        seen.append(clock.now_ns())
    assert seen == sorted(seen)


def test_an_exchange_in_a_callback_takes_local_time_only():
    clock, seen = SimulatedClock(), []

    def poll():
        with clock.transaction():
            clock.sleep(0.007)
        seen.append(("poll", clock.now_ns() // MS))

    clock.call_at(0, poll)
    clock.call_at(2 * MS, lambda: seen.append(("frame", clock.now_ns() // MS)))
    clock.sleep(0.02)
    assert seen == [("poll", 7), ("frame", 2)]


def test_an_exchange_of_the_main_program_is_caught_up_with_when_it_ends():
    clock, seen = SimulatedClock(), []
    clock.every(0.002, lambda: seen.append(clock.now_ns() // MS), start_ns=MS)
    with clock.transaction():
        clock.sleep(0.006)
        assert seen == []
    assert seen == [1, 3, 5]
    assert clock.now_ns() == 6 * MS


def test_delivery_waits_for_what_is_due_before_it():
    clock, seen = SimulatedClock(), []

    def poll():
        with clock.transaction():
            clock.sleep(0.005)
        clock.deliver(lambda: seen.append("pose"))

    clock.call_at(0, poll)
    clock.call_at(3 * MS, lambda: seen.append("frame"))
    clock.sleep(0.01)
    assert seen == ["frame", "pose"]


def test_a_callback_must_not_wait():
    clock = SimulatedClock()
    clock.call_at(0, lambda: clock.sleep(1.0))
    with pytest.raises(ClockError, match="must not wait"):
        clock.sleep(1.0)


def test_a_slow_periodic_call_skips_beats_and_keeps_the_grid():
    clock, seen = SimulatedClock(), []

    def slow():
        seen.append(clock.now_ns() // MS)
        with clock.transaction():
            clock.sleep(0.025)

    timer = clock.every(0.010, slow)
    clock.sleep(0.1)
    timer.cancel()
    clock.sleep(0.1)
    assert seen == [0, 30, 60, 90]


def test_an_event_wakes_no_earlier_than_the_callback_that_set_it():
    clock = SimulatedClock()
    event = clock.event()

    def poll():
        with clock.transaction():
            clock.sleep(0.004)
        event.set()

    clock.call_at(2 * MS, poll)
    assert event.wait(1.0)
    assert clock.now_ns() == 6 * MS


def test_an_event_that_never_comes_takes_exactly_the_time_out():
    clock = SimulatedClock()
    clock.every(0.3, lambda: None)
    assert not clock.event().wait(1.0)
    assert clock.now_ns() == 1000 * MS


def test_a_failing_callback_reaches_the_main_program_and_leaves_the_clock_usable():
    clock = SimulatedClock()
    clock.call_at(MS, lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        clock.sleep(0.01)
    clock.sleep(0.01)
    assert clock.now_ns() == 11 * MS


def test_a_period_must_be_positive():
    with pytest.raises(ClockError, match="positive"):
        SimulatedClock().every(0.0, lambda: None, name="camera")


# ---------------------------------------------------------------------- emulators that work ahead


def chain(clock, times_ns, seen, *, ahead):
    """Something that happens at these times: in one call as far as the clock lets it, or in a call each."""
    waiting = list(times_ns)

    def step():
        while True:
            seen.append(("chain", clock.now_ns()))
            if not waiting:
                return
            t_ns = waiting.pop(0)
            if not (ahead and clock.go_on_at(t_ns)):
                clock.call_at(t_ns, step)
                return

    clock.call_at(waiting.pop(0), step)


@settings(deadline=None, max_examples=100)
@given(
    st.lists(st.integers(0, 50), min_size=1, max_size=12).map(sorted),
    st.lists(st.integers(0, 50), max_size=12),
    st.lists(st.integers(0, 25), max_size=6),
)
def test_going_on_is_the_same_as_being_called_again(times_ms, others_ms, sleeps_ms):
    def run(*, ahead):
        clock, seen = SimulatedClock(), []
        for number, t_ms in enumerate(others_ms):
            clock.call_at(t_ms * MS, lambda number=number: seen.append((number, clock.now_ns())))
        chain(clock, [t_ms * MS for t_ms in times_ms], seen, ahead=ahead)
        for pause_ms in sleeps_ms:
            clock.sleep(pause_ms / 1000)
            seen.append(("main", clock.now_ns()))
        return seen

    assert run(ahead=True) == run(ahead=False)


def test_a_callback_knows_how_long_nobody_else_can_act():
    clock, seen = SimulatedClock(), []
    clock.call_at(MS, lambda: seen.append(clock.free_until_ns()))
    clock.call_at(2 * MS, lambda: seen.append(clock.free_until_ns()))
    clock.call_at(4 * MS, lambda: None).cancel()
    clock.call_at(5 * MS, lambda: None)
    clock.sleep(0.003)
    assert seen == [2 * MS, 3 * MS + 1]  # the next call; the end of the main program's wait
    assert clock.free_until_ns() == 3 * MS
    assert not clock.go_on_at(3 * MS)


def test_who_waits_for_an_event_may_go_on_after_any_call():
    clock, seen = SimulatedClock(), []
    event = clock.event()

    def fire():
        event.set()
        seen.append((clock.free_until_ns(), clock.go_on_at(3 * MS)))

    clock.call_at(MS, lambda: 1 / 0)
    clock.call_at(2 * MS, fire)
    with pytest.raises(ZeroDivisionError):
        clock.sleep(0.01)  # until when nobody else could act, had it not failed
    assert event.wait(1.0)
    assert seen == [(2 * MS, False)]
    assert clock.now_ns() == 2 * MS


def test_what_follows_an_exchange_comes_once_and_before_all_others():
    clock, seen = SimulatedClock(), []
    clock.call_at(MS, lambda: seen.append("due meanwhile"))
    with clock.transaction():
        with clock.transaction():
            clock.after_exchange(lambda: seen.append(clock.now_ns() // MS))
            clock.sleep(0.002)
        assert seen == []
    with clock.transaction():
        pass
    assert seen == [2, "due meanwhile"]
