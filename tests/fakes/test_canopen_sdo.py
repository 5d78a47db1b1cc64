"""The SDO server: expedited and segmented transfers, aborts, limits."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fakes.canopen_bench import KINDS, LIMITED, READ_ONLY, TEXT, WRITE_ONLY, PlainBench, hex_of


def multiplexor(index: int, sub: int = 0) -> str:
    return f"{index & 0xFF:02X} {index >> 8:02X} {sub:02X}"


def abort(index: int, code: int, sub: int = 0) -> str:
    return f"80 {multiplexor(index, sub)} {hex_of(code.to_bytes(4, 'little'))}"


def put_text(bench: PlainBench, data: bytes, *, announced: bool) -> str:
    """A segmented download; the last reply."""
    reply = bench.ask(f"{'21' if announced else '20'} {multiplexor(TEXT)} {hex_of(len(data).to_bytes(4, 'little'))}")
    assert reply == f"60 {multiplexor(TEXT)} 00 00 00 00"
    toggle = 0
    for begin in range(0, max(len(data), 1), 7):
        piece = data[begin : begin + 7]
        last = begin + 7 >= len(data)
        reply = bench.ask(hex_of(bytes((toggle | (7 - len(piece)) << 1 | last,)) + piece.ljust(7, b"\0")))
        if reply.startswith("80"):
            return reply
        assert reply == f"{0x20 | toggle:02X} 00 00 00 00 00 00 00"
        toggle ^= 0x10
    return reply


def get_text(bench: PlainBench, index: int = TEXT) -> bytes:
    """An upload, expedited or segmented."""
    reply = bytes.fromhex(bench.ask(f"40 {multiplexor(index)} 00 00 00 00"))
    if reply[0] & 2:
        return reply[4 : 8 - (reply[0] >> 2 & 3)]
    assert reply[0] == 0x41
    size, data, toggle, last = int.from_bytes(reply[4:], "little"), b"", 0, False
    while not last:
        reply = bytes.fromhex(bench.ask(f"{0x60 | toggle:02X} 00 00 00 00 00 00 00"))
        assert reply[0] & 0xF0 == toggle
        data += reply[1 : 8 - (reply[0] >> 1 & 7)]
        last, toggle = bool(reply[0] & 1), toggle ^ 0x10
    assert len(data) == size
    return data


@given(text=st.text(st.characters(min_codepoint=1, max_codepoint=255), max_size=64), announced=st.booleans())
@settings(deadline=None, max_examples=60)
def test_any_text_goes_down_and_comes_up_in_segments(text: str, announced: bool) -> None:
    bench = PlainBench()
    data = text.encode("latin-1")
    put_text(bench, data, announced=announced)
    assert get_text(bench) == data


@given(index=st.sampled_from(sorted(KINDS)), data=st.data())
@settings(deadline=None, max_examples=60)
def test_integers_of_all_sizes_are_expedited(index: int, data: st.DataObject) -> None:
    bench, kind = PlainBench(), KINDS[index]
    signed = kind.unpack(b"\xff" * kind.size) < 0
    bits = 8 * kind.size
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    value = data.draw(st.integers(low, high))
    assert bench.write(index, value, kind.size) == 0
    assert bench.read(index, signed=signed) == value


def test_a_number_may_come_in_a_segment_or_without_its_size() -> None:
    bench = PlainBench()
    assert bench.ask("21 07 21 00 04 00 00 00") == "60 07 21 00 00 00 00 00"
    assert bench.ask("07 78 56 34 12 00 00 00") == "20 00 00 00 00 00 00 00"
    assert bench.read(0x2107) == 0x12345678
    assert bench.ask("22 03 21 00 CD AB 00 00") == "60 03 21 00 00 00 00 00"
    assert bench.read(0x2103) == 0xABCD


@pytest.mark.parametrize(
    ("request_hex", "reply"),
    [
        (f"40 {multiplexor(0x5FFF)} 00 00 00 00", abort(0x5FFF, 0x06020000)),
        (f"40 {multiplexor(0x1018, 9)} 00 00 00 00", abort(0x1018, 0x06090011, 9)),
        (f"40 {multiplexor(WRITE_ONLY)} 00 00 00 00", abort(WRITE_ONLY, 0x06010001)),
        (f"2F {multiplexor(READ_ONLY)} 01 00 00 00", abort(READ_ONLY, 0x06010002)),
        (f"21 {multiplexor(READ_ONLY)} 01 00 00 00", abort(READ_ONLY, 0x06010002)),
        (f"2B {multiplexor(0x2107)} 01 00 00 00", abort(0x2107, 0x06070013)),
        (f"23 {multiplexor(0x2103)} 01 00 00 00", abort(0x2103, 0x06070012)),
        (f"21 {multiplexor(0x2103)} 09 00 00 00", abort(0x2103, 0x06070012)),
        (f"21 {multiplexor(TEXT)} 41 00 00 00", abort(TEXT, 0x06070012)),
        (f"2B {multiplexor(LIMITED)} 65 00 00 00", abort(LIMITED, 0x06090031)),
        (f"2B {multiplexor(LIMITED)} 9B FF 00 00", abort(LIMITED, 0x06090032)),
        (f"A0 {multiplexor(TEXT)} 00 00 00 00", abort(TEXT, 0x05040001)),  # block transfer
        ("60 00 00 00 00 00 00 00", "80 00 00 00 01 00 04 05"),  # a segment of nothing
        ("00 00 00 00 00 00 00 00", "80 00 00 00 01 00 04 05"),
        ("80 00 20 00 00 00 04 05", ""),  # the client's own abort
        ("40 00 10 00", ""),  # not 8 bytes
    ],
)
def test_what_cannot_be_done_is_aborted_with_its_reason(request_hex: str, reply: str) -> None:
    bench = PlainBench()
    assert bench.ask(request_hex) == reply
    assert bench.read(0x1000) == 0x00030191


def test_a_toggle_that_does_not_alternate_ends_the_transfer() -> None:
    bench = PlainBench()
    bench.node.dictionary[TEXT, 0].value = "longer than one segment"
    assert bench.ask(f"40 {multiplexor(TEXT)} 00 00 00 00").startswith("41")
    bench.ask("60 00 00 00 00 00 00 00")
    assert bench.ask("60 00 00 00 00 00 00 00") == abort(TEXT, 0x05030000)
    assert bench.ask("70 00 00 00 00 00 00 00") == "80 00 00 00 01 00 04 05"


@pytest.mark.parametrize(("size", "code"), [(3, 0x06070012), (12, 0x06070013)])
def test_more_or_fewer_bytes_than_announced_change_nothing(size: int, code: int) -> None:
    bench = PlainBench()
    bench.ask(f"21 {multiplexor(TEXT)} {size:02X} 00 00 00")
    assert bench.ask("05 61 62 63 64 65 00 00") == abort(TEXT, code)
    assert get_text(bench) == b""


def test_a_text_that_is_too_long_is_noticed_without_its_size() -> None:
    bench = PlainBench()
    assert put_text(bench, bytes(65), announced=False) == abort(TEXT, 0x06070012)


def test_half_a_transfer_is_given_up_after_a_second() -> None:
    bench = PlainBench()
    bench.ask(f"21 {multiplexor(TEXT)} 20 00 00 00")
    bench.ask("00 61 62 63 64 65 66 67")
    assert bench.wait_ms(999) == []
    (frame,) = bench.wait_ms(2)
    assert frame.id == 0x589
    assert hex_of(frame.data) == abort(TEXT, 0x05040000)
    assert bench.ask("10 61 62 63 64 65 66 67").startswith("80")


def test_a_new_request_takes_the_place_of_half_a_transfer() -> None:
    bench = PlainBench()
    bench.ask(f"21 {multiplexor(TEXT)} 20 00 00 00")
    assert bench.read(0x1000) == 0x00030191
    assert bench.wait_ms(3000) == []


@pytest.mark.parametrize("request_hex", [f"40 {multiplexor(TEXT)} 00 00 00 00", f"21 {multiplexor(TEXT)} 08 00 00 00"])
def test_half_a_transfer_ends_in_time_unless_something_else_is_read(request_hex: str) -> None:
    bench = PlainBench()
    bench.node.dictionary[TEXT, 0].value = "longer than four bytes"
    for reads in (False, True):
        assert bench.ask(request_hex)
        if reads:
            bench.read(0x2101)
        assert [hex_of(frame.data) for frame in bench.wait_ms(1500)] == ([] if reads else [abort(TEXT, 0x05040000)])
    assert bench.node.next_event_ns() is None


def test_an_upload_is_of_one_instant() -> None:
    bench = PlainBench()
    bench.node.dictionary[TEXT, 0].value = "the first value"
    bench.ask(f"40 {multiplexor(TEXT)} 00 00 00 00")
    bench.node.dictionary[TEXT, 0].value = "the second value"
    first = bytes.fromhex(bench.ask("60 00 00 00 00 00 00 00"))[1:]
    second = bytes.fromhex(bench.ask("70 00 00 00 00 00 00 00"))[1:]
    assert first + second == b"the first valu"
