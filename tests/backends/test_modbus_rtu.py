from __future__ import annotations

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.backends.modbus.framing import Expected
from microdrivers.backends.modbus.master import ModbusMaster, ModbusRefusal
from microdrivers.backends.modbus.rtu import RtuReply
from microdrivers.core.errors import LinkTimeout, ProtocolError
from microdrivers.core.units import NS_PER_MS
from tests.backends.modbus_bench import IDLE, MOVING, NO_REPLY, STATUS_QUERY, ModbusBench, soon, spoiled
from tests.backends.oriental_az_peer import Script, with_crc

ECHO = bytes.fromhex("0106007D0010181E")


def master(script: Script, *, seed: int = 0) -> ModbusMaster:
    return ModbusBench(script, seed=seed).master


# ---------------------------------------------------------------------- requests


def test_bytes_of_a_read_and_of_the_writes() -> None:
    block_echo = with_crc(bytes.fromhex("011000580002"))
    script = Script(soon(IDLE), soon(ECHO), soon(block_echo))
    modbus = master(script)
    assert modbus.read(0x7E, 2).values == (0, 0x4020)
    modbus.write(0x7D, 0x10)
    modbus.write_block(0x58, [0x0102, 0xFFFE])
    assert script.requests == [STATUS_QUERY, ECHO, with_crc(bytes.fromhex("011000580002040102FFFE"))]
    assert script.marks == []


@pytest.mark.parametrize(("values", "frame"), [((0x20,), "0106007D0020"), ((0, 0x20), "0110007D0002040000 0020")])
def test_a_posted_write_is_not_awaited_and_its_reply_not_taken_for_anothers(values: tuple[int], frame: str) -> None:
    late = with_crc(bytes.fromhex(frame)[:6])
    script = Script([(0.05, late)], soon(ECHO))
    bench = ModbusBench(script)
    bench.master.post(0x7D, values)
    assert bench.clock.now_ns() == 0
    bench.master.write(0x7D, 0x10)
    assert script.requests == [with_crc(bytes.fromhex(frame)), ECHO]
    assert len(script.marks) == 1  # nothing was read back from the post: the line is settled first


# ---------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("code", "meaning"), [(1, "function"), (2, "addresses"), (3, "number"), (4, "not executable"), (6, "busy")]
)
def test_exceptions_name_register_meaning_and_bytes(code: int, meaning: str) -> None:
    script = Script(soon(with_crc(bytes((1, 0x83, code)))))
    pattern = f"unit 1 .*2 registers at 0500h.*exception 0{code}.*{meaning}.*sent 01 03 05 00.*received 01 83 0{code}"
    with pytest.raises(ModbusRefusal, match=pattern) as caught:
        master(script).read(0x0500, 2)
    assert (caught.value.moved, caught.value.exception_code) == ("no", code)
    assert caught.value.remedy
    assert len(script.requests) == 1  # an exception is an answer: nothing to repeat


def test_a_refused_write_names_the_register() -> None:
    with pytest.raises(ModbusRefusal, match="write of 0010h to register 007Dh with exception 04"):
        master(Script(soon(with_crc(bytes.fromhex("018604"))))).write(0x7D, 0x10)


def test_an_exception_that_is_no_refusal() -> None:
    script = Script(soon(with_crc(bytes.fromhex("018605"))))
    with pytest.raises(ProtocolError, match="unknown exception 05") as caught:
        master(script).write(0x7D, 0x10)
    assert caught.value.moved == "maybe"


# ---------------------------------------------------------------------- bad replies


@pytest.mark.parametrize("index", range(len(IDLE)))
def test_a_garbled_reply_is_asked_for_once_more(index: int) -> None:
    script = Script(soon(spoiled(IDLE, index)), soon(MOVING))
    assert master(script, seed=index).read(0x7E, 2).values == (0, 0x2000)
    assert script.requests == [STATUS_QUERY] * 2


def test_bad_crc_twice_tells_what_was_sent_and_received() -> None:
    script = Script(soon(spoiled(IDLE)), soon(spoiled(IDLE)), soon(IDLE))
    with pytest.raises(ProtocolError, match="2 registers at 007Eh") as caught:
        master(script).read(0x7E, 2)
    assert "CRC" in caught.value.what
    assert (caught.value.sent, caught.value.received) == (STATUS_QUERY, spoiled(IDLE))
    assert len(script.requests) == 2


@pytest.mark.parametrize("foreign", ["078304A0F2", with_crc(b"\x07" + IDLE[1:-2]).hex()])
def test_an_answer_of_another_unit(foreign: str) -> None:
    script = Script(*[soon(bytes.fromhex(foreign))] * 2)
    with pytest.raises(ProtocolError, match="an answer of unit 7") as caught:
        master(script).read(0x7E, 2)
    assert caught.value.received == bytes.fromhex(foreign)
    assert "id" in caught.value.remedy


def test_an_answer_to_another_request() -> None:
    script = Script(soon(with_crc(bytes.fromhex("0106007D0020"))))
    with pytest.raises(ProtocolError, match="an answer to another request"):
        master(script).write(0x7D, 0x10)


def test_half_a_reply_is_a_timeout_that_shows_it() -> None:
    script = Script(soon(IDLE[:5]), soon(IDLE[:5]))
    with pytest.raises(LinkTimeout, match="read of 2 registers at 007Eh: only a part of the reply") as caught:
        master(script).read(0x7E, 2)
    assert repr(IDLE[:5]) in caught.value.what
    assert len(script.requests) == 2


def test_silence_names_unit_baud_rate_and_parity() -> None:
    script = Script(marks=())
    with pytest.raises(LinkTimeout, match=r"unit 1 on .* \(115200 baud, parity E, 1 stop bit\)") as caught:
        master(script).read(0x7E, 2)
    assert repr(STATUS_QUERY) in caught.value.what
    assert caught.value.moved == "no"
    assert caught.value.remedy == "check power; or another device is behind this port"
    assert (script.requests, len(script.marks)) == ([STATUS_QUERY], 1)


@pytest.mark.parametrize("garbage", ["00", "FF", "01", "0103", "010300", "01030400", "8301", "01030400002000E3"])
@pytest.mark.parametrize("seed", range(3))
def test_stray_bytes_before_the_reply(garbage: str, seed: int) -> None:
    script = Script(soon(bytes.fromhex(garbage) + IDLE))
    assert master(script, seed=seed).read(0x7E, 2).values == (0, 0x4020)
    assert len(script.requests) == 1


@settings(deadline=None, max_examples=80)
@given(garbage=st.binary(max_size=12), cut=st.integers(0, len(IDLE)), seed=st.integers(0, 1000))
def test_noise_never_becomes_a_value(garbage: bytes, cut: int, seed: int) -> None:
    script = Script(*[soon(garbage + IDLE[:cut])] * 2)
    try:
        values = master(script, seed=seed).read(0x7E, 2).values
    except (LinkTimeout, ProtocolError):
        assert cut < len(IDLE) or garbage
    else:
        assert values == (0, 0x4020)


@settings(deadline=None, max_examples=200)
@given(
    stray=st.binary(max_size=20), words=st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=8), behind=st.binary(),
    cuts=st.lists(st.integers(0, 60)),
)  # fmt: skip
def test_the_reply_is_found_in_any_pieces_or_given_up_but_never_another(
    stray: bytes, words: list[int], behind: bytes, cuts: list[int]
) -> None:
    pdu = struct.pack(f">BB{len(words)}H", 3, 2 * len(words), *words)
    sent = stray + with_crc(b"\x01" + pdu) + behind
    reply = RtuReply(1, Expected(pdu[:2], len(pdu)))
    ends = [*sorted(cut for cut in cuts if cut < len(sent)), len(sent)]
    assert any(reply.complete(sent[:end]) for end in ends)  # nothing is waited for in vain
    if not stray:
        assert reply.pdu == pdu
    if reply.pdu:
        assert (reply.pdu, reply.start) == (pdu, len(stray))
    else:
        assert reply.complaint


# ---------------------------------------------------------------------- writes


@pytest.mark.parametrize("answer", [NO_REPLY, soon(ECHO[:4]), soon(spoiled(ECHO))])
def test_a_write_is_never_repeated(answer: tuple[tuple[float, bytes], ...]) -> None:
    script = Script(answer, soon(ECHO))
    with pytest.raises((LinkTimeout, ProtocolError), match="0010h to register 007Dh") as caught:
        master(script).write(0x7D, 0x10)
    assert caught.value.moved == "maybe"
    assert script.requests == [ECHO]


def test_a_write_to_a_unit_that_is_still_silent_is_not_sent() -> None:
    script = Script(NO_REPLY, marks=())
    modbus = master(script)
    with pytest.raises(LinkTimeout):
        modbus.read(0x7E, 2)
    with pytest.raises(LinkTimeout, match="a write of 0010h to register 007Dh was not sent") as caught:
        modbus.write(0x7D, 0x10)
    assert caught.value.moved == "no"
    assert script.requests == [STATUS_QUERY]


# ---------------------------------------------------------------------- late replies


def test_a_read_survives_one_lost_request() -> None:
    script = Script(NO_REPLY, soon(IDLE))
    assert master(script).read(0x7E, 2).values == (0, 0x4020)
    assert script.marks == [with_crc(bytes.fromhex("010800000001"))]


@pytest.mark.parametrize("late_s", [0.21, 0.235, 0.26])
def test_a_late_reply_of_the_same_shape_is_not_taken_for_the_next_one(late_s: float) -> None:
    """The second is still under way when the line has been quiet, the third comes while the mark is awaited."""
    mark = with_crc(bytes.fromhex("010800000001"))
    script = Script([(late_s, MOVING)], soon(IDLE), marks=[[(max(0.0055, late_s - 0.23), mark)]])
    assert master(script).read(0x7E, 2).values == (0, 0x4020)
    assert len(script.requests) == 2


def test_a_unit_that_cannot_echo_settles_the_line_with_its_refusal() -> None:
    script = Script(NO_REPLY, soon(IDLE), marks=[soon(with_crc(bytes.fromhex("018801")))])
    assert master(script).read(0x7E, 2).values == (0, 0x4020)


def test_an_old_mark_settles_nothing() -> None:
    old = with_crc(bytes.fromhex("010800000001"))
    script = Script(NO_REPLY, soon(IDLE), marks=[NO_REPLY, soon(old), soon(old)])
    modbus = master(script)
    for _ in range(3):
        with pytest.raises(LinkTimeout):
            modbus.read(0x7E, 2)
    assert [mark[4:6].hex() for mark in script.marks] == ["0001", "0002", "0003", "0004", "0005"]
    assert len(script.requests) == 1


# ---------------------------------------------------------------------- time


@pytest.mark.parametrize(("baudrate", "gap_ms"), [(9600, 5.0), (19200, 3.0), (115200, 3.0), (230400, 3.0)])
def test_silence_is_kept_after_a_reply(baudrate: int, gap_ms: float) -> None:
    bench = ModbusBench(Script(soon(IDLE), soon(IDLE)), baudrate=baudrate)
    bench.master.read(0x7E, 2)
    reply_end_ns = bench.clock.now_ns()
    bench.master.read(0x7E, 2)
    request_end_ns = [t_ns for t_ns, side, _ in bench.wire.log if side == "host"][1]
    assert request_end_ns - 8 * bench.wire.byte_ns - reply_end_ns >= gap_ms * NS_PER_MS


@pytest.mark.parametrize("fragments", [1, 3])
@pytest.mark.parametrize("late_ms", [0, 4])
@pytest.mark.parametrize("stray", [b"", b"\x00", b"\xff\x01\x03"])
def test_the_stamp_covers_when_the_device_can_have_sampled(fragments: int, late_ms: int, stray: bytes) -> None:
    script = Script([(0.0026, stray), (0.0055 + late_ms / 1000, IDLE)])
    reply = ModbusBench(script, fragments=fragments).master.read(0x7E, 2)
    request_end_ns = 8 * round(11e9 / 115200)
    first, last = request_end_ns + 2.5 * NS_PER_MS, request_end_ns + (5.5 + late_ms) * NS_PER_MS
    assert reply.t_ns - reply.dt_ns <= first
    assert reply.t_ns + reply.dt_ns >= last
    pauses_ms = 0 if fragments == 1 else 1.6  # a pause inside the reply may be one before it
    assert 2 * reply.dt_ns <= last - first + pauses_ms * NS_PER_MS + 2
