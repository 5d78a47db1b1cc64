"""The SDO client against a node that answers by the sheet, and one that does not."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.backends.canopen.aborts import SdoAbort
from microdrivers.backends.canopen.emergency import decode_emergency, error_meaning
from microdrivers.backends.canopen.objects import DEVICE_NAME, DEVICE_TYPE, Entry, real32, signed, text, unsigned
from microdrivers.core.errors import LinkLost, LinkTimeout, ProtocolError
from microdrivers.fakes.can import Frame
from tests.backends.canopen_bench import LONG, NODE, LineBench

U8, I16, F32 = unsigned(0x2000, 0, 8), signed(0x2001, 0, 16), real32(0x2003, 0)


def test_reads_the_transcripts_bytes():
    with LineBench() as bench:
        assert bench.sdo.read(DEVICE_TYPE) == 0x00020194
        assert bench.host_frames[-1] == (0x605, bytes.fromhex("4000100000000000"))
        assert (bench.sdo.read(U8), bench.sdo.read(I16), bench.sdo.read(F32)) == (0x2A, -2, -1.0)
        assert bench.sdo.read(DEVICE_NAME) == "MEASURING-AMPLIFIER"
        segments = [data for cob_id, data in bench.host_frames if cob_id == 0x605][-3:]
        assert [data[0] for data in segments] == [0x60, 0x70, 0x60]


def test_writes_what_the_sheet_says():
    with LineBench() as bench:
        bench.sdo.write(U8, 6)
        bench.sdo.write(I16, -2)
        bench.sdo.download(0x1000, 0, bytes.fromhex("A8610000"))
        sent = [data.hex().upper() for cob_id, data in bench.host_frames if cob_id == 0x605]
        assert sent == ["2F00200006000000", "2B012000FEFF0000", "23001000A8610000"]


@settings(deadline=None, max_examples=40)
@given(data=st.binary(max_size=60))
def test_any_bytes_come_back_as_they_were_written(data: bytes):
    with LineBench() as bench:
        bench.sdo.download(0x2002, 0, data)
        assert bench.node.objects[0x2002, 0] == data
        if data:
            assert bench.sdo.upload(0x2002, 0) == data


@settings(deadline=None, max_examples=60)
@given(bits=st.sampled_from([8, 16, 24, 32, 64]), values=st.data())
def test_integers_fit_exactly_into_their_bits(bits: int, values: st.DataObject):
    for entry, low, high in (
        (unsigned(0x2000, 0, bits), 0, (1 << bits) - 1),
        (signed(0x2000, 0, bits), -1 << (bits - 1), (1 << (bits - 1)) - 1),
    ):
        value = values.draw(st.integers(low, high))
        assert len(entry.encode(value)) == bits // 8
        assert entry.decode(entry.encode(value)) == value
        for beyond in (low - 1, high + 1):
            with pytest.raises(OverflowError):
                entry.encode(beyond)


def test_an_abort_names_object_and_reason():
    with LineBench() as bench:
        bench.node.aborts[0x2000, 0] = 0x06090031
        with pytest.raises(SdoAbort, match=r"node 5 refuses writing 2000h\.0: value too high \(06090031h\)") as caught:
            bench.sdo.write(U8, 200)
        assert (caught.value.index, caught.value.sub, caught.value.moved) == (0x2000, 0, "no")
        assert bench.sdo.read_optional(unsigned(0x5FFF, 0, 8)) is None
        with pytest.raises(SdoAbort, match="no such object"):
            bench.sdo.read(unsigned(0x5FFF, 0, 8))
        assert bench.sdo.read(I16) == -2  # an abort is an answer: nothing to settle
        assert len(bench.host_frames) == 4


def test_a_node_that_does_not_say_how_long_its_value_is():
    with LineBench() as bench:

        def answer(frame: Frame, t_ns: int) -> None:
            if frame.id == 0x605:
                bench.node.send(t_ns, 0x585, b"\x42" + frame.data[1:4] + b"\x2a\0\0\0")

        bench.node.silent.add((0x2000, 0))
        sdo_of_node, bench.node._sdo = bench.node._sdo, lambda data, t_ns: answer(Frame(0x605, data), t_ns)  # type: ignore[method-assign]
        assert bench.sdo.read(U8) == 0x2A
        assert bench.sdo.upload(0x2000, 0) == b"\x2a\0\0\0"
        bench.node._sdo = sdo_of_node  # type: ignore[method-assign]


def test_a_value_of_another_length_is_no_value():
    with LineBench() as bench, pytest.raises(ProtocolError, match=r"2001h\.0 has 2 bytes, not 4"):
        bench.sdo.read(unsigned(0x2001, 0, 32))


def test_silence_is_a_timeout_with_a_remedy():
    with LineBench() as bench:
        bench.node.all_silent = True
        begun_ns = bench.clock.now_ns()
        with pytest.raises(LinkTimeout, match=r"node 5, reading 1000h\.0 \(device type\).* within 100 ms") as caught:
            bench.sdo.read(DEVICE_TYPE)
        assert "node id" in caught.value.remedy
        assert "termination" in caught.value.remedy
        assert bench.clock.now_ns() - begun_ns == pytest.approx(100e6, abs=1e6)
        assert bench.host_frames[-1] == (0x605, bytes.fromhex("8000100000000405"))


def test_a_late_reply_is_not_taken_for_the_next_one():
    """The value changes between the late reply and the next request: a mix-up would show."""
    with LineBench() as bench:
        bench.node.sdo_delays_ns = [130_000_000]
        with pytest.raises(LinkTimeout):
            bench.sdo.read(U8)
        bench.node.objects[0x2000, 0] = b"\x07"
        bench.node.sdo_delays_ns = [31_000_000, 50_000_000]  # the node answers in order, and is slow
        assert bench.sdo.read(U8) == 7
        assert bench.sdo.read(U8) == 7


def test_a_late_acknowledgement_is_not_taken_for_the_next_ones():
    with LineBench() as bench:
        bench.node.sdo_delays_ns = [130_000_000]
        with pytest.raises(LinkTimeout, match="writing 2000h"):
            bench.sdo.write(U8, 1)
        bench.node.aborts[0x2000, 0] = 0x06090030
        bench.node.sdo_delays_ns = [40_000_000]
        with pytest.raises(SdoAbort):
            bench.sdo.write(U8, 2)


def test_half_a_transfer_is_no_value():
    with LineBench() as bench:
        bench.node.segments = 1
        with pytest.raises(LinkTimeout, match="reading 2002h"):
            bench.sdo.upload(0x2002, 0)
        assert bench.host_frames[-1] == (0x605, bytes.fromhex("8002200000000405"))
        bench.node.segments = None
        assert bench.sdo.upload(0x2002, 0) == LONG


def test_a_segment_that_came_twice_ends_the_transfer():
    with LineBench() as bench:
        bench.node.toggle_slip = True
        with pytest.raises(ProtocolError, match="toggle bit"):
            bench.sdo.upload(0x2002, 0)
        assert bench.host_frames[-1] == (0x605, bytes.fromhex("8002200000000305"))
        bench.node.toggle_slip = False
        assert bench.sdo.upload(0x2002, 0) == LONG


def test_a_request_past_a_transfer_disturbs_no_reply():
    """A stop by SDO between request and reply of somebody else's: its acknowledgement is nobody's."""
    with LineBench() as bench:
        bench.line.listen(0x585, lambda received: received.data[0] == 0x4F and bench.sdo.request_write(I16, 0))
        assert bench.sdo.read(U8) == 0x2A
        assert bench.sdo.read(DEVICE_NAME) == "MEASURING-AMPLIFIER"
        assert bench.node.objects[0x2001, 0] == b"\0\0"


def test_the_bus_is_unplugged_during_a_transfer():
    with LineBench() as bench:
        bench.node.on_read = lambda index, sub, t_ns: bench.medium.unplug()
        with pytest.raises(LinkLost, match="unplugged"):
            bench.sdo.read(DEVICE_TYPE)
        with pytest.raises(LinkLost):
            bench.sdo.read(DEVICE_TYPE)


def test_other_nodes_frames_are_no_answer():
    with LineBench() as bench:
        bench.node.sdo_delay_ns = 20_000_000
        bench.clock.call_at(0, lambda: None)
        bench.node.on_read = lambda index, sub, t_ns: bench.node.send(
            t_ns, 0x580 + NODE + 1, bytes.fromhex("4F00200001000000")
        )
        assert bench.sdo.read(U8) == 0x2A


def test_texts_and_emergencies():
    name: Entry[str] = text(0x1008, 0)
    assert name.decode(b"GSV-8  \0\0") == "GSV-8"
    emergency = decode_emergency(bytes.fromhex("1086200102030405"))
    assert str(decode_emergency(bytes.fromhex("1186"))) == "following error (error code 8611h)"
    assert (emergency.code, emergency.register, emergency.extra) == (0x8610, 0x20, bytes([1, 2, 3, 4, 5]))
    assert error_meaning(0x8610) == "positioning"
    assert error_meaning(0x3299) == "voltage inside"
    assert error_meaning(0xFF99) == "the device's own"
    assert decode_emergency(b"").is_over
