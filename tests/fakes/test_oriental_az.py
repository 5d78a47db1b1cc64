"""The emulated AZ drive's port: silence, exceptions, and what it makes of a bad line."""

from __future__ import annotations

import itertools
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymodbus.framer.rtu import FramerRTU
from pymodbus.pdu import DecodePDU

from microdrivers.core.units import NS_PER_MS
from microdrivers.fakes.modbus import crc16, frame
from tests.fakes.az_bench import STOP, UNIT, AzBench, write_request

STATUS = "01 03 00 7E 00 02 A4 13"
DIAGNOSE = "01 08 00 00 12 34 ED 7C"


@pytest.fixture
def bench() -> AzBench:
    return AzBench()


# ---------------------------------------------------------------------- silence


def test_golden_silence(bench: AzBench) -> None:
    assert bench.ask_hex("07 03 00 7E 00 02 A4 75") == ""
    assert bench.ask_hex("00 06 00 7D 00 20 19 DB") == ""
    assert bench.texts() == ["stop"]
    assert bench.ask_hex("00 06 00 7D 00 00 18 03") == ""
    assert bench.ask_hex(STATUS) == "01 03 04 00 00 40 30 CB E7"


# ---------------------------------------------------------------------- exceptions


@pytest.mark.parametrize(
    ("pdu", "code"),
    [
        ("02 00 7E 00 01", 1),
        ("2B 0E 01 00", 1),
        ("08 00 01 00 00", 1),
        ("08 00 00 12 34 56 78", 3),
        ("03 FF FF 00 02", 2),
        ("03 00 D2 00 02", 2),
        ("03 00 7E 00 00", 3),
        ("03 00 7E 00 7E", 3),
        ("03 00 7E 00", 3),
        ("03 00 7E 00 02 00", 3),
        ("06 00 C6 00 01", 2),
        ("06 00 7D", 3),
        ("10 00 7C 00 02 02 00 00", 3),
        ("10 00 7C 00 02 04 00 00", 3),
        ("10 00 7C 00 00 00", 3),
        ("10 00 7C", 3),
        ("10 FF FE 00 03 06 00 00 00 00 00 00", 2),
        ("10 00 7C 00 04 08 00 00 00 00 00 00 00 00", 2),
        ("17 00 7E 00 00 00 7C 00 02 04 00 00 00 00", 3),
        ("17 00 7E 00 02 00 7C 00 02 03 00 00 00 00", 3),
        ("17 00 7E", 3),
        ("06 00 59 01 00", 4),
        ("10 00 66 00 02 04 00 00 00 02", 4),
    ],
)
def test_exceptions(bench: AzBench, pdu: str, code: int) -> None:
    body = bytes.fromhex(pdu)
    assert bench.ask(frame(UNIT, body)) == frame(UNIT, bytes((body[0] | 0x80, code)))
    expected = {1: 0x88, 2: 0x88, 3: 0x8C, 4: 0x8C}[code]
    assert bench.read(0xAC) == expected


@pytest.mark.parametrize(("function", "most"), [(0x10, 123), (0x17, 121)])
def test_largest_writes(bench: AzBench, function: int, most: int) -> None:
    """So many registers are well-formed (but no such block exists); one more makes the frame too long."""
    head = bytes((function,)) + (struct.pack(">HH", 0x7E, 2) if function == 0x17 else b"")
    for count, code in ((most, b"\x02"), (most + 1, b"")):
        body = struct.pack(">HHB", 0x500, count, 2 * count) + bytes(2 * count)
        assert bench.ask(frame(UNIT, head + body))[2:3] == code


def test_a_refused_block_changes_nothing(bench: AzBench) -> None:
    before = [bench.read(address) for address in range(0x58, 0x68, 2)]
    assert bench.write(0x58, 0, 1, 777, 20_000, 1_000_000, 1_000_000, 1001, 1) == 4
    assert [bench.read(address) for address in range(0x58, 0x68, 2)] == before
    assert bench.drive.log == []


def test_slave_errors_can_be_hidden(bench: AzBench) -> None:
    assert bench.write(0x1392, 0) == 0
    assert bench.write(0x60, 0) == 0
    assert bench.read(0x60) == 1_000_000
    assert bench.read(0xAC) == 0x8C
    assert bench.exception_of(frame(UNIT, bytes.fromhex("03 05 00 00 02"))) == 2


@given(address=st.integers(0, 0xFFFF), count=st.integers(1, 125))
@settings(max_examples=60, deadline=None)
def test_replies_satisfy_an_independent_decoder(address: int, count: int) -> None:
    reply = AzBench().ask(frame(UNIT, struct.pack(">BHH", 3, address, count)))
    assert FramerRTU.compute_CRC(reply[:-2]) == int.from_bytes(reply[-2:], "big")
    decoded = DecodePDU(False).decode(reply[1:-2])
    assert decoded is not None
    assert decoded.exception_code == 2 if decoded.isError() else len(decoded.registers) == count


@given(st.binary(max_size=260))
@settings(max_examples=60, deadline=None)
def test_crc_agrees_with_an_independent_one(data: bytes) -> None:
    assert crc16(data).to_bytes(2, "little") == FramerRTU.compute_CRC(data).to_bytes(2, "big")


# ---------------------------------------------------------------------- the line


@pytest.mark.parametrize(("baudrate", "silence_ms"), [(9600, 4.0), (19200, 2.5), (115200, 2.5)])
def test_reply_comes_after_silence_and_waiting_time(baudrate: int, silence_ms: float) -> None:
    delays_ms = []
    for seed in range(20):
        bench = AzBench(baudrate=baudrate, seed=seed)
        replies = bench.put(bytes.fromhex(STATUS)) + bench.listen()
        delays_ms.append((replies[0].t_ns - bench.sent_ns) / NS_PER_MS)
    assert min(delays_ms) >= silence_ms + 3.0
    assert max(delays_ms) <= silence_ms + 3.3
    assert len(set(delays_ms)) == 20


def test_the_same_seed_gives_the_same_delays() -> None:
    runs = []
    for _ in range(2):
        bench = AzBench(seed=3)
        runs.append([(bench.put(bytes.fromhex(STATUS)) + bench.listen())[0] for _ in range(5)])
    assert runs[0] == runs[1]


@pytest.mark.parametrize(("gap_ms", "answered"), [(2.4, True), (2.6, False), (100.0, False)])
def test_a_torn_request_is_dropped(bench: AzBench, gap_ms: float, answered: bool) -> None:
    whole = bytes.fromhex(STATUS)
    replies = bench.put(whole[:3])
    bench.wait_ms(gap_ms)
    replies += bench.put(whole[3:]) + bench.listen()
    assert len(replies) == answered
    assert bench.ask_hex(STATUS) != ""


def test_glued_requests_are_one_bad_frame(bench: AzBench) -> None:
    assert bench.ask_hex(STATUS + STATUS) == ""
    assert bench.read(0xAC) == 0x84


def test_garbage_in_front_spoils_one_request_only(bench: AzBench) -> None:
    bench.put(bytes.fromhex("01 03 00"))
    assert bench.ask_hex(STATUS) == ""
    assert bench.ask_hex(STATUS) != ""


def test_garbage_followed_by_silence_spoils_nothing(bench: AzBench) -> None:
    bench.put(bytes.fromhex("01 03 00"))
    bench.wait_ms(3)
    assert bench.ask_hex(STATUS) != ""


def test_bad_crc_and_short_frames_are_met_with_silence(bench: AzBench) -> None:
    assert bench.ask_hex("01 03 00 7E 00 02 A4 12") == ""
    assert bench.ask_hex("01 7E 80") == ""
    assert bench.ask(bytes(300)) == b""
    assert bench.read(0x80) == 0x84  # three lost frames in a row


def test_frames_above_256_bytes_are_met_with_silence(bench: AzBench) -> None:
    for size, answered in ((252, True), (253, False)):
        reply = bench.ask(frame(UNIT, b"\x08\x00\x00" + bytes(size - 2)))
        assert bool(reply) is answered
    assert bench.ask(frame(UNIT, b"\x08\x00\x00" + bytes(250)) + b"\x00") == b""


@pytest.mark.parametrize(
    ("baudrate", "pause_ms", "heard"),
    [(115200, 2.9, False), (115200, 3.1, True), (9600, 4.9, False), (9600, 5.1, True)],
)
def test_a_request_too_soon_after_a_reply_is_dropped(baudrate: int, pause_ms: float, heard: bool) -> None:
    bench = AzBench(baudrate=baudrate)
    reply = (bench.put(bytes.fromhex(STATUS)) + bench.listen())[0]
    bench.t_ns = reply.t_ns + len(reply.data) * bench.byte_ns
    bench.wait_ms(pause_ms)
    assert bool(bench.ask_hex(STATUS)) is heard
    assert bench.read(0xAC) == (0 if heard else 0x84)


def test_a_stop_sent_before_the_reply_is_lost(bench: AzBench) -> None:
    bench.put(bytes.fromhex(STATUS))
    bench.wait_ms(3)
    stop = frame(UNIT, struct.pack(">BHH", 6, 0x7D, STOP))
    assert [reply.data[1] for reply in bench.put(stop) + bench.listen()] == [3]
    assert bench.texts() == []
    assert bench.ask(stop) == stop
    assert bench.texts() == ["stop"]


@pytest.mark.parametrize(("pause_ms", "heard"), [(7.4, False), (7.6, True)])
def test_a_request_too_soon_after_a_broadcast_is_dropped(bench: AzBench, pause_ms: float, heard: bool) -> None:
    bench.put(bytes.fromhex("00 06 00 7D 00 20 19 DB"))
    bench.wait_ms(pause_ms)
    assert bool(bench.ask_hex(STATUS)) is heard


# ---------------------------------------------------------------------- properties


@given(st.lists(st.tuples(st.binary(max_size=40), st.floats(0.0, 10.0)), max_size=12))
@settings(max_examples=60, deadline=None)
def test_arbitrary_bytes_do_not_crash_or_wedge_it(pieces: list[tuple[bytes, float]]) -> None:
    bench = AzBench()
    for data, pause_ms in pieces:
        bench.put(data)
        bench.wait_ms(pause_ms)
    bench.listen(50)
    assert bench.ask_hex(DIAGNOSE) == DIAGNOSE


@given(st.binary(min_size=1, max_size=60))
@settings(max_examples=150, deadline=None)
def test_arbitrary_requests_with_a_good_crc_are_answered(pdu: bytes) -> None:
    reply = AzBench().ask(frame(UNIT, pdu))
    assert reply[0] == UNIT
    assert reply[1] in (pdu[0], pdu[0] | 0x80)
    assert crc16(reply) == 0


@given(
    cuts=st.lists(st.tuples(st.integers(1, 40), st.floats(0.0, 2.4)), max_size=8),
    steps=st.integers(-(2**31), 2**31 - 1),
)
@settings(max_examples=60, deadline=None)
def test_fragments_without_long_gaps_are_one_request(cuts: list[tuple[int, float]], steps: int) -> None:
    request = write_request(0x58, (0, 2, steps, 5000, 1000, 2000, 1000, 1))
    at_once = AzBench()
    expected = (at_once.put(request) + at_once.listen())[0]
    bench = AzBench()
    pause_ms = dict(cuts)
    edges = [0, *sorted(pause_ms), len(request)]
    replies = []
    for start, end in itertools.pairwise(edges):
        replies += bench.put(request[start:end])
        bench.wait_ms(pause_ms.get(end, 0.0))
    (reply,) = replies + bench.listen()
    assert reply.data == expected.data
    assert reply.t_ns - bench.sent_ns == expected.t_ns - at_once.sent_ns
    assert bench.texts() == at_once.texts() == [f"move {steps}"]
