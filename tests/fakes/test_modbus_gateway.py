"""The emulated Modbus TCP gateway: golden bytes, pipelining, pieces, foreign units, and a stream out of step."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymodbus.framer.socket import FramerSocket
from pymodbus.pdu import DecodePDU

from microdrivers.core.units import NS_PER_MS
from microdrivers.fakes.wire import NetworkEmulator, Reply
from tests.fakes.az_bench import STOP, UNIT, GatewayBench, adu, write_request

READ_STATUS = bytes.fromhex("03 00 7E 00 02")
STATUS = bytes.fromhex("03 04 00 00 40 30")
MOVE = write_request(0x58, (0, 1, 8500, 20_000, 1_000_000, 1_000_000, 1000, 1))[1:-2]
TOO_LONG_MS = 501.0


@pytest.fixture
def bench() -> GatewayBench:
    return GatewayBench()


def send(bench: GatewayBench, data: bytes, listen_ms: float = 60.0) -> list[bytes]:
    return [reply.data for reply in bench.put(data) + bench.listen(listen_ms)]


# ---------------------------------------------------------------------- bytes


def test_golden_bytes(bench: GatewayBench) -> None:
    for request, reply in (
        ("00 01 00 00 00 06 01 03 00 7E 00 02", "00 01 00 00 00 07 01 03 04 00 00 40 30"),
        ("BE EF 00 00 00 06 01 06 00 7D 00 00", "BE EF 00 00 00 06 01 06 00 7D 00 00"),
        ("00 02 00 00 00 06 01 08 00 00 12 34", "00 02 00 00 00 06 01 08 00 00 12 34"),
        ("00 03 00 00 00 0B 01 10 00 7C 00 02 04 00 00 00 00", "00 03 00 00 00 06 01 10 00 7C 00 02"),
        ("00 04 00 00 00 0F 01 17 00 7E 00 02 00 7C 00 02 04 00 00 00 00", "00 04 00 00 00 07 01 17 04 00 00 40 30"),
        ("00 05 00 00 00 06 01 01 00 00 00 08", "00 05 00 00 00 03 01 81 01"),
        ("00 06 00 00 00 06 01 03 05 00 00 02", "00 06 00 00 00 03 01 83 02"),
        ("00 07 00 00 00 06 01 03 00 7E 00 00", "00 07 00 00 00 03 01 83 03"),
        ("00 08 00 00 00 0B 01 10 00 60 00 02 04 00 00 00 00", "00 08 00 00 00 03 01 90 04"),
        ("00 09 00 00 00 02 01 03", "00 09 00 00 00 03 01 83 03"),
    ):
        assert send(bench, bytes.fromhex(request)) == [bytes.fromhex(reply)]


def test_it_is_a_network_device(bench: GatewayBench) -> None:
    assert isinstance(bench.gateway, NetworkEmulator)
    assert not isinstance(bench.slave, NetworkEmulator)


@pytest.mark.parametrize("unit_id", [UNIT, 0, 255])
def test_the_only_slave_needs_no_address(bench: GatewayBench, unit_id: int) -> None:
    assert send(bench, adu(1, unit_id, READ_STATUS)) == [adu(1, unit_id, STATUS)]


@given(address=st.integers(0, 0xFFFF), count=st.integers(0, 130), transaction=st.integers(0, 0xFFFF))
@settings(max_examples=60, deadline=None)
def test_replies_satisfy_an_independent_decoder(address: int, count: int, transaction: int) -> None:
    (reply,) = send(GatewayBench(), adu(transaction, UNIT, struct.pack(">BHH", 3, address, count)))
    length, unit_id, found, pdu = FramerSocket(DecodePDU(False)).decode(reply)
    assert (length, unit_id, found) == (len(reply), UNIT, transaction)
    decoded = DecodePDU(False).decode(pdu)
    assert decoded is not None
    assert decoded.exception_code in (2, 3) if decoded.isError() else len(decoded.registers) == count


@given(st.binary(min_size=1, max_size=253))
@settings(max_examples=100, deadline=None)
def test_every_request_has_one_reply(pdu: bytes) -> None:
    (reply,) = send(GatewayBench(), adu(7, UNIT, pdu))
    assert reply[:4] == b"\x00\x07\x00\x00"
    assert int.from_bytes(reply[4:6], "big") == len(reply) - 6
    assert reply[6] == UNIT
    assert reply[7] in (pdu[0], pdu[0] | 0x80)


# ---------------------------------------------------------------------- the line behind it


@pytest.mark.parametrize(("baudrate", "silence_ms"), [(9600, 4.0), (19200, 2.5), (115200, 2.5)])
def test_a_reply_comes_after_its_exchange_on_the_line(baudrate: int, silence_ms: float) -> None:
    bench = GatewayBench(baudrate=baudrate)
    (reply,) = bench.put(adu(1, UNIT, READ_STATUS)) + bench.listen(100)
    on_the_line_ms = (8 + 9) * 11e3 / baudrate
    taken_ms = (reply.t_ns - bench.sent_ns) / NS_PER_MS
    assert on_the_line_ms + 2 * silence_ms + 3.0 <= taken_ms <= on_the_line_ms + 2 * silence_ms + 3.3 + 1e-3


def exchange_many(bench: GatewayBench, requests: Sequence[bytes]) -> list[Reply]:
    return bench.put(b"".join(requests)) + bench.listen(40.0 * len(requests))


def test_pipelined_requests_are_carried_out_in_order(bench: GatewayBench) -> None:
    pdus = [READ_STATUS, MOVE, READ_STATUS, bytes((6, 0, 0x7D, 0, STOP)), bytes.fromhex("03 05 00 00 02"), READ_STATUS]
    replies = exchange_many(bench, [adu(10 + i, UNIT, pdu) for i, pdu in enumerate(pdus)])
    assert [struct.unpack(">H", reply.data[:2])[0] for reply in replies] == list(range(10, 16))
    assert [reply.data[7] for reply in replies] == [3, 0x10, 3, 6, 0x83, 3]
    assert bench.texts() == ["move 8500", "stop"]
    times_ns = [reply.t_ns for reply in replies]
    # The drive's pause after a reply, and the exchange itself, lie between any two.
    assert min(later - earlier for earlier, later in itertools.pairwise(times_ns)) > 8 * NS_PER_MS
    assert bench.drive.read(0xAC, 2, bench.t_ns) == [0, 0x88]  # exception 02, and no lost frame


@pytest.mark.parametrize("unit_id", [2, 31, 254])
def test_a_foreign_unit_is_reported_after_a_time_out(bench: GatewayBench, unit_id: int) -> None:
    foreign, own = bench.put(adu(1, unit_id, MOVE) + adu(2, UNIT, READ_STATUS)) + bench.listen(300)
    assert foreign.data == adu(1, unit_id, b"\x90\x0b")
    assert 150 <= (foreign.t_ns - bench.sent_ns) / NS_PER_MS <= 155
    assert own.data == adu(2, UNIT, STATUS)
    assert own.t_ns > foreign.t_ns
    assert bench.texts() == []


def test_a_drive_without_power_is_reported_as_well(bench: GatewayBench) -> None:
    bench.drive.power_cycle(bench.t_ns)
    assert send(bench, adu(1, UNIT, READ_STATUS), 200) == [adu(1, UNIT, b"\x83\x0b")]
    bench.wait_ms(1000)
    assert send(bench, adu(2, UNIT, READ_STATUS)) == [adu(2, UNIT, STATUS)]


def test_the_drives_own_time_out_runs_behind_the_gateway(bench: GatewayBench) -> None:
    bench.write(0x138A, 200)
    bench.move(100_000)
    bench.listen(1000)
    assert bench.texts() == ["move 100000", "alarm 85"]


# ---------------------------------------------------------------------- pieces


@given(
    pdus=st.lists(
        st.sampled_from([READ_STATUS, MOVE, bytes.fromhex("03 05 00 00 02"), b"\x2b"]), min_size=1, max_size=5
    ),
    cuts=st.lists(st.tuples(st.integers(1, 250), st.floats(0.0, 499.0)), max_size=8),
)
@settings(max_examples=80, deadline=None)
def test_pieces_make_no_difference(pdus: list[bytes], cuts: list[tuple[int, float]]) -> None:
    requests = [adu(i, UNIT, pdu) for i, pdu in enumerate(pdus)]
    at_once, bench = GatewayBench(), GatewayBench()
    expected = [reply.data[:9] for reply in exchange_many(at_once, requests)]
    stream, replies, start = b"".join(requests), [], 0
    for end, pause_ms in sorted(dict(cuts).items()):
        if end < len(stream):
            replies += bench.put(stream[start:end])
            replies += bench.listen(pause_ms)
            start = end
    replies += bench.put(stream[start:]) + bench.listen(500)
    assert [reply.data[:9] for reply in replies] == expected
    assert bench.texts() == at_once.texts()


def test_half_a_request_is_waited_for_no_longer_than_half_a_second(bench: GatewayBench) -> None:
    whole = adu(1, UNIT, READ_STATUS)
    assert send(bench, whole[:9], 499) == []
    assert send(bench, whole[9:]) == [adu(1, UNIT, STATUS)]
    assert send(bench, whole[:9], TOO_LONG_MS) == []
    assert send(bench, whole) == [adu(1, UNIT, STATUS)]


# ---------------------------------------------------------------------- out of step


@pytest.mark.parametrize(
    "header", ["00 01 00 01 00 06", "00 01 00 00 00 00", "00 01 00 00 00 01", "00 01 00 00 00 FF", "00 01 00 00 FF FF"]
)
@pytest.mark.parametrize("reconnects", [False, True])
def test_a_senseless_header_loses_everything_until_a_pause_or_a_new_connection(
    bench: GatewayBench, header: str, reconnects: bool
) -> None:
    good = adu(2, UNIT, READ_STATUS)
    assert send(bench, good + bytes.fromhex(header) + good) == [adu(2, UNIT, STATUS)]
    bench.listen(300)
    assert send(bench, good) == []  # and the pause begins anew
    bench.listen(300)
    assert send(bench, good) == []
    if reconnects:
        bench.gateway.connected(bench.t_ns)
    else:
        bench.listen(TOO_LONG_MS)
    assert send(bench, good) == [adu(2, UNIT, STATUS)]
    assert bench.drive.read(0xAC, 2, bench.t_ns) == [0, 0]  # the drive has noticed nothing


@given(st.lists(st.tuples(st.binary(max_size=40), st.floats(0.0, 700.0)), max_size=8))
@settings(max_examples=80, deadline=None)
def test_arbitrary_bytes_do_not_crash_or_wedge_it(pieces: list[tuple[bytes, float]]) -> None:
    bench = GatewayBench()
    for data, pause_ms in pieces:
        bench.put(data)
        bench.wait_ms(pause_ms)  # without turning it
    bench.listen(8 * 40 * 150 + TOO_LONG_MS)  # each request in there could be for a foreign unit
    assert send(bench, adu(9, UNIT, b"\x08\x00\x00\x12\x34")) == [adu(9, UNIT, b"\x08\x00\x00\x12\x34")]


def test_a_new_connection_hears_nothing_of_the_last_one(bench: GatewayBench) -> None:
    bench.put(adu(1, UNIT, MOVE) + adu(2, UNIT, bytes((6, 0, 0x7D, 0, STOP))) + b"\x00\x03\x00")
    bench.gateway.connected(bench.t_ns)
    assert send(bench, adu(4, UNIT, READ_STATUS), 100)[0][:2] == b"\x00\x04"
    assert bench.texts() == ["move 8500", "stop"]  # what was asked for completely is done
