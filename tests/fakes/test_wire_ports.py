"""An emulated line on ports of the operating system: hosts come and go, cables are pulled, time goes on."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from microdrivers.core.clock import SystemClock
from microdrivers.core.units import NS_PER_MS
from microdrivers.devices.drivers import Endpoint, ServeRequest
from microdrivers.fakes.wire import Cable, Reply, Wire, serve_wire

# One after the other: they run in real time.
pytestmark = pytest.mark.xdist_group("real_time")

LONG_S = 20.0


class Echo:
    """Sends everything back; 150 ms after the last byte it rings."""

    def __init__(self) -> None:
        self.story: list[bytes | str] = []
        self.rang = threading.Event()
        self.rings_ns: int | None = None

    def connected(self, t_ns: int) -> None:
        self.story.append("connected")

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        self.story.append(data)
        self.rings_ns = end_ns + 150 * NS_PER_MS
        return (Reply(end_ns, data),)

    def advance(self, t_ns: int) -> Sequence[Reply]:
        self.rings_ns = None
        self.rang.set()
        return ()

    def next_event_ns(self) -> int | None:
        return self.rings_ns


@pytest.fixture
def echo() -> Echo:
    return Echo()


@pytest.fixture
def clock() -> Iterator[SystemClock]:
    clock = SystemClock()
    yield clock
    clock.close()


@pytest.fixture(params=["tcp", "pty"])
def endpoint(request: pytest.FixtureRequest, echo: Echo, clock: SystemClock, tmp_path: Path) -> Iterator[Endpoint]:
    wire = Wire(echo, clock=clock, seed=1, baudrate=10**9)
    endpoint = serve_wire("echo", wire, clock, ServeRequest(transport=request.param, bind="127.0.0.1", folder=tmp_path))
    yield endpoint
    endpoint.close()


def dial(endpoint: Endpoint) -> socket.socket:
    host, _, port = endpoint.where.removeprefix("socket://").rpartition(":")
    connection = socket.create_connection((host, int(port)), timeout=LONG_S)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def ask(connection: socket.socket, data: bytes) -> bytes:
    connection.sendall(data)
    received = b""
    while len(received) < len(data) and (piece := connection.recv(99)):
        received += piece
    return received


def cable_of(endpoint: Endpoint) -> Cable:
    assert isinstance(endpoint.control, Cable)
    return endpoint.control


@pytest.mark.parametrize("endpoint", ["tcp"], indirect=True)
def test_a_host_may_hang_up_and_call_again_at_once(endpoint: Endpoint, echo: Echo) -> None:
    told: list[bytes | str] = []
    for turn in range(50):
        unread = b"unread %d" % turn
        with dial(endpoint) as connection:
            assert ask(connection, b"%d" % turn) == b"%d" % turn
            connection.sendall(unread)
        told += ["connected", b"%d" % turn, unread]
    with dial(endpoint) as connection:
        assert ask(connection, b"last") == b"last"
    assert echo.story == [*told, "connected", b"last"]


@pytest.mark.parametrize("endpoint", ["tcp"], indirect=True)
def test_a_second_host_is_turned_away(endpoint: Endpoint) -> None:
    with dial(endpoint) as first:
        assert ask(first, b"first") == b"first"
        with dial(endpoint) as second:
            assert second.recv(9) == b""
        assert ask(first, b"still") == b"still"


@pytest.mark.parametrize("endpoint", ["tcp"], indirect=True)
def test_a_pulled_network_cable_ends_the_connection(endpoint: Endpoint) -> None:
    cable = cable_of(endpoint)
    with dial(endpoint) as connection:
        assert ask(connection, b"a") == b"a"
        cable.unplug()
        assert connection.recv(9) == b""
    with pytest.raises(ConnectionRefusedError):
        dial(endpoint)
    cable.plug_in()
    with dial(endpoint) as connection:
        assert ask(connection, b"again") == b"again"


def test_what_falls_due_happens_while_the_cable_is_pulled(endpoint: Endpoint, echo: Echo) -> None:
    if endpoint.where.startswith("socket://"):
        with dial(endpoint) as connection:
            assert ask(connection, b"a") == b"a"
            cable_of(endpoint).unplug()
    else:
        with Path(endpoint.where).open("r+b", buffering=0) as terminal:
            terminal.write(b"a")
            assert terminal.read(1) == b"a"
        cable_of(endpoint).unplug()
    assert echo.rang.wait(LONG_S)
