"""Bits of a frame, against frames that are written out, and against a second way of counting."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.errors import OutOfRange
from microdrivers.fakes.can import Frame, frame_bits
from microdrivers.fakes.can.frame import arbitration_rank, crc15

TAIL = "1" + "01" + "1111111"  # CRC delimiter, acknowledge, end of frame


def test_check_value_of_the_crc() -> None:
    assert crc15(b"123456789") == 0x059E  # of CRC-15/CAN


# Written out: start, identifier, RTR + IDE + r0, DLC, data, CRC; "|" stands before each stuff bit.
WRITTEN_OUT = [
    # The CRC of zeros is zero: a stuff bit after every fifth of 34.
    (Frame(0x000), "0 0000|100000|100 000|1 0000 0|100000|100000|10000"),
    # x^29 modulo x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1 is 1C05h.
    (Frame(0x080), "0 000100000|100 000|1 0000 0|1011100000|100101"),
    (Frame(0x701, b"\x05"), "0 11100000|1001 000 00|101 00000|1101 100110100001110"),
]


@pytest.mark.parametrize(("frame", "stream"), WRITTEN_OUT)
def test_frames_that_are_written_out(frame: Frame, stream: str) -> None:
    on_the_bus = stream.replace("|", "").replace(" ", "") + TAIL
    assert frame_bits(frame) == len(on_the_bus)


def test_longest_and_shortest_frames() -> None:
    # The sheets' figures, with the interframe space: 111 to 135 bits for 8 bytes.
    assert frame_bits(Frame(0x7FF, b"\x55" * 8)) + 3 >= 111
    assert frame_bits(Frame(0x000, bytes(8))) + 3 <= 135
    assert frame_bits(Frame(0x1AA, remote=True)) < frame_bits(Frame(0x1AA, b"\x55"))


def second_count(frame: Frame) -> tuple[str, str]:
    """The bits from start of frame to CRC, plain and stuffed, as strings; division on paper, rule by rule."""
    rtr = "1" if frame.remote else "0"
    data = b"" if frame.remote else frame.data
    if frame.extended:
        bits = f"{frame.id:029b}"
        bits = "0" + bits[:11] + "11" + bits[11:] + rtr + "00"
    else:
        bits = "0" + f"{frame.id:011b}" + rtr + "00"
    bits += f"{len(frame.data):04b}" + "".join(f"{octet:08b}" for octet in data)
    remainder = int(bits, 2) << 15
    for place in reversed(range(15, remainder.bit_length())):
        if remainder >> place & 1:
            remainder ^= 0b1100010110011001 << place - 15
    plain = bits + f"{remainder:015b}"
    stuffed = ""
    for bit in plain:
        stuffed += bit
        if len(stuffed) >= 5 and len({*stuffed[-5:]}) == 1:
            stuffed += "10"[int(bit)]
    return plain, stuffed


frames = st.builds(
    lambda extended, identifier, data, remote: Frame(
        identifier & (0x1FFFFFFF if extended else 0x7FF), data, extended, remote
    ),
    st.booleans(),
    st.integers(0, 0x1FFFFFFF) | st.sampled_from([0, 0x1FFFFFFF, 0x1F, 0x1FFFFFE0]),
    st.binary(max_size=8) | st.lists(st.sampled_from([0x00, 0xFF, 0xF8, 0x07]), max_size=8).map(bytes),
    st.booleans(),
)


@settings(deadline=None, max_examples=200)
@given(frames)
def test_bits_of_any_frame(frame: Frame) -> None:
    plain, stuffed = second_count(frame)
    assert frame_bits(frame) == len(stuffed) + len(TAIL)
    assert len(stuffed) - len(plain) <= (len(plain) - 1) // 4


@settings(deadline=None, max_examples=200)
@given(frames, frames)
def test_arbitration_is_decided_by_the_first_bit_that_differs(one: Frame, other: Frame) -> None:
    def field(frame: Frame) -> str:
        plain, _ = second_count(frame)
        return plain[:33] if frame.extended else plain[:14].ljust(33, "0")  # start to RTR; or to IDE

    assert (arbitration_rank(one) < arbitration_rank(other)) == (field(one) < field(other))


def test_ranks_of_one_identifier() -> None:
    data, remote, extended = Frame(0x123), Frame(0x123, remote=True), Frame(0x123 << 18, extended=True)
    ranks = [arbitration_rank(frame) for frame in (data, remote, extended)]
    assert all(a < b for a, b in itertools.pairwise(ranks))


@pytest.mark.parametrize("frame", [Frame(0x800), Frame(-1), Frame(0x20000000, extended=True), Frame(0x100, bytes(9))])
def test_no_classic_frame(frame: Frame) -> None:
    with pytest.raises(OutOfRange, match="no classic CAN frame"):
        frame_bits(frame)
