"""The emulated controller's language: golden transcript, every error, addresses, and any bytes at all."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.units import NS_PER_S
from microdrivers.fakes.wire import Reply
from tests.fakes.gcs_bench import NOT_READY, READY, BenchWorld, GcsBench

IDENTIFICATION = b"(c)2016 Physik Instrumente (PI) GmbH & Co. KG, C-884.4DC, 116012345, 1.2.0.5\n"


@pytest.fixture
def bench() -> GcsBench:
    return GcsBench()


@pytest.fixture
def ready() -> GcsBench:
    bench = GcsBench()
    bench.reference()
    return bench


# ---------------------------------------------------------------------- golden transcript

STARTUP = [
    (b"CSV?\n", b"2.0\n"),
    (b"ERR?\n", b"0\n"),
    (b"*IDN?\n", IDENTIFICATION),
    (b"SAI?\n", b"1 \n2 \n3\n"),
    (b"SAI? ALL\n", b"1 \n2 \n3\n"),
    (b"CST?\n", b"1=M-111.1DG \n2=M-111.1DG \n3=M-116.DG\n"),
    (b"VER?\n", b"FW_DSP: 01.002\n"),
    (b"\x18", b""),
    (b"ERR?\n", b"10\n"),
    (b"\x07", READY),
    (b"ERR?\n", b"0\n"),
    (b"SVO? 1\n", b"1=0\n"),
    (b"FRF? 1\n", b"1=0\n"),
    (b"RON 1 1\n", b""),
    (b"FRF 1\n", b""),
    (b"ERR?\n", b"5\n"),
    (b"SVO 1 1\n", b""),
    (b"ERR?\n", b"0\n"),
    (b"FRF 1\n", b""),
    (b"ERR?\n", b"0\n"),
]
REFERENCED = [
    (b"ERR?\n", b"0\n"),
    (b"FRF? 1\n", b"1=1\n"),
    (b"SVO 1 1\n", b""),
    (b"\x07", READY),
    (b"ERR?\n", b"0\n"),
    (b"TMN?\n", b"1=0.0000000 \n2=0.0000000 \n3=-180.0000000\n"),
    (b"TMX?\n", b"1=15.0000000 \n2=15.0000000 \n3=180.0000000\n"),
    (b"VEL 1 1.5\n", b""),
    (b"ERR?\n", b"0\n"),
    (b"MOV 1 8.5\n", b""),
    (b"ERR?\n", b"0\n"),
    (b"\x07", READY),
    (b"SVO? 1\n", b"1=1\n"),
    (b"ONT? 1\n", b"1=0\n"),
    (b"\x05", b"1\n"),
]
ARRIVED = [
    (b"ONT? 1\n", b"1=1\n"),
    (b"ERR?\n", b"0\n"),
    (b"POS? 1\n", b"1=8.5000000\n"),
    (b"\x05", b"0\n"),
    (b"MOV 1 99\n", b""),
    (b"ERR?\n", b"7\n"),
    (b"MVR 1 -5e-05\n", b""),
    (b"ERR?\n", b"0\n"),
]
HALTED = [
    (b"POS? 1\n", b"1=8.4999500\n"),
    (b"MOV 1 1\n", b""),
    (b"ERR?\n", b"0\n"),
    (b"HLT 1\n", b""),
    (b"ERR?\n", b"10\n"),
    (b"\x18", b""),
    (b"ERR?\n", b"10\n"),
    (b"ERR?\n", b"0\n"),
    (b"SPA? 1 1\n", b"1 1=200\n"),
    (b"SPA? 1 60\n", b"1 60=M-111.1DG\n"),
    (b"SPA? 1 0x3C\n", b"1 0x3C=M-111.1DG\n"),
    (b"SVO 1 0\n", b""),
    (b"ERR?\n", b"0\n"),
    (b"MOV 1 1\n", b""),
    (b"ERR?\n", b"5\n"),
]


def replay(bench: GcsBench, transcript: list[tuple[bytes, bytes]]) -> None:
    for request, reply in transcript:
        bench.wait(0.003)
        assert bench.ask(request) == reply, request


def test_golden_transcript(bench: GcsBench) -> None:
    replay(bench, STARTUP)
    polls = 0
    while (state := bench.ask(b"\x07")) == NOT_READY:
        bench.wait(0.1)
        polls += 1
    assert state == READY
    # 1.5 mm to the switch at 0.75 mm/s.
    assert 20 <= polls <= 22
    replay(bench, REFERENCED)
    bench.wait(1.0)
    replay(bench, ARRIVED)
    bench.wait(0.1)
    replay(bench, HALTED)


def test_several_axes_in_a_line(ready: GcsBench) -> None:
    assert ready.error_after("MOV 1 7.1 2 3.2 3 -0.333333333333") == 0
    ready.wait(5.0)
    assert ready.line("POS?") == "1=7.1000000 \n2=3.2000000 \n3=-0.3333150"
    assert ready.line("POS? 3 1") == "3=-0.3333150 \n1=7.1000000"
    assert ready.line("MOV? 2 3") == "2=3.2000000 \n3=-0.3333333"
    assert ready.error_after("MOV 1 1e-07") == 0


def test_help_lists_what_clients_rely_on(bench: GcsBench) -> None:
    first, *rows, last = bench.line("HLP?").split(" \n")
    assert (first, last) == ("The following commands are valid:", "end of help")
    names = {row.split()[0] for row in rows}
    asked_for = "*IDN? CSV? HLP? VER? SAI? CST? SVO SVO? RON RON? FRF FNL FPL FRF? POS POS? MOV MOV? MVR ONT? TMN?"
    asked_for += " TMX? VEL VEL? ACC ACC? DEC DEC? HLT STP ERR? SPA SPA? HPA? TRS? LIM? RBT #4 #5 #7 #8 #24"
    asked_for += " SAI SRG? SEP SEP? WPA RPA CTO CTO? DIO DIO? TIO? TRO TRO?"
    assert names == set(asked_for.split())


def test_every_command_in_the_help_is_known(bench: GcsBench) -> None:
    rows = bench.line("HLP?").split(" \n")[1:-1]
    for name in (row.split()[0] for row in rows):
        if not name.startswith("#"):
            bench.line(name)
            assert bench.error() != 2


def test_parameter_list(bench: GcsBench) -> None:
    *rows, last = bench.line("HPA?").split(" \n")
    assert last == "end of help"
    kinds = {row.split("=")[0]: row.split("\t")[3] for row in rows}
    assert (kinds["0x1"], kinds["0x3C"], kinds["0x3F"]) == ("INT", "CHAR", "FLOAT")
    shown = bench.line("SPA?").split(" \n")
    assert len(shown) == 3 * len(rows)
    assert "1 0x36=3" in shown
    assert "3 0xE=200000" in shown
    assert "3 0xF=9" in shown


@pytest.mark.parametrize(
    ("query", "reply"),
    [
        ("SVO?", "1=0 \n2=0 \n3=0"),
        ("RON? 2", "2=1"),
        ("TRS? 1 3", "1=1 \n3=1"),
        ("LIM? 1", "1=1"),
        ("VEL? 1 3", "1=0.7500000 \n3=5.0000000"),
        ("ACC? 1", "1=20.0000000"),
        ("DEC? 3", "3=100.0000000"),
        ("POS?", "1=0.0000000 \n2=0.0000000 \n3=0.0000000"),
        ("mov? 1", "1=0.0000000"),
        ("*idn?", IDENTIFICATION.decode().strip()),
        ("  TRS?   1\t2 ", "1=1 \n2=1"),
        ("SAI? all", "1 \n2 \n3"),
    ],
)
def test_queries_at_power_on(bench: GcsBench, query: str, reply: str) -> None:
    assert bench.line(query) == reply
    assert bench.error() == 0


# ---------------------------------------------------------------------- addresses and single bytes


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        (b"1 POS? 1\n", b"0 1 1=0.0000000\n"),
        (b"1 0 SVO?\n", b"0 1 1=0 \n2=0 \n3=0\n"),
        (b"1 5 CSV?\n", b"5 1 2.0\n"),
        (b"2 CSV?\n", b""),
        (b"2 0 MOV\n1 ERR?\n", b"0 1 0\n"),
        (b"2 " + b"x" * 300 + b"\nERR?\n", b"0\n"),
        (b"1\nERR?\n", b"0\n"),
        (b"1 \x07\n", b"0 1 \xb1\n"),
        (b"2 \x07\n", b""),
        (b"1 0 \x05\n", b"0 1 0\n"),
        (b"\n\n \nCSV?\n", b"2.0\n"),
    ],
)
def test_addresses(bench: GcsBench, request_: bytes, reply: bytes) -> None:
    assert bench.ask(request_) == reply


@pytest.mark.parametrize("place", range(6))
def test_single_bytes_act_anywhere_in_a_line(bench: GcsBench, place: int) -> None:
    for byte, reply in ((b"\x05", b"0\n"), (b"\x07", READY), (b"\x08", b"0\n"), (b"\x18", b"")):
        line = b"TRS? 1"
        assert bench.ask(line[:place] + byte + line[place:] + b"\n") == reply + b"1=1\n"
    assert bench.error() == 10


def test_single_bytes_act_in_a_line_that_is_too_long(bench: GcsBench) -> None:
    assert bench.ask(b"x" * 1000 + b"\x18") == b""
    assert bench.controller.events[-1][1] == "stop #24"
    assert bench.ask(b"\nERR?\n") == b"3\n"


def test_status_register(ready: GcsBench) -> None:
    assert ready.ask(b"\x04") == b"0x900290029002\n"
    ready.line("FOO")
    assert ready.ask(b"\x04") == b"0x910291029102\n"
    ready.error()
    ready.line("MOV 1 0 2 15")
    ready.line("SVO 3 0")
    assert ready.ask(b"\x04") == b"0x300030020002\n"
    assert ready.ask(b"\x05") == b"3\n"
    ready.wait(10.0)
    assert ready.ask(b"\x04") == b"0x900190060002\n"
    ready.line("FRF 1")
    assert ready.ask(b"\x04") == b"0x700190060002\n"


def test_the_status_register_by_its_name(ready: GcsBench) -> None:
    assert ready.line("SRG? 1 1") == "1 1=0x9002"
    ready.line("MOV 2 0")
    ready.line("SVO 3 0")
    ready.line("FOO")
    assert ready.line("SRG?") == "1 1=0x9102 \n2 1=0x3100 \n3 1=0x0102"
    assert ready.error_after("SRG? 1 2") == 17
    assert ready.error_after("SRG? 1") == 26
    assert ready.error_after("SRG? 4 1") == 15


def test_switches_that_a_stage_lacks_show_nothing(ready: GcsBench) -> None:
    ready.line("MOV 1 15 2 0")
    ready.wait(10.0)
    assert ready.ask(b"\x04") == b"0x900690019002\n"
    ready.line("SPA 1 0x32 1 1 0x14 0 2 0x32 1 3 0x14 0")
    assert ready.ask(b"\x04") == b"0x900090009000\n"


# ---------------------------------------------------------------------- any bytes at all

VOCABULARY = """SVO MOV MVR VEL ACC DEC FRF FNL FPL POS POS? RON HLT STP ERR? SPA SPA? ONT? HLP? HPA? RBT
SRG? SEP WPA RPA CTO CTO? DIO DIO? TRO 100
1 2 3 4 0 -1 1e300 7.25 1e-7 0.3 0.002 14.9 0x36 0x3F 0x15 0x50"""
WORDS = st.sampled_from(VOCABULARY.split())
SINGLES = st.sampled_from([b"\x04", b"\x05", b"\x07", b"\x08", b"\x18"])
LINES = st.lists(WORDS, min_size=1, max_size=5).map(lambda words: " ".join(words).encode() + b"\n")
SENSIBLE = st.sampled_from(
    [b"SVO 1 1 2 1 3 1\n", b"FRF\n", b"RON 1 0\n", b"POS 1 3\n", b"MOV 1 3 2 4 3 5\n", b"MVR 1 1\n", b"POS?\n"]
)
REQUESTS = st.lists(LINES | SENSIBLE | SINGLES | st.binary(max_size=12), max_size=25)


@settings(deadline=None, derandomize=True, max_examples=100)
@given(requests=REQUESTS, pauses=st.lists(st.floats(0.0, 3.0), min_size=25, max_size=25))
def test_no_bytes_break_it(requests: list[bytes], pauses: list[float]) -> None:
    bench = GcsBench(BenchWorld(lost_motion_um=0.5))
    last_ns = 0
    for request, pause in zip(requests, pauses, strict=False):
        bench.wait(pause)
        for reply in bench.put(request):
            assert reply.data.endswith(b"\n")
            assert reply.t_ns >= last_ns
            last_ns = reply.t_ns
    bench.wait(30.0)
    bench.ask(b"\n\x18ERR?\n")
    assert bench.line("ERR?") == "0"
    assert len(bench.line("POS?").split(" \n")) == 3
    for key, end in (("x", 15000.0), ("y", 15000.0)):
        assert -1.0 <= bench.true_position(key) <= end + 1.0


@settings(deadline=None, derandomize=True, max_examples=60)
@given(requests=REQUESTS, cuts=st.lists(st.integers(0, 400), max_size=30))
def test_fragments_change_nothing(requests: list[bytes], cuts: list[int]) -> None:
    data = b"".join(requests)
    byte_ns = 1000
    whole = GcsBench(BenchWorld(noise_um=0.05)).controller.receive(data, NS_PER_S, NS_PER_S + len(data) * byte_ns)
    in_pieces: list[Reply] = []
    controller = GcsBench(BenchWorld(noise_um=0.05)).controller
    edges = sorted({0, len(data), *(cut for cut in cuts if cut < len(data))})
    for start, end in itertools.pairwise(edges):
        in_pieces += controller.receive(data[start:end], NS_PER_S + start * byte_ns, NS_PER_S + end * byte_ns)
    assert in_pieces == list(whole)
