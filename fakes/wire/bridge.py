"""Puts an emulated line on an operating-system port: a pseudo-terminal or a TCP port."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import tty
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from microdrivers.core.clock import Clock, Timer
from microdrivers.core.errors import LinkLost, RefusedError, UnsupportedError
from microdrivers.core.units import NS_PER_S
from microdrivers.devices.drivers import Endpoint, ServeRequest
from microdrivers.fakes.wire.wire import Wire

_CHUNK = 65536


class HostPort(Protocol):
    """The side of a port on which the host's bytes come out."""

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

    def __init__(self, wire: Wire, clock: Clock, port: HostPort, *, name: str) -> None:
        if clock.simulated:
            raise UnsupportedError("a simulated clock cannot serve other programs", remedy="serve on SystemClock")
        self.dropped_bytes = 0
        self._wire = wire
        self._clock = clock
        self._port = port
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
            ready, _, _ = select.select([self._wake_end, *self._port.descriptors()], [], [], wait_s)
            if self._wake_end in ready:
                os.read(self._wake_end, _CHUNK)
            with contextlib.suppress(LinkLost):  # while the cable is pulled, bytes are lost
                self._exchange(ready)

    def _exchange(self, ready: Sequence[int]) -> None:
        data = self._port.receive(ready)
        if data:
            self._wire.write(data)
        reply = self._wire.read(_CHUNK)
        if reply:
            self.dropped_bytes += len(reply) - self._port.send(reply)


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
        return [self._master] if self._master >= 0 else []

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
    """A TCP port for one host at a time; a second one is turned away."""

    def __init__(self, bind: str) -> None:
        self._listener = socket.create_server((bind, 0))
        self.address: tuple[str, int] = self._listener.getsockname()[:2]
        self._host: socket.socket | None = None

    def descriptors(self) -> list[int]:
        """The listener, and the host if there is one."""
        return [self._listener.fileno(), *([self._host.fileno()] if self._host is not None else [])]

    def receive(self, ready: Sequence[int]) -> bytes:
        """Take a new host in; bytes from the present one."""
        if self._listener.fileno() in ready:
            self._greet()
        host = self._host
        if host is None or host.fileno() not in ready:
            return b""
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
        """Hang up."""
        if self._host is not None:
            self._host.close()
        self._listener.close()

    def _greet(self) -> None:
        newcomer, _ = self._listener.accept()
        if self._host is not None:
            newcomer.close()
            return
        newcomer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._host = newcomer


class Cable:
    """Pulls and puts back the cable of a wire that is served on a pseudo-terminal."""

    def __init__(self, wire: Wire, port: PtyPort, bridge: Bridge) -> None:
        self._wire = wire
        self._port = port
        self._bridge = bridge

    def unplug(self) -> None:
        """The terminal goes away, as a USB adapter's device does."""
        self._wire.unplug()
        self._port.close()
        self._bridge.wake()

    def plug_in(self) -> None:
        """A terminal comes back under the same name."""
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
            endpoint = _serve_on_pty(name, wire, clock, request.folder / name)
        else:
            endpoint = _serve_on_tcp(name, wire, clock, request.bind)
        return replace(endpoint, overrides={**(overrides or {}), **endpoint.overrides})
    except OSError as error:
        raise RefusedError(
            f"no {request.transport} port can be opened: {error}", device=name, remedy="choose another --bind address"
        ) from error


def _serve_on_pty(name: str, wire: Wire, clock: Clock, link: Path) -> Endpoint:
    port = PtyPort(link)
    bridge = Bridge(wire, clock, port, name=name)
    # Linux pseudo-terminals hold no parity.
    overrides = {"connection": {"port": str(link), "parity": "N"}}
    return Endpoint(overrides=overrides, where=str(link), close=bridge.close, control=Cable(wire, port, bridge))


def _serve_on_tcp(name: str, wire: Wire, clock: Clock, bind: str) -> Endpoint:
    port = TcpPort(bind)
    bridge = Bridge(wire, clock, port, name=name)
    url = f"socket://{port.address[0]}:{port.address[1]}"
    return Endpoint(overrides={"connection": {"port": url}}, where=url, close=bridge.close)
