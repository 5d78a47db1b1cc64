"""The bus: order, containment of errors, guards, history."""

import logging

import pytest

from microdrivers.core.bus import Bus, BusError
from microdrivers.core.samples import DeviceEvent, TrackedPoint


def event(device="stage", **changes):
    return DeviceEvent(t_ns=0, device=device, kind="opened", **changes)


def test_the_order_is_bus_wide_and_given_once():
    bus = Bus()
    a, b = bus.topic("a", DeviceEvent), bus.topic("b", DeviceEvent)
    samples = [event(), event(), event()]
    a.publish(samples[0])
    b.publish(samples[1])
    a.publish(samples[2])
    assert [sample.order for sample in samples] == [0, 1, 2]
    Bus().topic("replay", DeviceEvent).publish(samples[2])
    assert samples[2].order == 2


def test_samples_are_immutable_for_everybody_else():
    sample = event()
    with pytest.raises(AttributeError):
        sample.order = 5


def test_a_failing_subscriber_is_counted_logged_once_and_does_not_reach_the_others(caplog):
    topic = Bus().topic("a", DeviceEvent)
    seen = []
    broken = topic.subscribe(lambda sample: 1 / 0)
    topic.subscribe(seen.append)
    with caplog.at_level(logging.ERROR):
        topic.publish(event())
        topic.publish(event())
    assert len(seen) == 2
    assert broken.error_count == topic.error_count == 2
    assert isinstance(broken.last_error, ZeroDivisionError)
    assert len(caplog.records) == 1


def test_guards_run_before_all_subscribers_and_their_errors_reach_the_publisher():
    bus, seen = Bus(), []
    topic = bus.topic("a", DeviceEvent)
    topic.subscribe(lambda sample: seen.append("subscriber"))
    bus.guard(lambda sample: seen.append("guard"))
    topic.publish(event())
    assert seen == ["guard", "subscriber"]

    def trip(sample):
        raise RuntimeError("too much force")

    bus.guard(trip)
    with pytest.raises(RuntimeError, match="too much force"):
        topic.publish(event())
    assert seen == ["guard", "subscriber", "guard"]


def test_history_is_bounded_and_latest_is_its_end():
    topic = Bus().topic("a", DeviceEvent, history=3)
    assert topic.latest is None
    for seq in range(5):
        topic.publish(event(seq=seq))
    assert [sample.seq for sample in topic.history] == [2, 3, 4]
    assert topic.latest is topic.history[-1]


def test_a_cancelled_subscription_is_not_called():
    topic, seen = Bus().topic("a", DeviceEvent), []
    subscription = topic.subscribe(seen.append)
    subscription.cancel()
    topic.publish(event())
    assert seen == []


def test_a_topic_has_one_type():
    bus = Bus()
    bus.topic("a", DeviceEvent)
    with pytest.raises(BusError, match="carries DeviceEvent, not TrackedPoint"):
        bus.topic("a", TrackedPoint)
