"""The system clock: real threads, whose errors cannot go unnoticed."""

import threading

import pytest

from microdrivers.core.clock import SystemClock

# One after the other: they run in real time.
pytestmark = pytest.mark.xdist_group("real_time")


@pytest.fixture
def clock():
    clock = SystemClock()
    yield clock
    clock.close()


def test_periodic_calls_run_in_a_thread_of_their_own_until_cancelled(clock):
    event, threads = clock.event(), set()

    def beat():
        threads.add(threading.get_ident())
        event.set()

    timer = clock.every(0.001, beat)
    assert event.wait(2.0)
    timer.cancel()
    event.clear()
    assert not event.wait(0.02)
    assert threading.get_ident() not in threads


def test_an_error_in_a_callback_is_raised_in_the_main_program(clock):
    failed = clock.event()

    def fail():
        failed.set()
        raise LookupError("no such axis")

    clock.every(0.001, fail)
    assert failed.wait(2.0)
    clock.every(0.001, lambda: None).cancel()
    with pytest.raises(LookupError, match="no such axis"):
        _sleep_in_pieces(clock, clock.now_ns() + 2_000_000_000)


def test_a_callback_may_cancel_itself(clock):
    calls, timers, known, done = [], [], clock.event(), clock.event()

    def once():
        known.wait(2.0)
        calls.append(1)
        timers[0].cancel()
        done.set()

    timers.append(clock.every(0.001, once))
    known.set()
    assert done.wait(2.0)
    clock.sleep(0.02)
    assert calls == [1]


def test_sleep_until_the_past_returns_at_once(clock):
    clock.sleep_until(clock.now_ns() - 1)


def _sleep_in_pieces(clock, until_ns):
    while clock.now_ns() < until_ns:
        clock.sleep(0.005)
