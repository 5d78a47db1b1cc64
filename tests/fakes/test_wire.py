"""The emulated serial line: every byte takes its time, pieces stay in order, and the port behaves as pyserial's."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import pytest
import serial
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.clock import SimulatedClock, Timer
from microdrivers.core.errors import LinkLost
from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.fakes.wire import Reply, Temper, Wire, forget_wire, register_wire, wire_named

DELAY_NS = 2 * NS_PER_MS
BYTE_NS = round(10 * NS_PER_S / 9600)
POLITE = Temper(max_fragments=1)


class Echo:
    """Sends everything back after 2 ms; "T" starts three ticks, 10 ms apart, each of which sends a dot."""

    def __init__(self) -> None:
        self.received: list[tuple[bytes, int, int]] = []
        self.ticks: list[int] = []
        self.ticked: list[int] = []

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        self.received.append((data, start_ns, end_ns))
        if data == b"T":
            self.ticks = [end_ns + n * 10 * NS_PER_MS for n in (1, 2, 3)]
            return ()
        return (Reply(end_ns + DELAY_NS, data),)

    def advance(self, t_ns: int) -> Sequence[Reply]:
        assert self.ticks[0] == t_ns
        self.ticked.append(self.ticks.pop(0))
        return (Reply(t_ns, b"."),)

    def next_event_ns(self) -> int | None:
        return self.ticks[0] if self.ticks else None


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock(start_ns=NS_PER_S)


@pytest.fixture
def wire(clock: SimulatedClock) -> Iterator[Wire]:
    wire = Wire(Echo(), clock=clock, seed=1, baudrate=9600, temper=POLITE)
    register_wire("echo", wire)
    yield wire
    forget_wire("echo", wire)


@pytest.fixture
def port(wire: Wire) -> Iterator[serial.SerialBase]:
    with serial.serial_for_url("fake://echo", timeout=0.5) as port:
        yield port


# ---------------------------------------------------------------------- time on the line


def test_bytes_take_their_time_both_ways(clock: SimulatedClock, wire: Wire) -> None:
    wire.write(b"hello")
    sent_ns = NS_PER_S + 5 * BYTE_NS
    back_ns = sent_ns + DELAY_NS + 5 * BYTE_NS
    assert list(wire.log) == [(sent_ns, "host", b"hello"), (back_ns, "device", b"hello")]
    assert wire.next_arrival_ns() == back_ns
    clock.sleep_until(back_ns - 1)
    assert (wire.waiting(), wire.read(99)) == (0, b"")
    clock.sleep_until(back_ns)
    assert (wire.waiting(), wire.read(2), wire.read(99)) == (5, b"he", b"llo")
    assert wire.next_arrival_ns() is None


def test_a_parity_bit_costs_a_tenth(clock: SimulatedClock) -> None:
    wire = Wire(Echo(), clock=clock, seed=1, baudrate=9600, bits_per_byte=11)
    assert wire.byte_ns == round(11 * NS_PER_S / 9600)


def test_writes_queue_behind_each_other(clock: SimulatedClock, wire: Wire) -> None:
    wire.write(b"first")
    wire.write(b"second")
    echo = wire.emulator
    assert isinstance(echo, Echo)
    (_, _, first_end_ns), (_, second_start_ns, second_end_ns) = echo.received
    assert second_start_ns == first_end_ns
    assert second_end_ns == first_end_ns + 6 * BYTE_NS
    clock.sleep(0.1)
    assert wire.read(99) == b"firstsecond"


@settings(deadline=None, derandomize=True, max_examples=40)
@given(
    messages=st.lists(st.binary(min_size=1, max_size=30), min_size=1, max_size=5),
    seed=st.integers(0, 1000),
    fragments=st.integers(1, 6),
)
def test_fragments_keep_bytes_order_and_time(messages: list[bytes], seed: int, fragments: int) -> None:
    clock = SimulatedClock()
    wire = Wire(Echo(), clock=clock, seed=seed, baudrate=115200, temper=Temper(max_fragments=fragments))
    for message in messages:
        wire.write(b"." + message)
    expected = b"".join(b"." + message for message in messages)
    received = b""
    while (next_ns := wire.next_arrival_ns()) is not None:
        clock.sleep_until(next_ns)
        piece = wire.read(99)
        received += piece
        # The line cannot have carried them faster than its baud rate.
        assert len(received) * wire.byte_ns <= clock.now_ns() - len(messages[0]) * wire.byte_ns - DELAY_NS
    assert received == expected
    sent_back = [entry for entry in wire.log if entry[1] == "device"]
    assert [data for _, _, data in sent_back] == [b"." + message for message in messages]
    assert sent_back[-1][0] == clock.now_ns()


def test_the_emulator_is_woken_for_each_of_its_events(clock: SimulatedClock, wire: Wire) -> None:
    wire.write(b"T")
    echo = wire.emulator
    assert isinstance(echo, Echo)
    due = list(echo.ticks)
    clock.sleep_until(due[1])
    assert echo.ticked == due[:2]
    clock.sleep(1.0)
    assert echo.ticked == due
    assert wire.read(99) == b"..."


def test_an_event_during_an_exchange_is_not_late(clock: SimulatedClock, port: serial.SerialBase) -> None:
    with clock.transaction():
        port.write(b"T")
        assert port.read(3) == b"..."
        assert clock.now_ns() == NS_PER_S + BYTE_NS + 30 * NS_PER_MS + BYTE_NS


class Watchdog:
    """Barks when it has heard nothing for 100 ms."""

    def __init__(self) -> None:
        self.heard_ns: int | None = None
        self.barks: list[int] = []
        self.connections: list[int] = []

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        self.heard_ns = end_ns
        return (Reply(end_ns + DELAY_NS, data),)

    def advance(self, t_ns: int) -> Sequence[Reply]:
        self.heard_ns = None
        self.barks.append(t_ns)
        return (Reply(t_ns, b"!"),)

    def next_event_ns(self) -> int | None:
        return None if self.heard_ns is None else self.heard_ns + 100 * NS_PER_MS


class NetworkWatchdog(Watchdog):
    """One that notices connections."""

    def connected(self, t_ns: int) -> None:
        self.connections.append(t_ns)


class CountingClock(SimulatedClock):
    """Counts what it is asked to call."""

    calls = 0

    def call_at(self, t_ns: int, call: Callable[[], object], *, name: str = "") -> Timer:
        self.calls += 1
        return super().call_at(t_ns, call, name=name)


def test_an_event_that_moves_away_is_not_asked_for_again_and_again() -> None:
    clock = CountingClock(start_ns=NS_PER_S)
    watchdog = Watchdog()
    wire = Wire(watchdog, clock=clock, seed=1, baudrate=9600)
    for _ in range(1000):
        wire.write(b"a")
        clock.sleep(0.01)
    assert clock.calls <= 1 + 1000 * 10 // 90  # one pending call at a time, each lasts until the due time it knew
    last_ns = watchdog.heard_ns
    assert last_ns is not None
    assert watchdog.barks == []
    clock.sleep(1.0)
    assert watchdog.barks == [last_ns + 100 * NS_PER_MS]


def test_events_happen_while_the_cable_is_pulled(clock: SimulatedClock) -> None:
    watchdog = Watchdog()
    wire = Wire(watchdog, clock=clock, seed=1, baudrate=9600)
    wire.wakes_itself = False  # somebody else turns it
    wire.write(b"a")
    wire.unplug()
    clock.sleep(1.0)
    assert watchdog.barks == []
    wire.turn()
    assert len(watchdog.barks) == 1
    wire.plug_in()
    assert wire.waiting() == 0


@pytest.mark.parametrize(("watchdog", "heard"), [(Watchdog(), b"a"), (NetworkWatchdog(), b"")])
def test_only_a_network_forgets_what_is_under_way(clock: SimulatedClock, watchdog: Watchdog, heard: bytes) -> None:
    wire = Wire(watchdog, clock=clock, seed=1, baudrate=9600)
    wire.write(b"a")
    wire.connect()
    clock.sleep(0.05)
    assert wire.read(9) == heard
    assert watchdog.connections == ([NS_PER_S] if isinstance(watchdog, NetworkWatchdog) else [])


def test_the_log_keeps_the_newest_records(clock: SimulatedClock, monkeypatch: pytest.MonkeyPatch) -> None:
    assert Wire(Watchdog(), clock=clock, seed=1, baudrate=9600).log.maxlen == 100_000
    monkeypatch.setattr("microdrivers.fakes.wire.wire.LOG_LENGTH", 10)
    wire = Wire(Watchdog(), clock=clock, seed=1, baudrate=9600)
    for number in range(20):
        wire.write(bytes((number,)))
    assert [(who, data[0]) for _, who, data in wire.log] == [
        (who, n) for n in range(15, 20) for who in ("host", "device")
    ]


# ---------------------------------------------------------------------- the port


def test_read_returns_when_the_bytes_are_there(clock: SimulatedClock, port: serial.SerialBase) -> None:
    with clock.transaction():
        assert port.write(b"abc") == 3
        assert clock.now_ns() == NS_PER_S
        assert port.read(3) == b"abc"
        assert clock.now_ns() == NS_PER_S + DELAY_NS + 6 * BYTE_NS


def test_read_gives_up_after_the_timeout(clock: SimulatedClock, port: serial.SerialBase) -> None:
    port.write(b"ab")
    assert port.read(3) == b"ab"
    assert clock.now_ns() == NS_PER_S + 500 * NS_PER_MS
    port.timeout = 0
    assert port.read(1) == b""
    assert clock.now_ns() == NS_PER_S + 500 * NS_PER_MS


def test_read_until_works_on_top(port: serial.SerialBase) -> None:
    port.write(b"one\ntwo\n")
    assert port.read_until(b"\n") == b"one\n"
    assert port.readline() == b"two\n"


def test_waiting_and_reset(clock: SimulatedClock, port: serial.SerialBase) -> None:
    port.write(b"abc")
    assert port.in_waiting == 0
    clock.sleep(0.1)
    assert port.in_waiting == 3
    port.reset_input_buffer()
    assert port.in_waiting == 0
    port.flush()
    port.reset_output_buffer()


def test_a_port_without_timeout_is_refused(port: serial.SerialBase) -> None:
    port.timeout = None
    with pytest.raises(serial.SerialException, match="time-out"):
        port.read(1)


def test_a_second_open_is_refused(wire: Wire, port: serial.SerialBase) -> None:
    with pytest.raises(serial.SerialException, match="in use"):
        serial.serial_for_url("fake://echo", timeout=0.5)
    with pytest.raises(serial.SerialException, match="already open"):
        port.open()
    port.close()
    port.close()
    with serial.serial_for_url("fake://echo", timeout=0.5) as again:
        assert again.is_open
    assert not wire.in_use


def test_an_unknown_name_is_refused(wire: Wire) -> None:
    assert wire_named("echo") is wire
    forget_wire("echo", wire)
    forget_wire("echo", wire)
    assert wire_named("echo") is None
    with pytest.raises(serial.SerialException, match="no such emulator"):
        serial.serial_for_url("fake://echo", timeout=0.5)


def test_a_closed_port_says_so(port: serial.SerialBase) -> None:
    port.close()
    for use in (lambda: port.read(1), lambda: port.write(b"a"), lambda: port.in_waiting):
        with pytest.raises(serial.PortNotOpenError):
            use()


def test_what_arrived_while_closed_is_gone(clock: SimulatedClock, port: serial.SerialBase) -> None:
    port.write(b"old")
    port.close()
    clock.sleep(0.1)
    port.open()
    port.write(b"new")
    assert port.read(6) == b"new"


# ---------------------------------------------------------------------- the cable


def test_an_unplugged_cable_fails_every_use(wire: Wire, port: serial.SerialBase) -> None:
    port.write(b"lost")
    wire.unplug()
    for use in (lambda: port.read(1), lambda: port.write(b"a"), lambda: port.in_waiting):
        with pytest.raises(serial.SerialException, match="unplugged"):
            use()
    for direct in (lambda: wire.write(b"a"), lambda: wire.read(1), wire.waiting):
        with pytest.raises(LinkLost):
            direct()


def test_plugging_in_again_needs_a_new_open(clock: SimulatedClock, wire: Wire, port: serial.SerialBase) -> None:
    port.write(b"T")
    wire.unplug()
    port.close()
    with pytest.raises(serial.SerialException, match="no such emulator"):
        port.open()
    # The last tick's dot leaves just before the cable is back, and would arrive just after.
    clock.sleep_until(NS_PER_S + BYTE_NS + 30 * NS_PER_MS + BYTE_NS // 2)
    wire.plug_in()
    port.open()
    clock.sleep(0.1)
    assert port.in_waiting == 0
    port.write(b"back")
    assert port.read(4) == b"back"
