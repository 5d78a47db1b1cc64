"""The emulated CAN bus on a simulated clock: who sends when, and what arrives where."""

from __future__ import annotations

import itertools
from collections.abc import Container, Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.clock import ClockError, SimulatedClock
from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.fakes.can import Arrival, Due, Frame, Medium, Temper, frame_bits
from microdrivers.fakes.can.timeline import BusTimeline
from tests.fakes.can_bench import BIT_NS, REPLY_NS, SDO_REPLY, SDO_REQUEST, Answering, Listener, Periodic

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


def bits_ns(frame: Frame) -> int:
    return frame_bits(frame) * BIT_NS


def passed(medium: Medium) -> list[int]:
    return [frame.id for _, who, frame in medium.log if who != "error"]


# ---------------------------------------------------------------------- times and arbitration


def test_a_frame_takes_its_bits_and_arrives_at_all_others(clock: SimulatedClock, medium: Medium) -> None:
    node, sender, other = Listener(), medium.open_port(), medium.open_port()
    medium.attach(node)
    sender.send(SYNC)
    end_ns = START_NS + SYNC_BITS * BIT_NS
    clock.sleep_until(end_ns - 1)
    assert (other.receive(0), node.heard) == (None, [])
    clock.sleep_until(end_ns)
    assert node.heard == [(end_ns, SYNC)]
    assert other.receive(0) == Arrival(end_ns, SYNC)
    assert sender.receive(0) is None
    assert list(medium.log) == [(end_ns, "host", SYNC)]


def test_the_next_frame_starts_three_bits_later(clock: SimulatedClock, medium: Medium) -> None:
    port = medium.open_port()
    port.send(SYNC)
    port.send(SYNC)
    clock.sleep(0.01)
    first_ns = START_NS + SYNC_BITS * BIT_NS
    assert [t_ns for t_ns, _, _ in medium.log] == [first_ns, first_ns + (3 + SYNC_BITS) * BIT_NS]


def test_the_lowest_identifier_wins_among_those_who_begin_together(clock: SimulatedClock, medium: Medium) -> None:
    for identifier in (0x300, 0x700, 0x081, 0x080):
        medium.open_port().send(Frame(identifier))
    medium.open_port().send(Frame(0x080 << 18, extended=True))
    clock.sleep(0.01)
    assert passed(medium) == [0x080, 0x080 << 18, 0x081, 0x300, 0x700]


def test_those_who_wait_for_a_busy_bus_compete_by_identifier(clock: SimulatedClock, medium: Medium) -> None:
    ports = [medium.open_port() for _ in range(4)]
    ports[0].send(Frame(0x7FF, bytes(8)))
    for number, identifier in enumerate((0x400, 0x200, 0x300), start=1):
        clock.sleep(0.00001)
        ports[number].send(Frame(identifier))
    clock.sleep(0.01)
    assert passed(medium) == [0x7FF, 0x200, 0x300, 0x400]


def test_a_frame_that_comes_in_the_interframe_space_is_too_late_for_it(clock: SimulatedClock, medium: Medium) -> None:
    ports = [medium.open_port() for _ in range(3)]
    ports[0].send(SYNC)
    clock.sleep(0.00001)
    ports[1].send(Frame(0x400))
    clock.sleep_until(START_NS + (SYNC_BITS + 1) * BIT_NS)
    ports[2].send(Frame(0x100))
    clock.sleep(0.01)
    assert passed(medium) == [0x080, 0x400, 0x100]


def test_a_hosts_frames_keep_their_order(clock: SimulatedClock, medium: Medium) -> None:
    port, other = medium.open_port(), medium.open_port()
    for identifier in (0x205, 0x080, 0x605):
        port.send(Frame(identifier))
    other.send(Frame(0x100))
    clock.sleep(0.01)
    assert passed(medium) == [0x100, 0x205, 0x080, 0x605]


def test_a_node_answers_when_it_is_ready(clock: SimulatedClock, medium: Medium) -> None:
    medium.attach(Answering({SDO_REQUEST: SDO_REPLY}))
    port = medium.open_port()
    port.send(SDO_REQUEST)
    reply = port.receive(0.1)
    end_ns = START_NS + bits_ns(SDO_REQUEST) + REPLY_NS + bits_ns(SDO_REPLY)
    assert reply == Arrival(end_ns, SDO_REPLY)
    assert clock.now_ns() == end_ns


def test_nodes_hear_each_other_and_their_own_events_come_in_time(clock: SimulatedClock, medium: Medium) -> None:
    periodic, listener = Periodic(0x185), Listener()
    medium.attach(listener)
    medium.attach(periodic)
    clock.sleep(0.035)
    assert [frame.id for _, frame in listener.heard] == [0x705, 0x185, 0x185, 0x185]
    assert periodic.advanced == [START_NS + n * 10 * NS_PER_MS for n in range(4)]
    assert periodic.heard == []


@settings(deadline=None, max_examples=40)
@given(
    st.lists(
        st.tuples(st.integers(0, 2), st.integers(0, 3_000_000), st.integers(0, 0x7FF), st.binary(max_size=8)),
        max_size=40,
    )
)
def test_frames_never_overlap_and_none_is_lost(sends: list[tuple[int, int, int, bytes]]) -> None:
    clock = SimulatedClock()
    medium = Medium("any", clock=clock, bitrate=500_000, seed=0)
    ports = [medium.open_port() for _ in range(3)]
    listener = medium.open_port()
    medium.attach(Periodic(0x190, period_ms=0.7))
    for number, t_ns, identifier, data in sends:
        frame = Frame(identifier, data)
        clock.call_at(t_ns, lambda number=number, frame=frame: ports[number].send(frame))
    clock.sleep(0.1)
    for (before_ns, _, _), (end_ns, _, frame) in itertools.pairwise(medium.log):
        assert end_ns - bits_ns(frame) >= before_ns + 3 * BIT_NS
    for number in range(3):
        own = sorted((t_ns, index) for index, (each, t_ns, _, _) in enumerate(sends) if each == number)
        wanted = [Frame(*sends[index][2:]) for _, index in own]
        others = {Frame(*sends[index][2:]) for index, send in enumerate(sends) if send[0] != number}
        mine = [frame for _, who, frame in medium.log if who == "host" and frame not in others]
        assert mine == [frame for frame in wanted if frame not in others]
    heard = []
    while (arrival := listener.receive(0)) is not None:
        heard.append((arrival.t_ns, arrival.frame))
    assert heard == [(t_ns, frame) for t_ns, _, frame in medium.log]
    assert sum(who == "host" for _, who, _ in medium.log) == len(sends)


# ---------------------------------------------------------------------- the simulated clock


def run_rig(seed: int) -> list[tuple[int, Frame]]:
    clock = SimulatedClock()
    medium = Medium("can0", clock=clock, bitrate=500_000, seed=seed)
    medium.attach(Periodic(0x185, period_ms=1))
    port, got = medium.open_port(), []

    def read() -> None:
        while (arrival := port.receive(0)) is not None:
            got.append((clock.now_ns(), arrival.frame))

    port.on_arrival(read)
    clock.sleep(0.05)
    return got


def test_the_same_seed_gives_the_same_bits() -> None:
    assert run_rig(1) == run_rig(1)
    assert run_rig(1) != run_rig(2)  # the host reads at other times
    assert [frame for _, frame in run_rig(1)] == [frame for _, frame in run_rig(2)]


class StepwiseClock(SimulatedClock):
    """Lets nobody work ahead: each event is a call of its own."""

    def free_until_ns(self) -> int:
        return self._global_ns

    def go_on_at(self, t_ns: int) -> bool:
        return False


@settings(deadline=None, max_examples=40)
@given(
    st.lists(st.tuples(st.integers(0, 2), st.integers(0, 2_000_000), st.integers(0, 0x7FF)), max_size=25),
    st.lists(st.integers(0, 2_000_000), max_size=4),
    st.integers(0, 9),
)
def test_working_ahead_changes_nothing(sends: list[tuple[int, int, int]], errors: list[int], seed: int) -> None:
    """Hosts that answer what they hear, nodes with events of their own, error frames: all as in single steps."""

    def run(clock: SimulatedClock) -> tuple[list[object], list[tuple[int, int, Frame]]]:
        medium = Medium("any", clock=clock, bitrate=500_000, seed=seed)
        ports = [medium.open_port() for _ in range(3)]
        told: list[tuple[int, int, Frame]] = []
        medium.attach(Periodic(0x190, period_ms=0.7))
        medium.attach(Answering({SDO_REQUEST: SDO_REPLY}))

        def hear(identifier: int, data: bytes, t_ns: int) -> None:
            told.append((clock.now_ns(), t_ns, Frame(identifier, data)))
            if identifier % 5 == 0:
                ports[0].send(SDO_REQUEST)
            if identifier % 7 == 0:
                clock.call_at(clock.now_ns() + 10_000, lambda: ports[0].send(Frame(0x001)))
            if identifier % 11 == 0 and not clock.in_transaction:
                with clock.transaction():
                    ports[0].receive_until(lambda: False, clock.now_ns() + 300_000)

        ports[0].deliver_to(hear, lambda _: None)
        ports[1].on_arrival(lambda: told.append((clock.now_ns(), -1, SYNC)))
        for number, t_ns, identifier in sends:
            frame = Frame(identifier, bytes(number))
            clock.call_at(t_ns, lambda number=number, frame=frame: ports[number].send(frame))
        for t_ns in errors:
            clock.call_at(t_ns, medium.inject_error_frame)
        clock.sleep(0.001)
        told.append((clock.now_ns(), len(medium.log), SYNC))
        clock.sleep(0.02)
        return list(medium.log), told

    assert run(SimulatedClock()) == run(StepwiseClock())


def test_nodes_get_what_they_listen_to_and_keep_their_own_times(clock: SimulatedClock, medium: Medium) -> None:
    class Choosy(Periodic):
        listens_to: Container[int] = frozenset({0x100})

        def receive(self, frame: Frame, t_ns: int) -> Sequence[Due]:
            self.listens_to = frozenset({0x100, 0x200})
            return super().receive(frame, t_ns)

    node, port = Choosy(0x185, period_ms=1), medium.open_port()
    medium.attach(node)
    for identifier in (0x200, 0x300, 0x100, 0x200, 0x300):
        port.send(Frame(identifier))
        clock.sleep(0.0005)
    clock.sleep(0.01)
    assert [frame.id for _, frame in node.heard] == [0x100, 0x200]
    assert node.advanced == [START_NS + n * NS_PER_MS for n in range(13)]


def test_a_node_may_have_a_frame_ready_at_the_very_end_of_another(clock: SimulatedClock, medium: Medium) -> None:
    class Punctual(Listener):
        listens_to: Container[int] = ()
        due_ns: int | None = START_NS + NS_PER_MS + SYNC_BITS * BIT_NS

        def receive(self, frame: Frame, t_ns: int) -> Sequence[Due]:
            return self.advance(t_ns)

        def advance(self, t_ns: int) -> Sequence[Due]:
            if t_ns != self.due_ns:
                return ()
            self.due_ns = None
            return (Due(t_ns, Frame(0x100)),)

        def next_event_ns(self) -> int | None:
            return self.due_ns

    port, other = medium.open_port(), medium.open_port()
    medium.attach(Punctual())
    port.send(SYNC)
    clock.sleep(0.001)
    port.send(SYNC)
    other.send(Frame(0x400))
    clock.sleep(0.01)
    assert passed(medium) == [0x080, 0x080, 0x100, 0x400]


def test_a_frame_can_be_read_soon_after_it_has_arrived(clock: SimulatedClock) -> None:
    medium = Medium("can0", clock=clock, bitrate=500_000, seed=1)
    port = medium.open_port()
    medium.attach(Periodic(0x185, period_ms=1))
    delays_ns = []
    while (arrival := port.receive(0.002)) is not None and len(delays_ns) < 100:
        delays_ns.append(clock.now_ns() - arrival.t_ns)
    assert 0 <= min(delays_ns) < 10_000
    assert 40_000 < max(delays_ns) <= 50_000


def test_an_exchange_dispatches_nothing_and_what_arrives_meanwhile_waits(clock: SimulatedClock, medium: Medium) -> None:
    medium.attach(Answering({SDO_REQUEST: SDO_REPLY}))
    medium.attach(Periodic(0x185, period_ms=0.25))
    port, listener = medium.open_port(), medium.open_port()
    seen: list[tuple[int, int]] = []

    def read() -> None:
        while (arrival := listener.receive(0)) is not None:
            seen.append((clock.now_ns(), arrival.t_ns))

    listener.on_arrival(read)
    clock.sleep(0.0001)
    with clock.transaction():
        port.send(SDO_REQUEST)
        while (reply := port.receive(0.01)) is not None and reply.frame != SDO_REPLY:
            pass
        assert reply is not None
        assert clock.now_ns() == reply.t_ns
        assert seen == []
    assert len(seen) > 2
    assert all(now_ns == t_ns for now_ns, t_ns in seen)


def test_a_frame_from_before_what_was_played_goes_out_when_the_bus_is_free(
    clock: SimulatedClock, medium: Medium
) -> None:
    medium.attach(Answering({SDO_REQUEST: SDO_REPLY}))
    node = Listener()
    medium.attach(node)
    port, other = medium.open_port(), medium.open_port()
    clock.call_at(START_NS + 1000, lambda: other.send(SYNC))
    clock.call_at(START_NS + 2 * NS_PER_MS, lambda: other.send(SYNC))
    with clock.transaction():
        port.send(SDO_REQUEST)
        assert port.receive(0.01) is not None
        assert port.receive(0.01) is None  # nobody answers: 10 ms pass on an idle bus
    clock.sleep(0.1)
    reply_ns = next(t_ns for t_ns, _, frame in medium.log if frame == SDO_REPLY)
    first_ns = reply_ns + (3 + SYNC_BITS) * BIT_NS
    assert [t_ns for t_ns, _, frame in medium.log if frame == SYNC] == [
        first_ns,
        START_NS + 2 * NS_PER_MS + SYNC_BITS * BIT_NS,
    ]
    times_ns = [t_ns for t_ns, _ in node.heard]
    assert times_ns == sorted(times_ns)


def test_times_never_run_backwards_for_a_node(clock: SimulatedClock, medium: Medium) -> None:
    times_ns: list[int] = []

    class Ticking(Listener):
        def receive(self, frame: Frame, t_ns: int) -> Sequence[Due]:
            times_ns.append(t_ns)
            return ()

        def advance(self, t_ns: int) -> Sequence[Due]:
            times_ns.append(t_ns)
            return ()

        def next_event_ns(self) -> int:
            return times_ns[-1] + NS_PER_MS

    port = medium.open_port()
    medium.attach(Ticking())
    clock.call_at(START_NS + 2 * NS_PER_MS + 1, lambda: port.send(SYNC))
    with clock.transaction():
        assert port.receive(0.0055) is None
    clock.sleep(0.001)
    heard_ns = START_NS + 5 * NS_PER_MS + SYNC_BITS * BIT_NS
    assert times_ns == [*(START_NS + n * NS_PER_MS for n in range(6)), heard_ns, heard_ns + NS_PER_MS]


def test_who_looks_again_when_told_of_a_frame_changes_nothing() -> None:
    listener = Listener()

    def look(*_: object) -> None:
        timeline.play(NS_PER_S)

    timeline = BusTimeline(bitrate=500_000, on_passed=look)
    timeline.attach(listener, 0)
    for identifier in (1, 2, 3):
        timeline.offer(None, Frame(identifier), 0)
    timeline.play(NS_PER_S)
    assert [frame.id for _, frame in listener.heard] == [1, 2, 3]


def test_waiting_outside_an_exchange_lets_others_send(clock: SimulatedClock, medium: Medium) -> None:
    medium.attach(Answering({SYNC: Frame(0x185)}))
    port, other = medium.open_port(), medium.open_port()
    clock.every(0.01, lambda: other.send(SYNC), start_ns=START_NS + 5 * NS_PER_MS)
    port.set_filters([(0x185, 0x7FF, None)])
    arrival = port.receive(1.0)
    assert arrival is not None
    assert arrival.frame.id == 0x185
    assert clock.now_ns() == arrival.t_ns < START_NS + 6 * NS_PER_MS


@pytest.mark.parametrize("exchange", [True, False])
def test_waiting_ends_at_the_deadline(clock: SimulatedClock, medium: Medium, exchange: bool) -> None:
    port = medium.open_port()
    if exchange:
        with clock.transaction():
            assert port.receive(0.3) is None
    else:
        assert port.receive(0.3) is None
    assert clock.now_ns() == START_NS + 300 * NS_PER_MS


def test_waiting_for_ever_is_refused_on_a_simulated_clock(medium: Medium) -> None:
    with pytest.raises(ClockError, match="time-out"):
        medium.open_port().receive(None)


def test_arrivals_are_told_at_their_time(clock: SimulatedClock, medium: Medium) -> None:
    port, sender = medium.open_port(), medium.open_port()
    told: list[tuple[int, Arrival | None]] = []
    port.on_arrival(lambda: told.append((clock.now_ns(), port.receive(0))))
    sender.send(SYNC)
    clock.sleep(0.01)
    end_ns = START_NS + SYNC_BITS * BIT_NS
    assert told == [(end_ns, Arrival(end_ns, SYNC))]
    with clock.transaction():
        sender.send(SYNC)
        assert port.receive(0.01) is not None
    clock.sleep(0.01)
    assert len(told) == 1  # it had been read
    port.on_arrival(None)
    sender.send(SYNC)
    clock.sleep(0.01)
    assert len(told) == 1


def test_what_an_exchange_no_longer_waits_for_is_told_later(clock: SimulatedClock) -> None:
    medium = Medium("can0", clock=clock, bitrate=500_000, seed=1)
    port, sender = medium.open_port(), medium.open_port()
    told: list[Arrival | None] = []
    port.on_arrival(lambda: told.append(port.receive(0)))
    end_ns = START_NS + SYNC_BITS * BIT_NS
    with clock.transaction():
        sender.send(SYNC)
        assert port.receive((end_ns - START_NS) / NS_PER_S) is None  # on the bus, but not readable yet
        assert clock.now_ns() == end_ns
    clock.sleep(0.01)
    assert told == [Arrival(end_ns, SYNC)]
