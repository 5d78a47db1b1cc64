"""Who lets a served bus go on, wakes whom, and what nodes make of a computer that was too busy for that."""

from __future__ import annotations

import threading
from itertools import pairwise
from pathlib import Path

import pytest

from microdrivers.core.clock import SystemClock
from microdrivers.devices.drivers import Endpoint, ServeRequest
from microdrivers.fakes.can import Frame, Medium, SlcanAdapter, serve_medium
from microdrivers.fakes.can.arrival import Arrival
from microdrivers.fakes.can.frame import Due
from tests.fakes.can_bench import PATIENCE_S, Listener, Periodic, wait_until

pytestmark = pytest.mark.xdist_group("real_time")


def serve(medium: Medium, folder: Path) -> Endpoint:
    return serve_medium("probe_force", medium, ServeRequest(transport="pty", bind="127.0.0.1", folder=folder))


def test_a_frame_that_comes_while_the_adapter_looks_does_not_keep_it_asleep(clock: SystemClock, medium: Medium) -> None:
    """Between the look that finds it and the next one nothing is left to be woken by: the frame after it must wake."""
    adapter = SlcanAdapter(medium, byte_ns=3_000)
    woken = threading.Event()
    adapter.wake = woken.set
    now = clock.now_ns
    adapter.receive(b"S6\rO\r", now(), now())
    other, port = medium.open_port(), adapter._port
    assert port is not None
    poll = port.poll

    def send_and_poll(t_ns: int) -> Arrival | None:
        port.poll = poll  # type: ignore[method-assign]
        other.send(Frame(0x181))
        assert woken.wait(PATIENCE_S)
        woken.clear()
        return poll(now())

    port.poll = send_and_poll  # type: ignore[method-assign]
    assert len(adapter.advance(now())) == 1
    assert adapter.next_event_ns() is None  # whoever looks after the adapter goes to sleep now
    # Not from here: whoever looks needs no waking, and on a busy computer it is this thread that plays what it sends.
    sender = threading.Thread(target=other.send, args=(Frame(0x182),))
    sender.start()
    sender.join()
    assert woken.wait(PATIENCE_S)


class Owed:
    """A node that wants something of a host 30 ms after it was attached, or later if hosts are excused."""

    def __init__(self) -> None:
        self.due_ns: int | None = None
        self.missed = False
        self.excuses: list[int] = []

    def receive(self, _frame: Frame, _t_ns: int) -> list[Due]:
        self.due_ns = None
        return []

    def advance(self, t_ns: int) -> list[Due]:
        if self.due_ns is None:
            self.due_ns = t_ns + 30_000_000
        elif self.due_ns <= t_ns:
            self.due_ns, self.missed = t_ns + 3_600_000_000_000, True
        return []

    def next_event_ns(self) -> int | None:
        return self.due_ns

    def excuse_hosts(self, late_ns: int, until_ns: int) -> None:
        self.excuses.append(late_ns)
        if self.due_ns is not None:
            self.due_ns = max(self.due_ns + late_ns, until_ns)


def test_no_host_is_blamed_for_time_in_which_the_computer_played_nothing(clock: SystemClock, medium: Medium) -> None:
    node, host = Owed(), medium.open_port()
    with medium.lock:  # nobody can let the bus go on
        medium.attach(node)
        clock.sleep(0.2)
        host.send(Frame(0x77F))  # what was waiting to be read
    wait_until(clock, lambda: node.due_ns is None or node.missed)
    assert not node.missed
    assert max(node.excuses) > 100_000_000


def test_a_host_that_is_silent_is_blamed_all_the_same(clock: SystemClock, medium: Medium) -> None:
    node = Owed()
    medium.attach(node)
    wait_until(clock, lambda: node.missed)


def test_whoever_serves_the_bus_turns_it_and_afterwards_it_goes_on_by_itself(
    clock: SystemClock, medium: Medium, tmp_path: Path
) -> None:
    listener = Listener()
    medium.attach(listener)
    medium.attach(Periodic(0x185, period_ms=2))
    for _ in range(2):
        endpoint = serve(medium, tmp_path)
        begun = len(listener.heard)
        wait_until(clock, lambda begun=begun: len(listener.heard) > begun + 10)  # type: ignore[misc]
        endpoint.close()
        ended = len(listener.heard)
        wait_until(clock, lambda ended=ended: len(listener.heard) > ended + 10)  # type: ignore[misc]
    times_ns = [t_ns for t_ns, frame in listener.heard if frame.id == 0x185]
    assert all(after - before == pytest.approx(2_000_000, abs=20_000) for before, after in pairwise(times_ns))


def test_what_changes_behind_the_adapters_back_is_played_in_time(
    clock: SystemClock, medium: Medium, tmp_path: Path
) -> None:
    """The adapter sleeps until the bus has something to do: a node that is switched on later must wake it."""
    endpoint = serve(medium, tmp_path)
    clock.sleep(0.05)
    listener = Listener()
    medium.attach(listener)
    medium.attach(Periodic(0x185, period_ms=2))
    wait_until(clock, lambda: len(listener.heard) > 5)
    endpoint.close()
