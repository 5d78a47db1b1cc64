"""Three emulated single-axis controllers on one line: addresses, states of their own, replies that do not mix."""

from __future__ import annotations

import itertools
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.units import NS_PER_S
from microdrivers.fakes.pi_gcs.controller import REPLY_DELAY_S
from tests.fakes.gcs_bench import BYTE_NS, BenchWorld, ChainBench

IDENTIFICATION = b"(c)2015 Physik Instrumente(PI) Karlsruhe, C-863.12,%s,1.2.0.0\n"


@pytest.fixture
def bench() -> ChainBench:
    return ChainBench()


@pytest.fixture
def ready() -> ChainBench:
    bench = ChainBench()
    bench.reference()
    return bench


# ---------------------------------------------------------------------- addresses


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        (b"*IDN?\n", IDENTIFICATION % b"0115500620"),
        (b"1 *IDN?\n", b"0 1 " + IDENTIFICATION % b"0115500620"),
        (b"2 *IDN?\n", b"0 2 " + IDENTIFICATION % b"0119012345"),
        (b"3 0 *IDN?\n", b"0 3 " + IDENTIFICATION % b"0115500622"),
        (b"POS? 1\n", b"1=0.0000000\n"),
        (b"2 POS? 1\n", b"0 2 1=0.0000000\n"),
        (b"3 7 POS?\n", b"7 3 1=0.0000000\n"),
        (b"SAI? ALL\n", b"1\n"),
        (b"3 SAI?\n", b"0 3 1\n"),
        (b"2 CST?\n", b"0 2 1=M-111.1DG\n"),
        (b"3 CST?\n", b"0 3 1=M-116.DG\n"),
        (b"3 TMX? 1\n", b"0 3 1=180.0000000\n"),
        (b"2 TIO?\n", b"0 2 I=4 \nO=4\n"),
        (b"4 CSV?\n", b""),
        (b"0 CSV?\n", b""),
        (b"16 CSV?\n", b""),
        (b"\x07", b"\xb1\n"),
        (b"2 \x07", b"0 2 \xb1\n"),
        (b"2 \x07\n", b"0 2 \xb1\n"),
        (b"3 0 \x04\n", b"0 3 0x0002\n"),
        (b"1 \x04", b"0 1 0x0000\n"),
        (b"2 \x05\n3 \x05\n1 \x05\n", b"0 2 0\n0 3 0\n0 1 0\n"),
        (b"5 \x04\n", b""),
        (b"\n\n2\n2 0\n2 CSV?\n", b"0 2 2.0\n"),
    ],
)
def test_addresses(bench: ChainBench, request_: bytes, reply: bytes) -> None:
    # Each request by itself: replies of different controllers may come in another order.
    requests = re.findall(rb"[^\n\x04\x05\x07]*[\n\x04\x05\x07]", request_)
    answer = b""
    for request in requests:
        bench.wait(0.01)
        answer += bench.ask(request)
    assert answer == reply


@pytest.mark.parametrize("line_feed", [b"\n", b""])
def test_a_single_byte_uses_its_address_up(bench: ChainBench, line_feed: bytes) -> None:
    bench.ask(b"2 \x07" + line_feed)
    bench.wait(0.01)
    assert bench.ask(b"CSV?\n") == b"2.0\n"
    bench.ask(b"2 \x07" + line_feed)
    bench.wait(0.01)
    assert bench.ask(b"3 CSV?\n") == b"0 3 2.0\n"


def test_only_the_first_line_of_a_reply_carries_addresses(bench: ChainBench) -> None:
    first, *others = bench.line("2 HLP?").split(" \n")
    assert first == "0 2 The following commands are valid:"
    assert others[-1] == "end of help"
    assert not [line for line in others if line.startswith("0 2")]


def test_what_one_controller_is_told_the_others_do_not_hear(ready: ChainBench) -> None:
    assert ready.error_after(2, "MOV 1 8.5") == 0
    assert ready.line("2 \x05") == "0 2 1"
    assert ready.line("\x05") == "0"
    assert ready.line("3 \x05") == "0 3 0"
    ready.wait(2.0)
    assert ready.line("2 POS? 1") == "0 2 1=8.5000000"
    assert ready.true_position("x") == pytest.approx(7500.0, abs=0.1)
    assert ready.true_position("y") == pytest.approx(8500.0, abs=0.1)
    ready.line("3 SVO 1 0")
    assert [ready.line(f"{address} SVO? 1")[-1] for address in (1, 2, 3)] == ["1", "1", "0"]
    ready.line("2 SPA 1 0x36 9")
    assert ready.line("SPA? 1 0x36") == "1 0x36=3"


def test_error_registers_are_separate(bench: ChainBench) -> None:
    bench.line("MOV 1 1")
    bench.line("2 FOO")
    bench.line("3 POS? 2")
    assert bench.line("2 \x04") == "0 2 0x0102"
    assert [bench.error(address) for address in (1, 2, 3)] == [5, 2, 15]
    assert [bench.error(address) for address in (1, 2, 3)] == [0, 0, 0]
    bench.line("2 " + "x" * 300)
    assert [bench.error(address) for address in (1, 2, 3)] == [0, 3, 0]


@pytest.mark.parametrize(
    ("stop", "code"), [(b"2 \x18", 10), (b"2 \x18\n", 10), (b"2 STP\n", 10), (b"2 HLT 1\n", 10), (b"2 HLT\n", 10)]
)
def test_a_stop_stops_the_controller_that_it_is_meant_for(ready: ChainBench, stop: bytes, code: int) -> None:
    for address in (1, 2, 3):
        ready.line(f"{address} MOV 1 5")
    ready.wait(0.05)
    ready.put(stop)
    ready.wait(0.1)
    assert [ready.line(f"{address} \x05")[-1] for address in (1, 2, 3)] == ["1", "0", "1"]
    assert [ready.error(address) for address in (1, 2, 3)] == [0, code, 0]


def test_an_unaddressed_stop_is_for_the_first_controller_alone(ready: ChainBench) -> None:
    ready.line("1 MOV 1 0")
    ready.line("2 MOV 1 0")
    ready.put(b"\x18")
    ready.wait(0.1)
    assert [ready.line(f"{address} \x05")[-1] for address in (1, 2)] == ["0", "1"]


@pytest.mark.parametrize("stop", [b"255 \x18", b"255 \x18\n", b"255 STP\n"])
def test_a_broadcast_reaches_all_and_nobody_answers(ready: ChainBench, stop: bytes) -> None:
    for address in (1, 2, 3):
        ready.line(f"{address} MOV 1 5")
    ready.wait(0.05)
    assert ready.ask(stop) == b""
    assert ready.ask(b"255 POS? 1\n") == b""
    ready.wait(0.1)
    assert [ready.line(f"{address} \x05")[-1] for address in (1, 2, 3)] == ["0", "0", "0"]
    assert [ready.error(address) for address in (1, 2, 3)] == [10, 10, 10]


# ---------------------------------------------------------------------- one element a line


@pytest.mark.parametrize(
    "command",
    [
        "MOV 1 8 2 8",
        "MVR 1 0.1 1 0.1",
        "SVO 1 1 1 1",
        "POS? 1 2",
        "SPA 1 0x36 4 1 0x3F 1",
        "SPA? 1 0x36 1 0x3F",
        "SEP 100 1 0x32 0 1 0x14 1",
        "VEL 1 1 2 1",
        "FRF 1 1",
        "HLT 1 1",
        "SRG? 1 1 1 1",
        "CTO 1 3 0 2 3 0",
    ],
)
def test_more_than_one_axis_or_parameter_in_a_line_is_refused(ready: ChainBench, command: str) -> None:
    assert ready.error_after(2, command) == 24
    assert ready.line("2 MOV? 1") == "0 2 1=7.5000000"
    assert ready.line("2 SPA? 1 0x36") == "0 2 1 0x36=3"


@pytest.mark.parametrize("query", ["POS?", "SVO?", "SPA?", "SRG?", "CTO?", "TRO?"])
def test_a_line_without_arguments_is_for_everything(bench: ChainBench, query: str) -> None:
    assert bench.line(f"2 {query}").startswith("0 2 1")
    assert bench.error(2) == 0


# ---------------------------------------------------------------------- time and order


def test_each_position_is_sampled_after_its_own_request() -> None:
    bench = ChainBench(BenchWorld(latch_delay_s=0.0004))
    bench.reference()
    for address in (1, 2, 3):
        bench.line(f"{address} MOV 1 0")
    bench.wait(0.2)
    begin_ns = bench.t_ns
    replies = sorted(reply.data for reply in bench.put(b"1 POS? 1\n2 POS? 1\n3 POS? 1\n"))
    for place, (key, per_unit) in enumerate((("x", 1000.0), ("y", 1000.0), ("theta", 1.0)), start=1):
        latch_ns = begin_ns + 9 * place * BYTE_NS + 400_000
        read = float(replies[place - 1].removeprefix(b"0 %d 1=" % place)) * per_unit
        assert read == pytest.approx(bench.world.stage_axes[key].position_at(latch_ns), abs=0.0251)


def test_replies_come_in_the_order_in_which_they_are_ready() -> None:
    orders = set()
    for seed in range(40):
        bench = ChainBench(seed=seed)
        begin_ns = bench.t_ns
        replies = bench.put(b"1 CSV?\n2 CSV?\n3 CSV?\n")
        times = [reply.t_ns for reply in replies]
        assert times == sorted(times)
        orders.add(tuple(int(reply.data[2:3]) for reply in replies))
        for reply in replies:
            asked_ns = begin_ns + int(reply.data[2:3]) * 7 * BYTE_NS
            assert REPLY_DELAY_S[0] <= (reply.t_ns - asked_ns) / NS_PER_S <= REPLY_DELAY_S[1]
    assert (1, 2, 3) in orders
    assert len(orders) > 3


def test_replies_of_one_controller_keep_the_order_of_its_requests() -> None:
    for seed in range(20):
        replies = ChainBench(seed=seed).put(b"2 CSV?\n2 \x072 SAI?\n2 \x05\n2 ERR?\n")
        assert [reply.data[4:] for reply in replies] == [b"2.0\n", b"\xb1\n", b"1\n", b"0\n", b"0\n"]


def test_replies_that_are_not_ready_wait_for_others_that_are() -> None:
    data = b"1 CSV?\n2 CSV?\n3 CSV?\n1 \x072 \x073 \x07" * 3
    for seed in range(10):
        whole = ChainBench(seed=seed).put(data)
        chain = ChainBench(seed=seed).chain
        byte_by_byte = []
        for place in range(len(data)):
            t_ns = NS_PER_S + place * BYTE_NS
            byte_by_byte += chain.advance(t_ns)
            byte_by_byte += chain.receive(data[place : place + 1], t_ns, t_ns + BYTE_NS)
        byte_by_byte += chain.advance(100 * NS_PER_S)
        assert byte_by_byte == whole
        assert len(whole) == 18


@settings(deadline=None, derandomize=True, max_examples=40)
@given(
    requests=st.lists(
        st.sampled_from(
            [
                b"1 POS? 1\n",
                b"2 \x04",
                b"2 \x07\n",
                b"3 SVO 1 1\n",
                b"3 FRF\n",
                b"ERR?\n",
                b"\x05",
                b"255 \x18",
                b"2 HL",
            ]
        ),
        max_size=20,
    ),
    cuts=st.lists(st.integers(0, 160), max_size=20),
)
def test_fragments_change_nothing(requests: list[bytes], cuts: list[int]) -> None:
    data = b"".join(requests)
    whole = ChainBench(BenchWorld(noise_um=0.05)).put(data)
    chain = ChainBench(BenchWorld(noise_um=0.05)).chain
    in_pieces = []
    edges = sorted({0, len(data), *(cut for cut in cuts if cut < len(data))})
    for start, end in itertools.pairwise(edges):
        start_ns, end_ns = NS_PER_S + start * BYTE_NS, NS_PER_S + end * BYTE_NS
        in_pieces += chain.advance(start_ns)
        in_pieces += chain.receive(data[start:end], start_ns, end_ns)
    in_pieces += chain.advance(NS_PER_S * 100)
    assert in_pieces == whole


# ---------------------------------------------------------------------- power, faults


def test_one_controller_loses_its_power(ready: ChainBench) -> None:
    for address in (1, 2, 3):
        ready.line(f"{address} MOV 1 8")
    ready.wait(0.1)
    ready.put(b"2 POS?")
    ready.chain.boxes["y"].power_cycle(ready.t_ns)
    ready.wait(5.0)
    assert ready.line("2 SVO?") == "0 2 1=0"
    assert ready.line("2 FRF?") == "0 2 1=0"
    assert ready.line("2 POS?") == "0 2 1=0.0000000"
    assert ready.line("1 POS?") == "0 1 1=8.0000000"
    assert [ready.line(f"{address} FRF?")[-1] for address in (1, 3)] == ["1", "1"]
    assert ready.chain.boxes["y"].events[-1][1] == "power cycle"
    assert "power cycle" not in [text for _, text in ready.chain.boxes["x"].events]


def test_all_lose_their_power(ready: ChainBench) -> None:
    ready.chain.power_cycle(ready.t_ns)
    assert [ready.line(f"{address} FRF?")[-1] for address in (1, 2, 3)] == ["0", "0", "0"]


def test_events_of_all_controllers_in_the_order_of_time(ready: ChainBench) -> None:
    begin_ns = ready.t_ns
    ready.put(b"3 MOV 1 2\n1 MOV 1 7.1\n2 MOV 1 7.2\n255 \x18")
    assert [(t_ns - begin_ns, text) for t_ns, text in ready.chain.events[-6:]] == [
        (10 * BYTE_NS, "move theta 2"),
        (22 * BYTE_NS, "move x 7.1"),
        (34 * BYTE_NS, "move y 7.2"),
        *[(39 * BYTE_NS, "stop #24")] * 3,
    ]


def test_a_motion_error_is_one_controllers_alone(ready: ChainBench) -> None:
    ready.line("2 MOV 1 9")
    ready.chain.motion_error("y", ready.t_ns)
    assert [ready.line(f"{address} SVO?")[-1] for address in (1, 2, 3)] == ["1", "0", "1"]
    assert [ready.error(address) for address in (1, 2, 3)] == [0, 1024, 0]


def test_a_reversed_axis_is_converted_at_the_boundary() -> None:
    bench = ChainBench(direction=-1)
    bench.reference()
    assert bench.line("2 TMN? 1") == "0 2 1=-15.0000000"
    assert bench.line("2 POS? 1") == "0 2 1=-7.5000000"
