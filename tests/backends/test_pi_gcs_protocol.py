"""The GCS 2.0 language: transcripts of the protocol sheet, properties of the parser, errors, late replies."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.backends.pi_gcs import error_codes, replies
from microdrivers.backends.pi_gcs.protocol import Gcs
from microdrivers.core.errors import (
    BusyError,
    DeviceFault,
    LinkError,
    LinkTimeout,
    MicrodriversError,
    MoveCancelled,
    NotReferenced,
    OutOfRange,
    ProtocolError,
    UnsupportedError,
)
from microdrivers.fakes.wire import Temper
from tests.backends.scripted_gcs import IDENTITY, Bench, ScriptedPeer

POSITIONS = b"1=1.5000000 \n2=3.0000000 \n3=4.5000000 \n4=6.0000000\n"
STATUS = b"0x9000900590029000\n"


def controller(script: dict[bytes, object]) -> tuple[Gcs, ScriptedPeer]:
    """A controller that has identified itself."""
    peer = ScriptedPeer({b"*IDN?\n": IDENTITY, b"ERR?\n": b"0\n"} | script)
    gcs = Gcs(Bench(peer).line())
    gcs.identify()
    peer.requests.clear()
    return gcs, peer


# ---------------------------------------------------------------------- transcripts of the sheet


def test_identity() -> None:
    gcs, _ = controller({})
    assert gcs.identity == IDENTITY.decode().strip()


@pytest.mark.parametrize(
    ("ask", "request_bytes", "reply", "value"),
    [
        (lambda gcs: gcs.names("SAI?"), b"SAI?\n", b"1 \n2 \n3 \n4\n", ["1", "2", "3", "4"]),
        (lambda gcs: gcs.names("SAI?"), b"SAI?\n", b"1\n", ["1"]),
        (lambda gcs: gcs.texts("CST?"), b"CST?\n", b"1=M-111.1DG\n", {"1": "M-111.1DG"}),
        (lambda gcs: gcs.flags("SVO? 1"), b"SVO? 1\n", b"1=0\n", {"1": False}),
        (lambda gcs: gcs.flags("FRF? 1"), b"FRF? 1\n", b"1=1\n", {"1": True}),
        (lambda gcs: gcs.numbers("TMX?"), b"TMX?\n", b"1=15.0000000\n", {"1": 15.0}),
        (lambda gcs: gcs.numbers("POS?"), b"POS?\n", POSITIONS, {"1": 1.5, "2": 3.0, "3": 4.5, "4": 6.0}),
        (lambda gcs: gcs.numbers("POS? 1 3"), b"POS? 1 3\n", b"1=1.5 \n3=4.5\n", {"1": 1.5, "3": 4.5}),
        (lambda gcs: gcs.numbers("POS?"), b"POS?\n", b"1=+0000.0000 \n2=-1158.4405\n", {"1": 0.0, "2": -1158.4405}),
        (lambda gcs: gcs.numbers("POS?"), b"POS?\n", b"1=-5e-05\n", {"1": -5e-05}),
        (lambda gcs: gcs.ready(), b"\x07", b"\xb1\n", True),
        (lambda gcs: gcs.ready(), b"\x07", b"\xb0\n", False),
        (lambda gcs: gcs.error(), b"ERR?\n", b"10\n", 10),
    ],
)
def test_queries_of_the_sheet(ask: object, request_bytes: bytes, reply: bytes, value: object) -> None:
    gcs, peer = controller({request_bytes: reply})
    assert ask(gcs) == value
    assert peer.requests == [request_bytes]


def test_status_registers() -> None:
    gcs, _ = controller({b"\x04": b"0x9005\n"})
    (word,) = gcs.status()
    assert word == replies.AxisStatus(on_target=True, referencing=False, moving=False, servo_on=True, error_flag=False)
    assert replies.status("0x60002100")[0] == replies.AxisStatus(False, True, True, False, False)
    assert replies.status("0x60002100")[1] == replies.AxisStatus(False, False, True, False, True)


def test_set_commands_and_their_error_check_go_in_one_write() -> None:
    peer = ScriptedPeer({b"ERR?\n": b"0\n"})
    bench = Bench(peer)
    Gcs(bench.line()).command("VEL 1 5", "MOV 1 0.1 2 2")
    assert [data for _, who, data in bench.wire.log if who == "host"] == [b"VEL 1 5\nMOV 1 0.1 2 2\nERR?\n"]


@pytest.mark.parametrize("reply", [POSITIONS + STATUS, STATUS + POSITIONS])
def test_pose_is_asked_in_one_write_and_stamped_before_its_reply(reply: bytes) -> None:
    peer = ScriptedPeer({b"\x04": reply})
    bench = Bench(peer)
    pose = Gcs(bench.line()).pose()
    assert [data for _, who, data in bench.wire.log if who == "host"] == [b"POS?\n\x04"]
    assert pose.positions == {"1": 1.5, "2": 3.0, "3": 4.5, "4": 6.0}
    assert [word.servo_on for word in pose.status] == [True] * 4
    assert pose.asked_ns - pose.start_ns == pytest.approx(5 * bench.wire.byte_ns, abs=2)
    assert pose.asked_ns < pose.first_byte_ns


def test_numbers_are_sent_rounded_and_short() -> None:
    assert [replies.decimal(value) for value in (7.5, 0.3, -1e-9, 1e-7, 2 / 3, -12.0, 100.0)] == [
        "7.5", "0.3", "0", "0.0000001", "0.6666667", "-12", "100",
    ]  # fmt: skip


# ---------------------------------------------------------------------- properties of the parser

text = st.text(st.characters(min_codepoint=0x21, max_codepoint=0x7E), min_size=1, max_size=12)
reply_lines = st.lists(text, min_size=1, max_size=4)


@settings(deadline=None, derandomize=True, max_examples=150)
@given(st.lists(reply_lines, min_size=1, max_size=3))
def test_a_reply_is_complete_at_its_last_byte_only(wanted: list[list[str]]) -> None:
    data = b"".join(" \n".join(lines).encode() + b"\n" for lines in wanted)
    complete = replies.completed_after(len(wanted))
    assert [complete(data[:end]) for end in range(len(data) + 1)] == [False] * len(data) + [True]
    assert replies.split_replies(data, len(wanted)) == wanted


@settings(deadline=None, derandomize=True, max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_fragments_and_pauses_do_not_matter(seed: int) -> None:
    peer = ScriptedPeer({b"POS?\n": POSITIONS, b"\x04": STATUS})
    gcs = Gcs(Bench(peer, seed=seed, temper=Temper(max_fragments=20, max_pause_s=0.01)).line())
    for _ in range(3):
        assert gcs.pose().positions["4"] == 6.0
    assert gcs.interruptions == 0


garbage = st.one_of(
    st.binary(max_size=40),
    st.text("0123456789=+-.eExX \n\xb1ABC_", max_size=40).map(lambda found: found.encode("latin-1")),
).map(lambda data: data + b"\n")


@settings(deadline=None, derandomize=True, max_examples=200)
@given(garbage, st.integers(1, 3))
def test_garbage_raises_protocol_errors_only(data: bytes, count: int) -> None:
    try:
        found = replies.split_replies(data, count)
    except ProtocolError:
        return
    for reply in found:
        for parse in (
            replies.single,
            lambda lines: replies.status(replies.single(lines)),
            lambda lines: replies.integer(replies.single(lines)),
            lambda lines: replies.assignments(lines, str),
            lambda lines: replies.assignments(lines, replies.number),
            lambda lines: replies.assignments(lines, replies.flag),
        ):
            with contextlib.suppress(ProtocolError):
                parse(reply)


@settings(deadline=None, derandomize=True, max_examples=60)
@given(garbage)
def test_garbage_on_the_line_raises_link_errors_that_say_what_was_sent(data: bytes) -> None:
    gcs, _ = controller({b"POS?\n": b"junk!" + data})
    with pytest.raises((ProtocolError, LinkTimeout)) as caught:
        gcs.numbers("POS?")
    assert "POS?" in caught.value.what
    assert "baud" in caught.value.remedy
    if isinstance(caught.value, ProtocolError):
        assert caught.value.sent == b"POS?\n"
        assert (b"junk!" + data).startswith(caught.value.received)


@pytest.mark.parametrize(
    "reply",
    [b"1=nan\n", b"1=1e999\n", b"1=1_0\n", b"1=\n", b"=1\n", b"1\n", b"1=1 \n1=2\n", b"\n", b"1=0x10\n", b"1=1,5\n"],
)
def test_what_is_no_number_is_refused(reply: bytes) -> None:
    gcs, _ = controller({b"POS?\n": reply})
    with pytest.raises(ProtocolError):
        gcs.numbers("POS?")


def test_too_many_replies_are_not_taken_for_one() -> None:
    gcs, _ = controller({b"ERR?\n": b"0\n0\n"})
    with pytest.raises(ProtocolError, match="1 whole replies"):
        gcs.error()


# ---------------------------------------------------------------------- error numbers


@pytest.mark.parametrize(
    ("code", "kind"),
    [
        *((code, ProtocolError) for code in (1, 2, 3, 15, 22, 23, 24, 25, 26, 54, 304, -7)),
        *((code, OutOfRange) for code in (7, 8, 17)),
        *((code, UnsupportedError) for code in (31, 32, 34)),
        *((code, BusyError) for code in (51, 53, 63, 1008)),
        *((code, DeviceFault) for code in (45, 49, 200, 500, 504, 505, 506, 555, 1005, 4711)),
        (5, NotReferenced),
        (10, MoveCancelled),
    ],
)
def test_each_error_number_has_its_type_and_remedy(code: int, kind: type[MicrodriversError]) -> None:
    gcs, peer = controller({b"ERR?\n": b"%d\n" % code})
    with pytest.raises(kind) as caught:
        gcs.command("MOV 1 99")
    assert type(caught.value) is kind
    assert str(code) in caught.value.what
    assert "MOV 1 99" in caught.value.what
    assert caught.value.remedy
    if isinstance(caught.value, DeviceFault):
        assert (caught.value.code, caught.value.text) == (code, error_codes.meaning_of(code))
    assert peer.requests == [b"MOV 1 99\n", b"ERR?\n"]


# ---------------------------------------------------------------------- silence and late replies


def test_a_command_is_never_repeated() -> None:
    gcs, peer = controller({b"ERR?\n": None})
    with pytest.raises(LinkTimeout) as caught:
        gcs.command("MOV 1 1")
    assert caught.value.moved == "maybe"
    assert peer.requests == [b"MOV 1 1\n", b"ERR?\n"]


def test_a_query_without_reply_is_repeated_once() -> None:
    answers = iter([None, POSITIONS])
    gcs, peer = controller({b"POS?\n": lambda: next(answers)})
    assert gcs.numbers("POS?")["2"] == 3.0
    assert gcs.interruptions == 1
    assert peer.requests == [b"POS?\n", b"*IDN?\n", b"ERR?\n", b"POS?\n"]


def test_a_refused_query_names_the_reason() -> None:
    gcs, peer = controller({b"ERR?\n": b"2\n"})
    with pytest.raises(ProtocolError, match="unknown command") as caught:
        gcs.numbers("ACC?")
    assert (caught.value.sent, caught.value.received) == (b"ACC?\n", b"2\n")
    assert peer.requests.count(b"ACC?\n") == 1


def test_half_a_reply_times_out() -> None:
    gcs, _ = controller({b"POS?\n": POSITIONS[:30]})
    with pytest.raises(LinkTimeout, match="only a part"):
        gcs.numbers("POS?")


def test_a_silent_controller_times_out_with_the_request_that_it_ignored() -> None:
    gcs, peer = controller({})
    peer.script.clear()
    with pytest.raises(LinkTimeout, match="POS"):
        gcs.numbers("POS?")


def test_a_late_reply_is_not_taken_for_the_next_ones() -> None:
    positions = iter([b"1=111.0\n", b"1=2.0\n"])
    gcs, peer = controller({b"POS?\n": lambda: next(positions), b"TMX?\n": b"1=15.0\n"})
    peer.delay_s[b"POS?\n"] = 0.15  # after the time-out, and after the line has been quiet
    assert gcs.numbers("POS?") == {"1": 2.0}
    assert gcs.numbers("TMX?") == {"1": 15.0}


def test_the_late_answer_to_a_command_does_not_answer_the_next_command() -> None:
    codes = iter([b"7\n", b"0\n", b"0\n"])
    gcs, peer = controller({b"ERR?\n": lambda: next(codes)})
    peer.delay_s[b"ERR?\n"] = 0.15
    with pytest.raises(LinkTimeout):
        gcs.command("MOV 1 99")
    gcs.command("MOV 1 1")  # would raise OutOfRange


# ---------------------------------------------------------------------- stop


def test_the_error_that_a_stop_leaves_does_not_surprise_the_next_command() -> None:
    codes = iter([b"10\n", b"0\n", b"0\n"])
    gcs, peer = controller({b"ERR?\n": lambda: next(codes)})
    gcs.stop()
    gcs.command("MOV 1 1")
    gcs.command("MOV 1 2")
    assert peer.requests == [b"\x18", b"ERR?\n", b"MOV 1 1\n", b"ERR?\n", b"MOV 1 2\n", b"ERR?\n"]


def test_an_error_of_the_command_itself_is_seen_after_a_stop() -> None:
    codes = iter([b"10\n", b"7\n"])
    gcs, _ = controller({b"ERR?\n": lambda: next(codes)})
    gcs.stop()
    with pytest.raises(OutOfRange):
        gcs.command("MOV 1 99")


@pytest.mark.parametrize("code", [b"0\n", b"10\n"])
def test_a_stop_from_within_another_exchange_takes_no_lock_and_cancels_the_command(code: bytes) -> None:
    gcs, peer = controller({})

    def stop_meanwhile() -> None:
        gcs.stop()

    peer.script[b"MOV 1 1\n"] = stop_meanwhile
    peer.script[b"ERR?\n"] = code
    with pytest.raises(MoveCancelled) as caught:
        gcs.command("MOV 1 1")
    assert caught.value.moved == "maybe"
    assert b"\x18" in peer.requests


def test_a_stop_by_somebody_else_is_told_apart() -> None:
    gcs, _ = controller({b"ERR?\n": b"10\n"})
    with pytest.raises(MoveCancelled, match="stopped by command") as caught:
        gcs.command("MOV 1 1")
    assert "somebody" in caught.value.remedy


def test_a_lost_port_is_a_link_error() -> None:
    peer = ScriptedPeer({})
    bench = Bench(peer)
    gcs = Gcs(bench.line())
    bench.wire.unplug()
    with pytest.raises(LinkError):
        gcs.identify()
