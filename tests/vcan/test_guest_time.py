"""In a guest, time is made (scripts/vcan_run/uml_clock.c): it must still be time."""

import os
import threading
import time

import pytest

pytestmark = pytest.mark.vcan

LATE_NS = 2_000_000


@pytest.mark.parametrize("pause_s", [0.0002, 0.003, 0.05, 0.7])
def test_a_sleep_does_not_end_early_and_in_a_guest_not_late_either(pause_s):
    begun_ns = time.monotonic_ns()
    time.sleep(pause_s)
    passed_ns = time.monotonic_ns() - begun_ns
    assert passed_ns >= pause_s * 1e9
    if os.environ["VCAN_RUN"] == "uml":
        assert passed_ns <= pause_s * 1e9 + LATE_NS


def test_the_clock_goes_on_while_threads_are_at_work():
    readings, done = [], threading.Event()

    def read():
        while not done.is_set():
            readings.append(time.monotonic_ns())

    reader = threading.Thread(target=read)
    reader.start()
    for _ in range(100):
        time.sleep(0.0005)
    done.set()
    reader.join()
    assert readings == sorted(readings)
    assert readings[-1] - readings[0] >= 45_000_000


def test_the_calendar_goes_with_the_clock():
    begun_ns, begun_s = time.monotonic_ns(), time.time()
    time.sleep(1.0)
    assert time.time() - begun_s == pytest.approx((time.monotonic_ns() - begun_ns) / 1e9, abs=0.005)
