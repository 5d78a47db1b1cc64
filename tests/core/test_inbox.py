"""Inboxes and estimator hosts: bounded, with a recorded order of arrival that replays to the same result."""

import random
import threading

import pytest

from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock, SystemClock
from microdrivers.core.inbox import EstimatorHost, Inbox
from microdrivers.core.samples import DeviceEvent


def event(seq, device="a"):
    return DeviceEvent(t_ns=seq, device=device, kind="opened", seq=seq)


class OrderSensitive:
    """An estimator whose result depends on every bit of the order of its input."""

    def __init__(self):
        self.state = 1.0

    def update(self, sample):
        self.state = (self.state * 1.000_1 + sample.seq * (1.0 if sample.device == "a" else -0.7)) % 1e6
        return [DeviceEvent(t_ns=sample.t_ns, device="estimate", kind="opened", reason=self.state.hex())]


def test_drop_oldest_keeps_the_newest_and_counts():
    inbox = Inbox(capacity=2, policy="drop_oldest")
    for seq in range(5):
        inbox.put(event(seq))
    assert inbox.dropped == 3
    assert [inbox.take().seq, inbox.take().seq, inbox.take()] == [3, 4, None]


def test_block_makes_the_publisher_wait_for_room():
    inbox = Inbox(capacity=1, policy="block")
    inbox.put(event(0))
    publisher = threading.Thread(target=inbox.put, args=(event(1),), daemon=True)
    publisher.start()
    publisher.join(0.05)
    assert publisher.is_alive()
    assert inbox.take().seq == 0
    publisher.join(2.0)
    assert not publisher.is_alive()
    assert inbox.dropped == 0
    assert inbox.take().seq == 1


def test_closing_releases_a_waiting_publisher():
    inbox = Inbox(capacity=1)
    inbox.put(event(0))
    publisher = threading.Thread(target=inbox.put, args=(event(1),), daemon=True)
    publisher.start()
    inbox.close()
    publisher.join(2.0)
    assert not publisher.is_alive()


def test_on_a_simulated_clock_the_estimator_runs_as_samples_arrive():
    bus, out = Bus(), []
    topic = bus.topic("a", DeviceEvent)
    EstimatorHost(SimulatedClock(), OrderSensitive(), [topic], out.append)
    topic.publish(event(1))
    assert len(out) == 1


def test_a_threaded_run_replays_in_its_recorded_order_to_the_same_bits():
    bus, live = Bus(), []
    topics = {name: bus.topic(name, DeviceEvent) for name in "ab"}
    clock = SystemClock()
    host = EstimatorHost(clock, OrderSensitive(), topics.values(), live.append, capacity=8, keep_samples=True)

    def publish(name):
        for seq in range(300):
            topics[name].publish(event(seq, name))

    threads = [threading.Thread(target=publish, args=(name,)) for name in "ab"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    host.close()
    clock.close()
    assert len(live) == 600
    assert [sample.order for sample in host.recorded] == host.inbox.arrivals

    by_order = {sample.order: sample for sample in random.Random(1).sample(host.recorded, 600)}
    replayed = OrderSensitive()
    again = [replayed.update(by_order[order])[0].reason for order in host.inbox.arrivals]
    assert again == [estimate.reason for estimate in live]


def test_closing_does_not_overtake_an_estimator_that_is_far_behind(monkeypatch):
    """The clock waits for its threads for a while only; the rest must still be consumed in order, one by one."""
    monkeypatch.setattr("microdrivers.core.clock.system._JOIN_S", 0.02)
    clock = SystemClock()
    busy, seen = threading.Lock(), []

    class Slow:
        def update(self, sample):
            assert busy.acquire(blocking=False)
            clock.sleep(0.01)
            seen.append(sample.seq)
            busy.release()
            return []

    topic = Bus().topic("a", DeviceEvent)
    host = EstimatorHost(clock, Slow(), [topic], lambda estimate: None, keep_samples=True)
    for seq in range(10):
        topic.publish(event(seq))
    host.close()
    assert seen == list(range(10))
    assert [sample.order for sample in host.recorded] == host.inbox.arrivals
    clock.close()


def test_a_failing_estimator_in_a_thread_is_not_silent():
    class Broken:
        def update(self, sample):
            raise ArithmeticError("singular")

    bus, clock = Bus(), SystemClock()
    topic = bus.topic("a", DeviceEvent)
    host = EstimatorHost(clock, Broken(), [topic], lambda estimate: None)
    topic.publish(event(0))
    failed_by_ns = clock.now_ns() + 2_000_000_000
    with pytest.raises(ArithmeticError, match="singular"):
        _sleep_in_pieces(clock, failed_by_ns)
    with pytest.raises(ArithmeticError, match="singular"):
        host.close()
    clock.close()


def test_a_failing_estimator_on_a_simulated_clock_is_raised_when_its_host_closes():
    class Broken:
        def update(self, sample):
            raise ArithmeticError("singular")

    topic = Bus().topic("a", DeviceEvent)
    host = EstimatorHost(SimulatedClock(), Broken(), [topic], lambda estimate: None)
    topic.publish(event(0))
    topic.publish(event(1))
    with pytest.raises(ArithmeticError, match="singular"):
        host.close()


def _sleep_in_pieces(clock, until_ns):
    while clock.now_ns() < until_ns:
        clock.sleep(0.005)
