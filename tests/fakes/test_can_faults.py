"""The emulated CAN bus: its ports, nodes that come and go, and what can go wrong."""

from __future__ import annotations

import pytest

from microdrivers.core.clock import SimulatedClock
from microdrivers.core.errors import ConfigError, OutOfRange
from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.fakes.can import (
    Arrival,
    Frame,
    Medium,
    Port,
    PortError,
    Temper,
    forget_medium,
    medium_named,
    shared_medium,
)
from microdrivers.fakes.can import medium as medium_module
from microdrivers.fakes.can.arrival import PROTOCOL_ERROR
from microdrivers.fakes.can.port import RECEIVE_QUEUE, TRANSMIT_QUEUE
from tests.fakes.can_bench import BIT_NS, Listener, Periodic

START_NS = NS_PER_S
PUNCTUAL = Temper(max_delay_s=0.0)
SYNC = Frame(0x080)
SYNC_BITS = 48  # written out in test_can_frame.py


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock(start_ns=START_NS)


@pytest.fixture
def medium(clock: SimulatedClock) -> Medium:
    return Medium("can0", clock=clock, bitrate=500_000, seed=1, temper=PUNCTUAL)


def passed(medium: Medium) -> list[int]:
    return [frame.id for _, who, frame in medium.log if who != "error"]


# ---------------------------------------------------------------------- ports


def test_a_port_hears_its_own_frames_if_asked_to(clock: SimulatedClock, medium: Medium) -> None:
    port = medium.open_port(receive_own=True)
    port.send(SYNC)
    arrival = port.receive(0.01)
    assert arrival == Arrival(START_NS + SYNC_BITS * BIT_NS, SYNC, own=True)


def test_filters(clock: SimulatedClock, medium: Medium) -> None:
    port, sender = medium.open_port(), medium.open_port()

    def arrives(*frames: Frame) -> list[Frame]:
        for frame in frames:
            sender.send(frame)
        clock.sleep(0.01)
        return [arrival.frame for arrival in iter(lambda: port.receive(0), None)]

    a, b, c = Frame(0x185), Frame(0x285), Frame(0x185, extended=True)
    assert arrives(a, b, c) == [a, b, c]
    port.set_filters([(0x185, 0x7FF, None)])
    assert arrives(a, b, c) == [a, c]
    port.set_filters([(0x085, 0x0FF, False)])
    assert arrives(a, b, c) == [a, b]
    port.set_filters([(0x085, 0x07F, False), (0x185, 0x1FFFFFFF, True)])
    assert arrives(a, b, c) == [a, b, c]
    port.set_filters([])
    assert arrives(a, b, c) == [a, b, c]


def test_a_port_that_is_opened_during_a_frame_misses_it(clock: SimulatedClock, medium: Medium) -> None:
    sender = medium.open_port()
    sender.send(SYNC)
    sender.send(Frame(0x100))
    clock.sleep(0.00001)
    late = medium.open_port()
    clock.sleep(0.01)
    assert [arrival.frame.id for arrival in iter(lambda: late.receive(0), None)] == [0x100]


def test_a_full_transmit_queue_refuses(clock: SimulatedClock, medium: Medium) -> None:
    port = medium.open_port()
    for _ in range(TRANSMIT_QUEUE):
        port.send(SYNC)
    with pytest.raises(PortError, match="queue is full"):
        port.send(SYNC)
    clock.sleep(0.001)
    port.send(SYNC)
    clock.sleep(0.1)
    assert len(medium.log) == TRANSMIT_QUEUE + 1


def test_a_host_that_does_not_read_loses_frames_and_the_log_stays_bounded(
    clock: SimulatedClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(medium_module, "LOG_LENGTH", 100)
    medium = Medium("can0", clock=clock, bitrate=1_000_000, seed=1)
    port = medium.open_port()
    medium.attach(Periodic(0x185, period_ms=0.1))
    clock.sleep((RECEIVE_QUEUE + 50) * 0.0001)
    assert 45 <= port.dropped_frames <= 52
    assert len(medium.log) == 100


@pytest.mark.parametrize("frame", [Frame(0x800), Frame(0x100, bytes(9)), Frame(1 << 29, extended=True)])
def test_what_is_no_frame_is_refused(medium: Medium, frame: Frame) -> None:
    with pytest.raises(OutOfRange):
        medium.open_port().send(frame)


def test_the_load_of_the_bus(clock: SimulatedClock, medium: Medium) -> None:
    assert medium.load(1.0) == 0.0
    port = medium.open_port()
    clock.every(0.001, lambda: port.send(SYNC))
    clock.sleep(2.0)
    assert medium.load(1.0) == pytest.approx((SYNC_BITS + 3) * BIT_NS / NS_PER_MS, rel=0.002)
    assert medium.load(0.1) == pytest.approx((SYNC_BITS + 3) * BIT_NS / NS_PER_MS, rel=0.02)


def test_a_bit_rate_that_no_bus_has_is_refused(clock: SimulatedClock) -> None:
    with pytest.raises(OutOfRange, match="333"):
        Medium("can0", clock=clock, bitrate=333, seed=0)


# ---------------------------------------------------------------------- nodes come and go


def test_a_node_that_is_switched_off_is_silent_and_boots_again(clock: SimulatedClock, medium: Medium) -> None:
    node = Periodic(0x185)
    medium.attach(node)
    clock.sleep(0.025)
    assert passed(medium) == [0x705, 0x185, 0x185]
    medium.detach(node)
    clock.sleep(0.1)
    assert len(medium.log) == 3
    node.due_ns = None
    medium.attach(node)
    clock.sleep(0.001)
    assert passed(medium)[3:] == [0x705]


def test_a_frame_of_a_node_that_loses_its_supply_is_lost(clock: SimulatedClock, medium: Medium) -> None:
    node, port = Periodic(0x185), medium.open_port()
    medium.attach(node)
    clock.sleep(0.00003)  # in the middle of its boot-up
    medium.detach(node)
    port.send(SYNC)
    clock.sleep(0.1)
    assert passed(medium) == [0x080]


def test_a_node_that_was_changed_from_outside_is_asked_again(clock: SimulatedClock, medium: Medium) -> None:
    node = Periodic(0x185, period_ms=1000)
    medium.attach(node)
    clock.sleep(0.01)
    node.due_ns = clock.now_ns() + NS_PER_MS
    medium.refresh()
    clock.sleep(0.01)
    assert passed(medium) == [0x705, 0x185]


# ---------------------------------------------------------------------- what can go wrong


def test_pulling_the_cable_fails_all_ports_until_they_are_opened_anew(clock: SimulatedClock, medium: Medium) -> None:
    periodic, listener, port = Periodic(0x185), Listener(), medium.open_port()
    medium.attach(listener)
    told: list[int] = []
    port.on_arrival(lambda: told.append(clock.now_ns()))
    port.send(SYNC)
    clock.sleep(0.00003)
    medium.unplug()
    medium.attach(periodic)
    clock.sleep(0.02)
    assert told == [START_NS + 30_000]
    for attempt in (lambda: port.send(SYNC), lambda: port.receive(0.1), medium.open_port):
        with pytest.raises(PortError, match="unplugged") as caught:
            attempt()
        assert caught.value.number == 19
    assert passed(medium) == [0x705, 0x185]  # the frame that was under way is gone; the nodes go on
    medium.plug_in()
    with pytest.raises(PortError, match="unplugged"):
        port.send(SYNC)
    fresh = medium.open_port()
    fresh.send(SYNC)
    clock.sleep(0.001)
    assert passed(medium)[-1] == 0x080


def test_a_wait_ends_when_the_cable_is_pulled(clock: SimulatedClock, medium: Medium) -> None:
    port = medium.open_port()
    clock.call_at(START_NS + NS_PER_MS, medium.unplug)
    with pytest.raises(PortError, match="unplugged"):
        port.receive(1.0)
    assert clock.now_ns() == START_NS + NS_PER_MS


def test_a_closed_port_leaves_the_bus(clock: SimulatedClock, medium: Medium) -> None:
    port, told = medium.open_port(), []
    port.on_arrival(lambda: told.append(1))
    port.send(SYNC)
    port.close()
    port.close()
    clock.sleep(0.01)
    assert (list(medium.log), told) == ([], [])
    with pytest.raises(PortError, match="closed"):
        port.receive(0)


def test_a_disturbed_frame_is_sent_again(clock: SimulatedClock, medium: Medium) -> None:
    node, port, other = Listener(), medium.open_port(), medium.open_port()
    medium.attach(node)
    port.send(SYNC)
    clock.sleep_until(START_NS + 40_000)
    medium.inject_error_frame()
    clock.sleep(0.01)
    error_ns = START_NS + 40_000 + 20 * BIT_NS
    again_ns = error_ns + (3 + SYNC_BITS) * BIT_NS
    assert list(medium.log) == [(error_ns, "error", PROTOCOL_ERROR), (again_ns, "host", SYNC)]
    assert node.heard == [(again_ns, SYNC)]
    assert other.receive(0) == Arrival(error_ns, PROTOCOL_ERROR, error=True)
    assert other.receive(0) == Arrival(again_ns, SYNC)
    assert (medium.error_frames, port.transmit_errors, other.transmit_errors) == (1, 7, 0)


def test_error_frames_on_an_idle_bus_are_heard(clock: SimulatedClock, medium: Medium) -> None:
    port = medium.open_port()
    port.set_filters([(0x123, 0x7FF, None)])
    medium.inject_error_frame()
    medium.inject_error_frame()  # the second flag begins while the first one lasts
    clock.sleep(0.01)
    arrival = port.receive(0)
    assert arrival is not None
    assert arrival.error
    assert medium.error_frames == 1


def test_a_host_whose_frames_are_always_destroyed_is_bus_off(clock: SimulatedClock, medium: Medium) -> None:
    port = medium.open_port()
    port.send(SYNC)
    for attempt in range(32):
        clock.sleep(0.00006)
        assert port.transmit_errors == 8 * attempt
        medium.inject_error_frame()
        if attempt < 31:
            clock.sleep(0.00005)
    with pytest.raises(PortError, match="bus-off") as caught:
        port.receive(0)
    assert caught.value.number == 100
    clock.sleep(0.1)
    assert passed(medium) == []


def test_an_exchange_that_ends_in_bus_off_ends_there(clock: SimulatedClock, medium: Medium) -> None:
    port = medium.open_port(bitrate=250_000)
    port.send(SYNC)
    with clock.transaction():
        while True:
            try:
                port.receive(1.0)
            except PortError:
                break
    assert clock.now_ns() == START_NS + 32 * 23 * BIT_NS - 3 * BIT_NS


def test_bus_off_ends_with_a_new_port(clock: SimulatedClock, medium: Medium) -> None:
    port = medium.open_port()
    medium.bus_off()
    with pytest.raises(PortError, match="bus-off"):
        port.send(SYNC)
    medium.open_port().send(SYNC)
    clock.sleep(0.01)
    assert passed(medium) == [0x080]


def test_a_host_at_another_bit_rate_sees_errors_only_and_goes_bus_off(clock: SimulatedClock, medium: Medium) -> None:
    medium.attach(Periodic(0x185, period_ms=1))
    wrong, right = medium.open_port(bitrate=250_000), medium.open_port()
    clock.sleep(0.0095)
    arrivals = list(iter(lambda: wrong.receive(0), None))
    assert len(arrivals) == 10
    assert all(arrival.error for arrival in arrivals)
    assert not any(arrival.error for arrival in iter(lambda: right.receive(0), None))
    wrong.send(SYNC)
    clock.sleep(0.02)
    with pytest.raises(PortError, match="bus-off"):
        wrong.receive(0)
    assert medium.error_frames == 32
    assert 0x080 not in passed(medium)
    assert passed(medium).count(0x185) == 29  # the others go on


# ---------------------------------------------------------------------- names


def test_devices_share_a_medium_until_the_last_one_gives_it_back(clock: SimulatedClock) -> None:
    first = shared_medium("can7", clock=clock, bitrate=500_000, seed=1)
    second = shared_medium("can7", clock=clock, bitrate=500_000, seed=2)
    assert first is second is medium_named("can7")
    with pytest.raises(ConfigError, match="500000 and 250000"):
        shared_medium("can7", clock=clock, bitrate=250_000, seed=1)
    port: Port = first.open_port()
    forget_medium("can7")
    assert medium_named("can7") is first
    forget_medium("can7", first)
    assert medium_named("can7") is None
    with pytest.raises(PortError, match="closed"):
        port.send(SYNC)
    forget_medium("can7")


def test_two_rigs_with_a_bus_of_the_same_name_do_not_meet() -> None:
    one, other = (shared_medium("can7", clock=SimulatedClock(), bitrate=500_000, seed=1) for _ in range(2))
    assert one is not other
    assert medium_named("can7") is other
    forget_medium("can7", one)
    assert medium_named("can7") is other
    forget_medium("can7", other)
    assert medium_named("can7") is None
