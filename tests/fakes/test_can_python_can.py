"""The emulated bus through python-can, on a simulated clock."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator

import can
import pytest

from microdrivers.core.clock import ClockError, SimulatedClock
from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.fakes.can import Medium, forget_medium, frame_bits, shared_medium
from microdrivers.fakes.can.port import TRANSMIT_QUEUE
from microdrivers.fakes.can.python_can import MediumBus
from tests.fakes.can_bench import BIT_NS, REPLY_NS, SDO_REPLY, SDO_REQUEST, Answering, Periodic

CHANNEL = "socketcan:can0"
START_NS = NS_PER_S
SYNC = can.Message(arbitration_id=0x080, is_extended_id=False)
REQUEST = can.Message(arbitration_id=SDO_REQUEST.id, data=SDO_REQUEST.data, is_extended_id=False)


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock(start_ns=START_NS)


@pytest.fixture
def medium(clock: SimulatedClock) -> Iterator[Medium]:
    medium = shared_medium(CHANNEL, clock=clock, bitrate=500_000, seed=1)
    yield medium
    forget_medium(CHANNEL, medium)


@pytest.fixture
def bus(medium: Medium) -> Iterator[MediumBus]:
    with can.Bus(interface="microdrivers", channel=CHANNEL, bitrate=500_000, fd=True) as bus:
        assert isinstance(bus, MediumBus)
        yield bus


def test_an_exchange_with_a_node(clock: SimulatedClock, medium: Medium, bus: MediumBus) -> None:
    medium.attach(Answering({SDO_REQUEST: SDO_REPLY}))
    with clock.transaction():
        bus.send(REQUEST)
        reply = bus.recv(0.3)
    assert reply is not None
    assert (reply.arbitration_id, bytes(reply.data), reply.dlc) == (SDO_REPLY.id, SDO_REPLY.data, 8)
    assert (reply.is_extended_id, reply.is_error_frame, reply.is_rx) == (False, False, True)
    end_ns = START_NS + (frame_bits(SDO_REQUEST) + frame_bits(SDO_REPLY)) * BIT_NS + REPLY_NS
    assert round(reply.timestamp * 1e9) == end_ns
    assert end_ns <= clock.now_ns() <= end_ns + 50_000


def test_time_outs_pass_on_the_clock_alone(clock: SimulatedClock, bus: MediumBus) -> None:
    assert bus.recv(3600) is None
    assert clock.now_ns() == START_NS + 3600 * NS_PER_S
    with pytest.raises(ClockError, match="time-out"):
        bus.recv()


def test_two_buses_hear_each_other(medium: Medium, bus: MediumBus) -> None:
    sent = can.Message(arbitration_id=0x18DAF110, data=b"\x01\x02")
    remote = can.Message(arbitration_id=0x705, is_remote_frame=True, dlc=1, is_extended_id=False)
    with can.Bus(interface="microdrivers", channel=CHANNEL) as other:
        bus.send(sent)
        bus.send(remote)
        for message in (sent, remote):
            received = other.recv(0.1)
            assert received is not None
            assert received.equals(message, timestamp_delta=None, check_channel=False, check_direction=False)
        assert bus.recv(0.1) is None


def test_own_messages(medium: Medium) -> None:
    with can.Bus(interface="microdrivers", channel=CHANNEL, receive_own_messages=True) as bus:
        bus.send(SYNC)
        own = bus.recv(0.1)
    assert own is not None
    assert (own.arbitration_id, own.is_rx) == (0x080, False)


def test_arrivals_are_told_without_a_thread(clock: SimulatedClock, medium: Medium, bus: MediumBus) -> None:
    medium.attach(Periodic(0x185))
    stamps_s: list[float] = []

    def read() -> None:
        while (message := bus.recv(0)) is not None:
            assert clock.now_ns() - message.timestamp * 1e9 <= 50_001
            stamps_s.append(message.timestamp)

    bus.on_arrival(read)
    clock.sleep(1.0)
    assert len(stamps_s) == 1 + 99


def test_a_host_in_the_same_process_needs_no_messages(clock: SimulatedClock, medium: Medium, bus: MediumBus) -> None:
    """All kinds of frames at their time, with SocketCAN's flags; in an exchange, to whoever waits for them."""
    node = Answering({SDO_REQUEST: SDO_REPLY})
    medium.attach(node)
    taken: list[tuple[int, int, bytes, int]] = []
    bus.deliver_to(lambda *arrival: taken.append((clock.now_ns(), *arrival)), lambda _: None)
    with can.Bus(interface="microdrivers", channel=CHANNEL) as other:
        other.send(can.Message(arbitration_id=0x12345, data=b"\x01"))
        other.send(can.Message(arbitration_id=0x705, is_remote_frame=True, dlc=2, is_extended_id=False))
        clock.sleep(0.001)
        medium.inject_error_frame()
        clock.sleep(0.001)
    assert [(identifier, data) for _, identifier, data, _ in taken] == [
        (0x80012345, b"\x01"), (0x40000705, bytes(2)), (0x20000008, bytes(8)),
    ]  # fmt: skip
    taken.clear()
    with clock.transaction():
        bus.send_data(SDO_REQUEST.id, SDO_REQUEST.data)
        bus.receive_until(lambda: bool(taken), clock.now_ns() + NS_PER_S)
    assert node.heard[-1][1] == SDO_REQUEST
    (now_ns, identifier, data, end_ns) = taken[0]
    assert (identifier, data) == (SDO_REPLY.id, SDO_REPLY.data)
    assert end_ns <= now_ns <= end_ns + 50_000
    begun_ns = clock.now_ns()
    with clock.transaction():
        bus.receive_until(lambda: False, begun_ns + NS_PER_MS)
    assert (clock.now_ns(), len(taken)) == (begun_ns + NS_PER_MS, 1)


def test_what_has_arrived_before_is_handed_over_too(clock: SimulatedClock, medium: Medium, bus: MediumBus) -> None:
    medium.attach(Periodic(0x185))
    clock.sleep(0.025)
    taken: list[int] = []
    bus.deliver_to(lambda identifier, _data, _t_ns: taken.append(identifier), lambda _: None)
    clock.sleep(0.001)
    assert taken == [0x705, 0x185, 0x185]


def test_a_host_without_messages_is_told_of_a_loss(clock: SimulatedClock, medium: Medium, bus: MediumBus) -> None:
    lost: list[tuple[int, int | None]] = []
    bus.deliver_to(lambda *_: None, lambda error: lost.append((clock.now_ns(), error.error_code)))
    clock.call_at(START_NS + NS_PER_MS, medium.bus_off)
    clock.sleep(0.1)
    assert lost == [(START_NS + NS_PER_MS, 100)]
    with pytest.raises(can.CanOperationError, match="bus-off"):
        bus.send_data(0x100, b"")
    with pytest.raises(can.CanOperationError, match="bus-off"), clock.transaction():
        bus.receive_until(lambda: False, START_NS + NS_PER_S)


def test_filters_are_the_ports(clock: SimulatedClock, medium: Medium, bus: MediumBus) -> None:
    medium.attach(Periodic(0x185))
    bus.set_filters([{"can_id": 0x700, "can_mask": 0x780}])
    told: list[int] = []
    bus.on_arrival(lambda: told.append(clock.now_ns()))
    clock.sleep(0.1)
    assert len(told) == 1
    boot_up = bus.recv(0)
    assert boot_up is not None
    assert boot_up.arbitration_id == 0x705
    assert bus.recv(0) is None


def test_error_frames_are_messages(clock: SimulatedClock, medium: Medium, bus: MediumBus) -> None:
    medium.inject_error_frame()
    message = bus.recv(0.1)
    assert message is not None
    assert (message.is_error_frame, message.arbitration_id, message.dlc) == (True, 0x008, 8)


@pytest.mark.parametrize(
    ("break_it", "number"),
    [(Medium.unplug, 19), (Medium.bus_off, 100), (Medium.close, 9)],
    ids=["ENODEV", "ENETDOWN", "EBADF"],
)
def test_a_bus_that_is_gone_raises(
    medium: Medium, bus: MediumBus, break_it: Callable[[Medium], None], number: int
) -> None:
    break_it(medium)
    for attempt in (lambda: bus.send(SYNC), lambda: bus.recv(0.1), lambda: bus.recv(0)):
        with pytest.raises(can.CanOperationError) as caught:
            attempt()
        assert caught.value.error_code == number


def test_a_loss_is_told(clock: SimulatedClock, medium: Medium, bus: MediumBus) -> None:
    told: list[int] = []
    bus.on_arrival(lambda: told.append(clock.now_ns()))
    clock.call_at(START_NS + NS_PER_MS, medium.bus_off)
    clock.sleep(0.1)
    assert told == [START_NS + NS_PER_MS]


def test_a_bus_that_is_not_there_cannot_be_opened(medium: Medium) -> None:
    with pytest.raises(can.CanInitializationError, match="no emulated CAN bus 'can9'"):
        can.Bus(interface="microdrivers", channel="can9")
    medium.unplug()
    with pytest.raises(can.CanInitializationError, match="unplugged"):
        can.Bus(interface="microdrivers", channel=CHANNEL)


def test_after_shutdown_the_bus_is_closed(bus: MediumBus) -> None:
    bus.shutdown()
    bus.shutdown()
    with pytest.raises(can.CanOperationError, match="closed"):
        bus.send(SYNC)


@pytest.mark.parametrize(
    "message",
    [
        can.Message(arbitration_id=0x100, is_fd=True),
        can.Message(arbitration_id=0x100, is_error_frame=True),
        can.Message(arbitration_id=0x800, is_extended_id=False),
        can.Message(arbitration_id=0x100, data=bytes(9)),
    ],
)
def test_what_classic_can_does_not_carry_is_refused(bus: MediumBus, message: can.Message) -> None:
    with pytest.raises(can.CanOperationError) as caught:
        bus.send(message)
    assert caught.value.error_code == 22


def test_a_full_queue_is_refused(bus: MediumBus) -> None:
    for _ in range(TRANSMIT_QUEUE):
        bus.send(SYNC)
    with pytest.raises(can.CanOperationError, match="queue") as caught:
        bus.send(SYNC)
    assert caught.value.error_code == 105


def test_another_bit_rate_is_noticed(clock: SimulatedClock, medium: Medium) -> None:
    with can.Bus(interface="microdrivers", channel=CHANNEL, bitrate=250_000) as bus:
        bus.send(SYNC)
        for _ in range(31):
            message = bus.recv(0.1)
            assert message is not None
            assert message.is_error_frame
        with pytest.raises(can.CanOperationError, match="bus-off"):
            bus.recv(0.1)


def test_threads_for_periodic_messages_are_refused_on_a_simulated_clock(bus: MediumBus) -> None:
    with pytest.raises(can.CanOperationError, match="periodic call"):
        bus.send_periodic(SYNC, 0.1)


def test_no_python_can_without_need() -> None:
    code = "import sys, microdrivers.fakes.can; sys.exit('can' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
