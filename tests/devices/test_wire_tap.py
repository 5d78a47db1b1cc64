"""How frames of a CAN bus are written down, and that nothing is where nobody listens."""

import pytest

from microdrivers.core.bus import Bus
from microdrivers.core.samples import WireTraffic
from microdrivers.devices.wire_tap import WireTap


@pytest.fixture
def heard():
    """A tap of a bus, and what a listener hears."""
    bus, samples = Bus(), []
    bus.topic("CAN can0/wire", WireTraffic).subscribe(samples.append)
    return WireTap("zoom", bus).of_bus("can0"), samples


@pytest.mark.parametrize(
    ("frame", "written"),
    [
        ((0x60B, bytes.fromhex("4000100000000000"), {}), "60B#4000100000000000"),
        ((0x080, b"", {}), "080#"),
        ((0x001, b"\xab\x0c", {}), "001#AB0C"),
        ((0x18FF0021, b"\x01", {"extended": True}), "18FF0021#01"),
        ((0x7, b"\x02", {"extended": True}), "00000007#02"),
        ((0x701, bytes(1), {"remote": True}), "701#R1"),
        ((0x12345678, b"", {"remote": True, "extended": True}), "12345678#R0"),
    ],
)
def test_frames_are_written_as_candump_writes_them(heard, frame, written):
    tap, samples = heard
    identifier, data, kind = frame
    tap.frame(7, "received", identifier, data, **kind)
    (sample,) = samples
    assert sample.data.decode() == written
    assert (sample.t_ns, sample.device, sample.direction) == (7, "CAN can0", "received")


def test_error_frames_have_the_class_as_identifier(heard):
    tap, samples = heard
    tap.error_frame(9, 0x008, bytes(8))
    tap.error_frame(10, 0x040, b"")
    assert [sample.data.decode() for sample in samples] == ["20000008#0000000000000000", "20000040#"]
    assert {sample.direction for sample in samples} == {"received"}
    assert [sample.seq for sample in samples] == [0, 1]


def test_a_tap_knows_whether_anybody_listens():
    bus = Bus()
    tap = WireTap("zoom", bus).of_bus("can0")
    assert not tap.heard
    subscription = bus.topic("CAN can0/wire", WireTraffic).subscribe(lambda sample: None)
    assert tap.heard
    subscription.cancel()
    assert not tap.heard
