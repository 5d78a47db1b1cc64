"""A serial CAN adapter read and written in bulk, on a pseudo-terminal whose other end the test holds."""

import os
import select
import tty

import can
import pytest
import serial

from microdrivers.backends.lines.can_adapter import CanAdapter
from microdrivers.backends.lines.can_listeners import CanCounters
from microdrivers.backends.lines.settings import CanConnection
from microdrivers.backends.lines.slcan_in_bulk import BulkSlcan, in_bulk
from microdrivers.core.clock import SystemClock
from microdrivers.core.errors import LinkLost, LinkTimeout
from tests.arrival import unread, wait_for_unread

pytestmark = [pytest.mark.xdist_group("real_time"), pytest.mark.skipif(os.name != "posix", reason="no terminals")]


OPENING = b"C\rS6\r\rO\rO\r"


class Bench:
    """An adapter that is opened by our own code, and what it hears and says at its end of the line."""

    def __init__(self):
        self.end, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self.end, False)
        connection = CanConnection(
            interface="slcan", channel=os.ttyname(slave), options={"sleep_after_open": 0.0}, bitrate=500_000
        )
        os.write(self.end, b"t7FF0\rt70B1")  # of somebody before us
        self.counters = CanCounters()
        self.adapter = CanAdapter(connection, clock=SystemClock(), counters=self.counters)
        os.close(slave)
        self.opening = self.heard(len(OPENING))
        self.say(b"05\r")

    def heard(self, least=1):
        """What has come: that many bytes, and whatever follows without a pause; nothing if none come."""
        data = b""
        while select.select([self.end], [], [], 0.02 if len(data) >= least else 1.0)[0]:
            data += os.read(self.end, 65536)
        return data

    def say(self, data):
        descriptor = self.adapter._bus.fileno()
        before = unread(descriptor)
        assert os.write(self.end, data) == len(data)
        wait_for_unread(descriptor, before + len(data))

    def received(self, count):
        return [self.adapter.receive(1.0) for _ in range(count)]

    def close(self):
        self.adapter.close()
        if self.end >= 0:
            os.close(self.end)


@pytest.fixture
def bench():
    bench = Bench()
    yield bench
    bench.close()


def test_it_is_opened_by_python_can_and_read_by_us(bench):
    assert bench.opening == OPENING
    assert isinstance(bench.adapter._bus, BulkSlcan)
    assert in_bulk(bench.adapter._bus, bench.counters) is bench.adapter._bus


def test_frames_are_written_as_the_protocol_has_them(bench):
    bench.adapter.send(0x60B, bytes.fromhex("4000100000000000"))
    bench.adapter.send(0x080, b"")
    bus = bench.adapter._bus
    bus.send(can.Message(arbitration_id=0x18AB, is_extended_id=True, data=b"\x0f"))
    bus.send(can.Message(arbitration_id=0x123, is_extended_id=False, is_remote_frame=True, dlc=3))
    bus.send(can.Message(arbitration_id=0x123, is_extended_id=True, is_remote_frame=True, dlc=0))
    lines = b"t60B84000100000000000\rt0800\rT000018AB10F\rr1233\rR000001230\r"
    assert bench.heard(len(lines)) == lines


def test_what_comes_at_once_is_read_in_its_order_whatever_it_is_cut_into(bench):
    bench.adapter.receive(0.0)  # takes the rest of a frame from before our time away
    sent = [(0x181 + number % 3, number.to_bytes(2, "big")) for number in range(200)]
    line = b"".join(b"t%03X2%s\rz\r\a" % (cob_id, data.hex().encode()) for cob_id, data in sent)
    received = []
    for start in range(0, len(line), 333):
        bench.say(line[start : start + 333])
        while (message := bench.adapter.receive(0.01)) is not None:
            received.append((message.arbitration_id, bytes(message.data)))
    assert received == sent
    assert bench.counters.garbled == 0


def test_extended_and_remote_frames_are_told_apart(bench):
    bench.adapter.receive(0.0)
    bench.say(b"T000018AB10F\rr1233\rR000001230\rt1810\r")
    extended, remote, both, plain = bench.received(4)
    assert (extended.arbitration_id, extended.is_extended_id, bytes(extended.data)) == (0x18AB, True, b"\x0f")
    assert (remote.arbitration_id, remote.is_remote_frame, remote.dlc) == (0x123, True, 3)
    assert (both.is_remote_frame, both.is_extended_id) == (True, True)
    assert (plain.arbitration_id, plain.dlc, bytes(plain.data)) == (0x181, 0, b"")


@pytest.mark.parametrize("garbage", [b"t18\r", b"t1819\r", b"t18122AB\r", b"tXYZ0\r", b"t\xff810\r", b"x" * 60 + b"\r"])
def test_garbage_costs_itself_and_nothing_else(bench, garbage):
    bench.adapter.receive(0.0)
    bench.say(b"t1810\r" + garbage + b"t1820\rt1830\r")
    assert [message.arbitration_id for message in bench.received(3)] == [0x181, 0x182, 0x183]
    assert bench.counters.garbled <= 1


def test_bytes_without_an_end_are_garbage(bench):
    bench.adapter.receive(0.0)
    for _ in range(3):
        bench.say(b"5" * 40)
        bench.adapter.receive(0.0)
    assert bench.counters.garbled == 3
    bench.say(b"\rt1820\r")
    assert bench.received(1)[0].arbitration_id == 0x182


def test_a_frame_that_was_written_is_not_called_late_because_the_computer_was(bench, monkeypatch):
    """pyserial looks at the time after it has written, and python-can then takes the adapter for lost."""
    monkeypatch.setattr(serial.Serial, "write", lambda *_: pytest.fail("pyserial would write"))
    for _ in range(3):
        bench.adapter.send(0x77F, b"\5")
    assert bench.heard(3 * 8) == b"t77F105\r" * 3
    monkeypatch.undo()


def test_an_adapter_that_takes_nothing_is_no_lost_adapter_and_gets_no_half_frame(bench):
    sent, refusal = 0, None
    while refusal is None:
        try:
            bench.adapter.send(0x20B, bytes(8))
            sent += 1
        except bench.adapter.failures as error:
            refusal = error
    assert isinstance(bench.adapter.explain(refusal), LinkTimeout)
    taken = b""
    while part := bench.heard():
        taken += part
    bench.adapter.send(0x080, b"")
    lines = (taken + bench.heard(len(b"t0800\r"))).split(b"\r")
    whole = b"t20B80000000000000000"
    assert lines.count(whole) == sent
    assert lines[-2:] == [b"t0800", b""]
    torn = [line for line in lines[:-2] if line != whole]
    assert all(line.endswith(b"!") for line in torn)  # which no adapter takes for a frame
    assert len(torn) <= 1


def test_frames_that_the_adapter_refuses_are_counted_and_told(bench):
    bench.say(b"\r\a\a\r\r")  # what it says to being opened
    bench.adapter.receive(0.0)
    assert bench.counters.refused == 0
    bench.say(b"z\rz\r")
    bench.adapter.receive(0.0)
    bench.say(b"\a\a\az\r")
    bench.adapter.receive(0.0)
    assert bench.counters.refused == 3
    assert "the adapter has refused 3 frames" in bench.counters.hint()


def test_what_it_says_to_being_opened_is_no_refusal_also_if_it_comes_with_the_first_answers(bench):
    bench.say(b"\r\a\a\r\rz\rz\r\az\r")
    bench.adapter.receive(0.0)
    assert bench.counters.refused == 1


def test_an_adapter_that_is_pulled_is_lost(bench):
    os.close(bench.end)
    bench.end = -1
    with pytest.raises(bench.adapter.failures) as caught:
        bench.adapter.receive(0.1)
    assert isinstance(bench.adapter.explain(caught.value), LinkLost)
    with pytest.raises(bench.adapter.failures):
        bench.adapter.send(0x080, b"")


def test_other_interfaces_are_left_as_they_are():
    with can.Bus(interface="virtual", channel="in bulk", ignore_config=True) as bus:
        assert in_bulk(bus, CanCounters()) is bus
