"""The serial line on ports of the operating system: whose bytes are whose, and what happens when the port goes."""

import os
import select
import socket
import threading
import tty

import pytest

from microdrivers.backends.lines.serial_line import SerialLine
from microdrivers.backends.lines.settings import SerialConnection
from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock, SystemClock
from microdrivers.core.clock.interruption import INTERRUPTION
from microdrivers.core.errors import LinkLost, LinkTimeout, UnsupportedError
from microdrivers.core.samples import WireTraffic
from microdrivers.devices.wire_tap import WireTap
from tests.arrival import wait_for_unread

# One after the other: they run in real time.
pytestmark = pytest.mark.xdist_group("real_time")


class Far:
    """The other end of a port; answers each write with the next of `replies`, if there is one."""

    def __init__(self, port, source, read, write, hang_up):
        self.port = port
        self.replies = []
        self.heard = b""
        self.write = write
        self._source, self._read, self._hang_up = source, read, hang_up
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self):
        while not self._closing.is_set():
            if not select.select([self._source()], [], [], 0.01)[0]:
                continue
            try:
                data = self._read(65536)
            except OSError:
                return
            if not data:
                return
            self.heard += data
            if self.replies:
                self.write(self.replies.pop(0))

    def close(self):
        """Nobody may read on: the next port gets the same descriptors."""
        self._closing.set()
        if threading.current_thread() is not self._thread:
            self._thread.join()
        self._hang_up()


def pseudo_terminal():
    master, slave = os.openpty()
    tty.setraw(slave)
    return Far(
        os.ttyname(slave), lambda: master, lambda size: os.read(master, size), lambda data: os.write(master, data),
        lambda: (os.close(slave), os.close(master)),
    )  # fmt: skip


def tcp():
    listener = socket.create_server(("127.0.0.1", 0))
    held = []

    def read(size):
        if not held:
            held.append(listener.accept()[0])
        return held[0].recv(size)

    def hang_up():
        if held:
            held[0].close()
        listener.close()

    host, port = listener.getsockname()
    return Far(
        f"socket://{host}:{port}", lambda: held[0] if held else listener, read, lambda data: held[0].sendall(data),
        hang_up,
    )  # fmt: skip


def whole(reply):
    return reply.endswith(b"\n")


@pytest.fixture(params=[pseudo_terminal, tcp], ids=["pty", "tcp"])
def far(request):
    end = request.param()
    yield end
    end.close()


@pytest.fixture
def line(far):
    line = SerialLine(SerialConnection(port=far.port, timeout_s=0.2), clock=SystemClock())
    line.open()
    yield line
    line.close()


def test_what_nobody_asked_for_is_not_taken_for_a_reply(far, line):
    far.replies = [b"first\n", b"second\n"]
    assert line.exchange(b"?", whole).reply == b"first\n"
    far.write(b"3=spontaneous \nand more than one byte of it\n")
    wait_for_unread(line._port._descriptor, 44)
    assert line.exchange(b"?", whole).reply == b"second\n"
    assert line.counters.discarded_bytes == 44


def test_the_rest_of_half_a_reply_is_not_taken_for_the_next_one(far, line):
    far.replies = [b"half", b"next\n"]
    with pytest.raises(LinkTimeout, match="only a part of the reply to b'\\?' came"):
        line.exchange(b"?", whole)
    far.write(b" a reply\n")
    wait_for_unread(line._port._descriptor, 9)
    assert line.exchange(b"?", whole).reply == b"next\n"


def test_times_are_in_order_and_the_request_ends_by_the_baud_rate(far, line):
    far.replies = [b"ok\n"]
    exchange = line.exchange(b"12345", whole)
    assert exchange.request_end_ns - exchange.request_start_ns == 5 * line.byte_ns
    assert exchange.request_start_ns < exchange.first_byte_ns <= exchange.end_ns


def test_a_connection_that_ends_while_a_reply_is_awaited_is_lost():
    far = tcp()
    line = SerialLine(SerialConnection(port=far.port), clock=SystemClock())
    line.open()
    far.write = lambda _: far.close()
    far.replies = [b"hangs up"]
    with pytest.raises(LinkLost, match="failed"):
        line.exchange(b"?", whole)
    line.close()


def test_a_kept_interruption_happens_between_two_exchanges(far, line):
    far.replies = [b"one\n", b"two\n"]
    INTERRUPTION.rig_opened()
    try:
        line.exchange(b"1", whole)
        INTERRUPTION.request()
        with pytest.raises(KeyboardInterrupt):
            line.exchange(b"never sent", whole)
        assert line.exchange(b"2", whole).reply == b"two\n"
    finally:
        INTERRUPTION.rig_closed()
    assert far.heard == b"12"


def test_a_listener_hears_both_directions(far):
    bus, heard = Bus(), []
    line = SerialLine(SerialConnection(port=far.port), clock=SystemClock(), tap=WireTap("motor", bus))
    line.open()
    far.replies = [b"unheard\n", b"heard\n"]
    line.exchange(b"1", whole)
    bus.topic("motor/wire", WireTraffic).subscribe(lambda traffic: heard.append((traffic.direction, traffic.data)))
    line.exchange(b"2", whole)
    line.close()
    assert heard[0] == ("sent", b"2")
    assert b"".join(data for direction, data in heard[1:] if direction == "received") == b"heard\n"


def test_a_request_larger_than_the_buffer_of_the_operating_system_is_sent_whole():
    far = pseudo_terminal()
    line = SerialLine(SerialConnection(port=far.port, timeout_s=2.0), clock=SystemClock())
    line.open()
    line.send_now(b"x" * 200_000)
    deadline_ns = line.clock.now_ns() + 5 * 10**9
    while len(far.heard) < 200_000 and line.clock.now_ns() < deadline_ns:
        line.clock.sleep(0.01)
    line.close()
    far.close()
    assert len(far.heard) == 200_000


@pytest.mark.parametrize("port", ["/dev/null/nowhere", "socket://127.0.0.1:1", "socket://nonsense", "socket://a:b"])
def test_a_port_that_cannot_be_opened_is_named_with_a_remedy(port):
    line = SerialLine(SerialConnection(port=port), clock=SystemClock())
    with pytest.raises(LinkLost, match=f"cannot open port {port}") as caught:
        line.open()
    assert caught.value.remedy
    with pytest.raises(LinkLost, match="the port is closed"):
        line.exchange(b"?", whole)


@pytest.mark.parametrize("port", ["/dev/ttyS0", "socket://127.0.0.1:1"])
def test_a_real_port_does_not_run_on_a_simulated_clock(port):
    with pytest.raises(UnsupportedError, match="simulated clock"):
        SerialLine(SerialConnection(port=port), clock=SimulatedClock()).open()


def test_bytes_of_a_closed_port_are_not_read_from_another_file_that_has_its_number(far, line):
    port = line._port
    line.close()
    with pytest.raises(OSError, match="descriptor"):
        port.write(b"x")
