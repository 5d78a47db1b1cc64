"""Puts an emulated line on an operating-system port: a pseudo-terminal or a TCP port."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import tty
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from microdrivers.core.clock import Clock, Timer
from microdrivers.core.errors import LinkLost, RefusedError, UnsupportedError
from microdrivers.core.units import NS_PER_S
from microdrivers.devices.drivers import Endpoint, ServeRequest
from microdrivers.devices.wire_tap import WireTap
from microdrivers.fakes.wire.wire import Wire

_CHUNK = 65536


class HostPort(Protocol):
    """The side of a port on which the host's bytes come out."""

    def open(self) -> None:
        """Offer the port (again), under the same name."""

    def descriptors(self) -> list[int]:
        """What to wait for."""

    def receive(self, ready: Sequence[int]) -> bytes:
        """Bytes from the host; `ready` lists the descriptors that have something."""

    def send(self, data: bytes) -> int:
        """Send to the host; returns how many bytes it took."""

    def close(self) -> None:
        """Give the port up."""


class Bridge:
    """Moves bytes between a wire and a port, each at its time, in a thread of its own.

    A host that does not read loses bytes, as it does on a UART: `dropped_bytes` counts them.
    """

    def __init__(self, wire: Wire, clock: Clock, port: HostPort, *, name: str, tap: WireTap | None = None) -> None:
        if clock.simulated:
            raise UnsupportedError("a simulated clock cannot serve other programs", remedy="serve on SystemClock")
        self.dropped_bytes = 0
        self._wire = wire
        self._clock = clock
        self._port = port
        self._tap = tap
        self._wake_end, self._wake_start = os.pipe()
        self._closed = False
        wire.wakes_itself = False
        self._timer: Timer = clock.call_at(clock.now_ns(), self._run, name=f"{name} port")

    def wake(self) -> None:
        """Look at the port again: it has changed."""
        os.write(self._wake_start, b"x")

    def close(self) -> None:
        """End the thread and the port; idempotent."""
        if self._closed:
            return
        self._closed = True
        self.wake()
        self._timer.cancel()
        os.close(self._wake_start)
        os.close(self._wake_end)
        self._port.close()

    def _run(self) -> None:
        while not self._closed:
            due_ns = self._wire.next_arrival_ns()
            wait_s = None if due_ns is None else max(0, due_ns - self._clock.now_ns()) / NS_PER_S
            try:
                ready, _, _ = select.select([self._wake_end, *self._port.descriptors()], [], [], wait_s)
            except OSError as error:
                if error.errno != errno.EBADF:
                    raise
                continue  # the port went away meanwhile
            if self._wake_end in ready:
                os.read(self._wake_end, _CHUNK)
            self._wire.turn()
            with contextlib.suppress(LinkLost):  # while the cable is pulled, bytes are lost
                self._exchange(ready)

    def _exchange(self, ready: Sequence[int]) -> None:
        data = self._port.receive(ready)
        if data:
            if self._tap is not None:
                self._tap.sent(self._clock.now_ns(), data)
            self._wire.write(data)
        reply = self._wire.read(_CHUNK)
        if reply:
            taken = self._port.send(reply)
            self.dropped_bytes += len(reply) - taken
            if self._tap is not None and taken:
                self._tap.received(self._clock.now_ns(), reply[:taken])


class PtyPort:
    """A pseudo-terminal under a stable name: `link` points to it."""

    def __init__(self, link: Path) -> None:
        self.link = link
        self._master = self._slave = -1
        self.open()

    def open(self) -> None:
        """Make a terminal; the link points to it."""
        master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(master, False)
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(os.ttyname(self._slave))
        self._master = master

    def descriptors(self) -> list[int]:
        """The terminal's master side."""
        return [descriptor for descriptor in (self._master,) if descriptor >= 0]

    def receive(self, ready: Sequence[int]) -> bytes:
        """Bytes from the host."""
        master = self._master
        if master < 0 or master not in ready:
            return b""
        try:
            return os.read(master, _CHUNK)
        except OSError:  # the terminal went away meanwhile
            return b""

    def send(self, data: bytes) -> int:
        """Send to the host, as much as the terminal's buffer takes."""
        try:
            return os.write(self._master, data)
        except OSError:
            return 0

    def close(self) -> None:
        """The terminal goes away, and its name with it."""
        descriptors, self._master, self._slave = (self._master, self._slave), -1, -1
        for descriptor in descriptors:
            if descriptor >= 0:
                os.close(descriptor)
        self.link.unlink(missing_ok=True)


class TcpPort:
    """A TCP port for one host at a time; a second one is turned away.

    Args:
        connected: called when a host has been let in, before its bytes.
    """

    def __init__(self, bind: str, connected: Callable[[], None]) -> None:
        self.address: tuple[str, int] = (bind, 0)
        self._connected = connected
        self._listener: socket.socket | None = None
        self._host: socket.socket | None = None
        self.open()

    def open(self) -> None:
        """Listen; at first on any free port, later on the same one."""
        self._listener = socket.create_server(self.address)
        self.address = self._listener.getsockname()[:2]

    def descriptors(self) -> list[int]:
        """The listener, and the host if there is one."""
        descriptors = [end.fileno() for end in (self._listener, self._host) if end is not None]
        return [descriptor for descriptor in descriptors if descriptor >= 0]

    def receive(self, ready: Sequence[int]) -> bytes:
        """Bytes from the present host; when it has said everything, take a new one in."""
        if self._host is not None and self._host.fileno() in ready and (data := self._hear(self._host)):
            return data
        if self._listener is not None and self._listener.fileno() in ready:
            self._greet(self._listener)
        return b""

    def _hear(self, host: socket.socket) -> bytes:
        try:
            data = host.recv(_CHUNK)
        except OSError:
            data = b""
        if not data:
            host.close()
            self._host = None
        return data

    def send(self, data: bytes) -> int:
        """Send to the host, if there is one."""
        if self._host is None:
            return 0
        try:
            self._host.sendall(data)
        except OSError:
            return 0
        return len(data)

    def close(self) -> None:
        """Hang up, and listen no more."""
        ends, self._host, self._listener = (self._host, self._listener), None, None
        for end in ends:
            if end is not None:
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)  # closing alone waits for whoever still looks at it
                end.close()

    def _greet(self, listener: socket.socket) -> None:
        newcomer, _ = listener.accept()
        if self._host is not None:
            newcomer.close()
            return
        newcomer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._host = newcomer
        self._connected()


class Cable:
    """Pulls and puts back the cable of a wire that is served."""

    def __init__(self, wire: Wire, port: HostPort, bridge: Bridge) -> None:
        self._wire = wire
        self._port = port
        self._bridge = bridge

    def unplug(self) -> None:
        """The port goes away, as a USB adapter's device does."""
        self._wire.unplug()
        self._port.close()
        self._bridge.wake()

    def plug_in(self) -> None:
        """A port comes back under the same name."""
        self._port.open()
        self._wire.plug_in()
        self._bridge.wake()


def serve_wire(
    name: str,
    wire: Wire,
    clock: Clock,
    request: ServeRequest,
    *,
    overrides: Mapping[str, Any] | None = None,
) -> Endpoint:
    """Put a wire on the kind of port that is asked for; `overrides` are further settings that hold there.

    Raises:
        RefusedError: the port cannot be opened.
    """
    try:
        if request.transport == "pty":
            endpoint = _serve_on_pty(name, wire, clock, request)
        else:
            endpoint = _serve_on_tcp(name, wire, clock, request)
        return replace(endpoint, overrides={**(overrides or {}), **endpoint.overrides})
    except OSError as error:
        raise RefusedError(
            f"no {request.transport} port can be opened: {error}", device=name, remedy="choose another --bind address"
        ) from error


def _serve_on_pty(name: str, wire: Wire, clock: Clock, request: ServeRequest) -> Endpoint:
    link = request.folder / name
    port = PtyPort(link)
    bridge = Bridge(wire, clock, port, name=name, tap=request.tap)
    # Linux pseudo-terminals hold no parity.
    overrides = {"connection": {"port": str(link), "parity": "N"}}
    return Endpoint(overrides=overrides, where=str(link), close=bridge.close, control=Cable(wire, port, bridge))


def _serve_on_tcp(name: str, wire: Wire, clock: Clock, request: ServeRequest) -> Endpoint:
    port = TcpPort(request.bind, wire.connect)
    bridge = Bridge(wire, clock, port, name=name, tap=request.tap)
    url = f"socket://{request.host}:{port.address[1]}"
    overrides = {"connection": {"port": url}}
    return Endpoint(overrides=overrides, where=url, close=bridge.close, control=Cable(wire, port, bridge))
