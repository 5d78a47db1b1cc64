from __future__ import annotations

import itertools
import struct

import pydantic
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.backends.modbus.framing import Expected
from microdrivers.backends.modbus.master import ModbusMaster, ModbusRefusal
from microdrivers.backends.modbus.mbap import MbapReply
from microdrivers.backends.modbus.settings import ModbusConnection
from microdrivers.core.errors import LinkTimeout, ProtocolError
from tests.backends.modbus_bench import NO_REPLY, ModbusBench, TcpScript, soon, tcp

STATUS_QUERY = bytes.fromhex("000100000006 01 03007E0002")
IDLE, MOVING = "01030400004020", "01030400002000"


def master(script: TcpScript, *, seed: int = 0) -> ModbusMaster:
    return ModbusBench(script, framing="tcp", seed=seed).master


# ---------------------------------------------------------------------- settings


@pytest.mark.parametrize("port", ["/dev/ttyUSB1", "COM3", "rfc2217://gateway:4000"])
def test_tcp_needs_a_network_address(port: str) -> None:
    with pytest.raises(pydantic.ValidationError, match=r"socket://HOST:502.*framing: rtu"):
        ModbusConnection.model_validate({"port": port, "framing": "tcp"})


def test_a_network_has_no_byte_times_and_a_serial_server_has() -> None:
    port = "socket://gateway:502"
    assert ModbusConnection.model_validate({"port": port, "framing": "tcp"}).bits_per_byte == 0
    assert ModbusConnection.model_validate({"port": port, "parity": "E"}).bits_per_byte == 11


# ---------------------------------------------------------------------- requests


def test_bytes_of_a_read_and_of_the_writes() -> None:
    script = TcpScript(soon(tcp(1, IDLE)), soon(tcp(2, "0106007D0010")), soon(tcp(3, "011000580002")))
    modbus = master(script)
    assert modbus.read(0x7E, 2).values == (0, 0x4020)
    modbus.write(0x7D, 0x10)
    modbus.write_block(0x58, [0x0102, 0xFFFE])
    assert script.requests == [
        STATUS_QUERY,
        bytes.fromhex("000200000006 01 06007D0010"),
        bytes.fromhex("00030000000B 01 1000580002040102FFFE"),
    ]


def test_the_numbers_begin_again_after_65535() -> None:
    script = TcpScript(*[soon(tcp(number, IDLE)) for number in (0xFFFF, 0, 1)])
    bench = ModbusBench(script, framing="tcp")
    bench.master._framing._numbers = itertools.count(0xFFFF)  # type: ignore[attr-defined]
    for _ in range(3):
        assert bench.master.read(0x7E, 2).values == (0, 0x4020)
    assert [data[:2].hex() for data in script.requests] == ["ffff", "0000", "0001"]


# ---------------------------------------------------------------------- replies


def test_a_late_reply_is_let_pass_and_the_wanted_one_awaited() -> None:
    script = TcpScript(NO_REPLY, [(0.01, tcp(1, MOVING)), (0.05, tcp(2, IDLE))])
    assert master(script).read(0x7E, 2).values == (0, 0x4020)
    assert len(script.requests) == 2


def test_only_late_replies_are_a_timeout() -> None:
    script = TcpScript(soon(tcp(0, MOVING)), soon(tcp(1, MOVING)))
    with pytest.raises(LinkTimeout, match=r"unit 1 on .*\(Modbus TCP\)") as caught:
        master(script).read(0x7E, 2)
    assert repr(tcp(1, MOVING)) in caught.value.what


@pytest.mark.parametrize(
    ("answer", "complaint"),
    [
        (tcp(1, "07030400004020"), "an answer of unit 7"),
        (tcp(1, IDLE, protocol=1), "protocol id 0001h"),
        (tcp(1, "0106007D0020"), "does not fit"),
        (tcp(1, "010302000040"), "does not fit"),
        (b"\0\x01\0\0\xff\xff\x01\x03", "length 65535"),
        (b"SSH-2.0-OpenSSH_9.2\r\n", "no Modbus TCP header"),
    ],
)
def test_what_is_no_reply(answer: bytes, complaint: str) -> None:
    script = TcpScript(soon(answer), NO_REPLY)
    modbus = master(script)
    with pytest.raises(ProtocolError, match=f"{complaint}.* in reply to a write of 0010h to register 007Dh") as caught:
        modbus.write(0x7D, 0x10)
    assert answer.startswith(caught.value.received)
    assert caught.value.moved == "maybe"
    assert caught.value.sent == script.requests[0]
    assert len(script.requests) == 1


def test_half_a_reply_is_a_timeout_that_shows_it() -> None:
    half = tcp(1, IDLE)[:9]
    with pytest.raises(LinkTimeout, match="only a part of the reply"):
        master(TcpScript(soon(half), soon(half))).read(0x7E, 2)


def test_exceptions_name_register_and_bytes() -> None:
    script = TcpScript(soon(tcp(1, "018302")))
    with pytest.raises(ModbusRefusal, match=r"2 registers at 0500h with exception 02.*received 00 01 00 00 00 03 01"):
        master(script).read(0x0500, 2)
    assert len(script.requests) == 1


def test_a_gateway_that_knows_no_such_unit_has_sent_nothing() -> None:
    with pytest.raises(ModbusRefusal, match="gateway knows no way") as caught:
        master(TcpScript(soon(tcp(1, "01860A")))).write(0x7D, 0x10)
    assert caught.value.moved == "no"


def test_a_gateway_that_gets_no_answer_may_have_sent_the_write() -> None:
    script = TcpScript(soon(tcp(1, "01860B")))
    with pytest.raises(LinkTimeout, match="gateway got no answer") as caught:
        master(script).write(0x7D, 0x10)
    assert caught.value.moved == "maybe"
    assert len(script.requests) == 1


@pytest.mark.parametrize("delay_s", [0.0, 0.004])
def test_the_stamp_is_the_middle_between_request_and_reply(delay_s: float) -> None:
    bench = ModbusBench(TcpScript([(delay_s, tcp(1, IDLE))]), framing="tcp", fragments=1)
    reply = bench.master.read(0x7E, 2)
    assert reply.t_ns - reply.dt_ns <= 1
    assert reply.t_ns + reply.dt_ns == pytest.approx(bench.clock.now_ns(), abs=1)


@settings(deadline=None, max_examples=300)
@given(
    number=st.integers(0, 0xFFFF),
    words=st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=8),
    older=st.lists(st.tuples(st.integers(1, 0x7FFF), st.binary(min_size=2, max_size=20)), max_size=3),
    stray=st.one_of(st.just(b""), st.binary(max_size=20)),
    cuts=st.lists(st.integers(0, 120)),
)
def test_the_reply_is_found_in_any_pieces_behind_older_ones_and_behind_no_headers(
    number: int, words: list[int], older: list[tuple[int, bytes]], stray: bytes, cuts: list[int]
) -> None:
    pdu = struct.pack(f">BB{len(words)}H", 3, 2 * len(words), *words)
    request = tcp(number, f"010300000{len(words):03X}")
    before = b"".join(tcp(number - age & 0xFFFF, (b"\x01" + old).hex()) for age, old in older)
    sent = before + stray + tcp(number, (b"\x01" + pdu).hex())
    reply = MbapReply(request, Expected(pdu[:2], len(pdu)))
    ends = [*sorted(cut for cut in cuts if cut < len(sent)), len(sent)]
    done = any(reply.complete(sent[:end]) for end in ends)
    if not stray:
        assert (done, reply.pdu, reply.start) == (True, pdu, len(before))
    if reply.pdu:
        assert reply.pdu == pdu
    else:  # the stray bytes look like a header, or like the beginning of the reply: it is asked for once more
        assert not done or reply.complaint
