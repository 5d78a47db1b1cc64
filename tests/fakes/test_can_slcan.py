"""The serial CAN adapter's protocol, on a simulated clock."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.clock import SimulatedClock
from microdrivers.core.units import NS_PER_S
from microdrivers.fakes.can import Frame, Medium, SlcanAdapter, frame_bits
from microdrivers.fakes.can.port import TRANSMIT_QUEUE
from microdrivers.fakes.can.slcan import RECEIVE_QUEUE
from microdrivers.fakes.wire import Temper, Wire
from tests.fakes.can_bench import BIT_NS, SDO_REPLY, SDO_REQUEST, Answering, Listener, Periodic

START_NS = NS_PER_S
BAUDRATE = 115_200

# The session of python-can 4.6 with an adapter that was recorded for the protocol sheet; node 5 answers.
RECORDED = [
    (b"C\r", b"\r"),
    (b"S6\r", b"\r"),
    (b"\r", b"\a"),
    (b"O\r", b"\r"),
    (b"O\r", b"\r"),
    (b"t60584000100000000000\r", b"z\rt58584300100092010200\r"),
    (b"V\r", b"V1013\r"),
    (b"C\r", b"\r"),
]


class Bench:
    """An adapter at the end of a polite serial line."""

    def __init__(self, *, baudrate: int = BAUDRATE) -> None:
        self.clock = SimulatedClock(start_ns=START_NS)
        self.medium = Medium("can0", clock=self.clock, bitrate=500_000, seed=1)
        byte_ns = round(10 * NS_PER_S / baudrate)
        self.adapter = SlcanAdapter(self.medium, byte_ns=byte_ns)
        self.wire = Wire(self.adapter, clock=self.clock, seed=1, baudrate=baudrate, temper=Temper(max_fragments=1))

    def say(self, data: bytes, *, wait_s: float = 0.02) -> bytes:
        self.wire.write(data)
        self.clock.sleep(wait_s)
        return self.wire.read(100_000)

    def open(self) -> None:
        assert self.say(b"S6\rO\r") == b"\r\r"


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_the_recorded_session(bench: Bench) -> None:
    bench.medium.attach(Answering({SDO_REQUEST: SDO_REPLY}))
    assert [(asked, bench.say(asked)) for asked, _ in RECORDED] == RECORDED


def test_bytes_and_frames_take_their_time(bench: Bench) -> None:
    node = Listener()
    bench.medium.attach(node)
    bench.open()
    start_ns = bench.clock.now_ns()
    bench.say(b"t0800\r")
    assert node.heard == [(start_ns + 6 * bench.wire.byte_ns + frame_bits(Frame(0x080)) * BIT_NS, Frame(0x080))]


@pytest.mark.parametrize(
    ("line", "frame"),
    [
        (b"t1232A5FF", Frame(0x123, b"\xa5\xff")),
        (b"t7ff0", Frame(0x7FF)),
        (b"T18DAF1101aB", Frame(0x18DAF110, b"\xab", extended=True)),
        (b"r7051", Frame(0x705, bytes(1), remote=True)),
        (b"R000007058", Frame(0x705, bytes(8), extended=True, remote=True)),
    ],
)
def test_frames_both_ways(bench: Bench, line: bytes, frame: Frame) -> None:
    node = Listener()
    bench.medium.attach(node)
    bench.open()
    assert bench.say(line + b"\r") == (b"Z\r" if frame.extended else b"z\r")
    assert [heard for _, heard in node.heard] == [frame]
    bench.medium.open_port().send(frame)
    bench.clock.sleep(0.02)
    assert bench.wire.read(100) == line[:1] + line[1:].upper() + b"\r"


@pytest.mark.parametrize(
    "line",
    [
        b"t", b"t1", b"t1239", b"t1231", b"t12310", b"t123100FF", b"t1231G0", b"t8000", b"t 120", b"t+120", b"t1_30",
        b"T200000000", b"T123000", b"r70511", b"x", b"S9", b"S", b"S66", b"OO", b"V1", b"Z1", b"\xff", b"t" * 200,
        b"S5",  # only while closed
    ],
)  # fmt: skip
def test_what_is_wrong_is_answered_by_a_bell(bench: Bench, line: bytes) -> None:
    bench.open()
    assert bench.say(line + b"\r") == b"\a"
    assert bench.say(b"t1230\r") == b"z\r"
    assert bench.medium.log[-1][2] == Frame(0x123)
    assert len(bench.medium.log) == 1


@pytest.mark.parametrize("line", [b"t1230", b"T000001230", b"r1230", b"F", b"O"])
def test_a_closed_channel_and_one_without_a_bit_rate_ring_the_bell(bench: Bench, line: bytes) -> None:
    assert bench.say(line + b"\r") == b"\a"
    assert not bench.medium.log


def test_what_has_arrived_goes_out_before_an_answer(bench: Bench) -> None:
    bench.open()
    bench.medium.open_port().send(Frame(0x080))
    bench.clock.sleep(0.001)
    now_ns = bench.clock.now_ns()
    replies = bench.adapter.receive(b"V\r", now_ns, now_ns + 1000)
    assert [reply.data for reply in replies] == [b"t0800\r", b"V1013\r"]


def test_after_close_nothing_comes(bench: Bench) -> None:
    bench.open()
    bench.medium.attach(Periodic(0x185))
    assert bench.say(b"N\r") == b"NA123\rt705100\rt185401000000\r"
    bench.say(b"C\r")
    assert bench.say(b"t1230\r") == b"\a"
    bench.clock.sleep(0.1)
    assert bench.wire.read(1000) == b""
    assert bench.say(b"O\r", wait_s=0.001) == b"\r"  # the bit rate is still set


def test_listen_only(bench: Bench) -> None:
    bench.medium.attach(Periodic(0x185))
    assert bench.say(b"S6\rL\r", wait_s=0.015).startswith(b"\r\r")
    assert bench.say(b"t1230\r", wait_s=0.03).startswith(b"\a")
    assert b"t1854" in bench.say(b"F\r")
    assert {frame.id for _, _, frame in bench.medium.log} == {0x705, 0x185}


def test_pieces_of_a_line_are_put_together(bench: Bench) -> None:
    bench.open()
    assert [bench.say(piece) for piece in (b"t12", b"3", b"0\rt12", b"40\r")] == [b"", b"", b"z\r", b"z\r"]


def test_a_serial_line_that_is_too_slow_loses_frames_and_says_so() -> None:
    bench = Bench(baudrate=9600)
    bench.open()
    bench.medium.attach(Periodic(0x185, period_ms=1))
    bench.clock.sleep(1.0)
    assert bench.wire.read(100_000).count(b"t1854") == pytest.approx(960 / 14, abs=2)
    taken = 960 / 14
    assert bench.adapter.lost_frames == pytest.approx(1000 - taken - RECEIVE_QUEUE, abs=5)
    assert bench.say(b"F\r", wait_s=1.0).count(b"F01\r") == 1


def test_a_host_that_takes_nothing_loses_whole_frames(bench: Bench) -> None:
    bench.open()
    bench.adapter.held_up = lambda: True
    bench.medium.attach(Periodic(0x185))
    bench.clock.sleep(0.105)
    assert bench.wire.read(1000) == b""
    bench.adapter.held_up = lambda: False
    assert bench.say(b"F\r", wait_s=0.001) == b"F01\r"
    assert bench.adapter.lost_frames == 11


def test_a_full_transmit_queue_rings_the_bell_and_says_so() -> None:
    bench = Bench(baudrate=3_000_000)
    bench.open()
    answers = bench.say(b"t7FF8FFFFFFFFFFFFFFFF\r" * 300, wait_s=0.1)
    assert answers[: 2 * TRANSMIT_QUEUE] == b"z\r" * TRANSMIT_QUEUE
    assert answers.count(b"\a") > 100
    assert bench.say(b"F\r") == b"F02\r"
    assert bench.say(b"F\r") == b"F00\r"
    assert answers.count(b"z") == len(bench.medium.log)


def test_bus_errors_are_flags(bench: Bench) -> None:
    bench.open()
    bench.medium.inject_error_frame()
    bench.clock.sleep(0.001)
    assert bench.say(b"F\r") == b"F80\r"
    bench.medium.bus_off()
    assert bench.say(b"t1230\r") == b"\a"
    assert bench.say(b"F\r") == b"F80\r"
    assert bench.say(b"C\rO\rt1230\r") == b"\r\rz\r"


def test_a_wrong_bit_rate_ends_in_bus_off(bench: Bench) -> None:
    assert bench.say(b"S5\rO\rt1230\r") == b"\r\rz\r"
    assert bench.say(b"t1230\r") == b"\a"
    assert bench.medium.error_frames == 32


def test_without_supply_the_adapter_forgets(bench: Bench) -> None:
    bench.open()
    bench.adapter.switch_off()
    assert bench.say(b"t1230\rO\r") == b"\a\a"
    bench.medium.unplug()
    assert bench.say(b"S6\rO\r") == b"\r\a"


@settings(deadline=None, max_examples=50)
@given(st.lists(st.binary(max_size=40) | st.sampled_from([b"\r", b"O\r", b"S6\r", b"t1231"]), max_size=20))
def test_each_line_has_one_answer_whatever_comes(pieces: list[bytes]) -> None:
    bench = Bench()
    answers = bench.say(b"".join(pieces), wait_s=0.3)
    assert answers.count(b"\r") + answers.count(b"\a") == b"".join(pieces).count(b"\r")
