"""A serial port with one request under way at a time.

pyserial opens and configures. On POSIX ports the line polls and reads the file descriptor itself (pyserial's
`read_until` takes five times as long, see docs/decisions/0006); elsewhere, and for pyserial URLs, it reads in bulk.
"""

from __future__ import annotations

import errno
import os
import select
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import serial

from microdrivers.backends.lines.settings import SerialConnection
from microdrivers.core.clock import Clock
from microdrivers.core.errors import LinkError, LinkLost, LinkTimeout, ProtocolError, UnsupportedError
from microdrivers.core.units import NS_PER_MS, NS_PER_S, seconds_to_ns
from microdrivers.devices.wire_tap import WireTap

MAX_REPLY_BYTES = 65536
_QUIET_S = 0.03
_RESYNC_LIMIT_S = 1.0

_OPEN_REMEDIES = {
    errno.ENOENT: "check the cable and the port's name (ls -l /dev/serial/by-id); without hardware use --fake",
    errno.EACCES: "you may not open the port: add yourself to the group that owns it (often dialout) and log in again",
    errno.EBUSY: "another program, or another device of this rig, uses the port: close it first",
    errno.EAGAIN: "another program uses the port: close it first",
}


class Exchange(NamedTuple):
    """One request and its reply; times in ns on the rig's clock.

    `request_end_ns` is when the last bit of the request has left, by the baud rate.
    """

    reply: bytes
    request_start_ns: int
    request_end_ns: int
    first_byte_ns: int
    end_ns: int


class LineCounters:
    """What has happened on a line since it was opened."""

    def __init__(self) -> None:
        self.exchanges = 0
        self.timeouts = 0
        self.resynchronisations = 0
        self.discarded_bytes = 0


class SerialLine:
    """Owns one port and one lock; turns request bytes into reply bytes, with all waiting on the clock.

    Args:
        gap_s: silence to keep between the end of a reply and the next request.
        tap: is told everything that passes.
    """

    def __init__(
        self, connection: SerialConnection, *, clock: Clock, gap_s: float = 0.0, tap: WireTap | None = None
    ) -> None:
        self.connection = connection
        self.clock = clock
        self.counters = LineCounters()
        self._tap = tap
        self._gap_ns = seconds_to_ns(gap_s)
        self._byte_ns = round(connection.bits_per_byte * NS_PER_S / connection.baudrate)
        self._lock = threading.Lock()
        self._posted: deque[bytes] = deque()
        self._free_at_ns = 0
        self._suspect = False
        self._port: Any = None
        self._descriptor: int | None = None
        self._poller: select.poll | None = None

    # ------------------------------------------------------------------ life

    def open(self) -> None:
        """Open and configure the port.

        Raises:
            LinkLost: it is absent, busy or forbidden; the remedy says which.
        """
        wanted = self.connection
        try:
            self._port = serial.serial_for_url(
                wanted.port, baudrate=wanted.baudrate, parity=wanted.parity, stopbits=wanted.stopbits,
                timeout=0, write_timeout=wanted.timeout_s, exclusive=True if os.name == "posix" else None,
            )  # fmt: skip
        except (OSError, ValueError) as error:  # SerialException is an OSError
            code = getattr(error, "errno", None) or _errno_in(str(error))
            remedy = _OPEN_REMEDIES.get(code or 0, "check the port's name and settings in the rig file")
            raise LinkLost(f"cannot open port {wanted.port}: {error}", remedy=remedy, moved="no") from error
        self._use_descriptor()
        self._free_at_ns = 0
        self._suspect = False

    def close(self) -> None:
        """Close the port; idempotent."""
        port, self._port, self._descriptor, self._poller = self._port, None, None, None
        if port is not None:
            port.close()

    # ------------------------------------------------------------------ traffic

    def exchange(
        self, request: bytes, complete: Callable[[bytes], bool], *, timeout_s: float | None = None
    ) -> Exchange:
        """Send a request and read until `complete(reply)`.

        Raises:
            LinkTimeout: no complete reply within the time-out after the request or after the newest byte.
            LinkLost: the port is gone. ProtocolError: the device sends without end.
        """
        wait_ns = seconds_to_ns(self.connection.timeout_s if timeout_s is None else timeout_s)
        with self.clock.transaction(), self._ownership():
            self._prepare()
            start_ns = self.clock.now_ns()
            self._write(request)
            request_end_ns = start_ns + len(request) * self._byte_ns
            try:
                exchange = self._read_reply(request, complete, start_ns, request_end_ns, wait_ns)
            except BaseException:
                self._suspect = True  # also when interrupted: the reply may still be coming
                raise
            self._free_at_ns = exchange.end_ns + self._gap_ns
            self.counters.exchanges += 1
            return exchange

    def send(self, request: bytes) -> None:
        """Send what has no reply, in its turn."""
        with self.clock.transaction(), self._ownership():
            self._prepare()
            self._write(request)
            self._free_at_ns = self.clock.now_ns() + len(request) * self._byte_ns + self._gap_ns

    def send_now(self, data: bytes) -> None:
        """Send at once, past any exchange under way; for full-duplex lines and commands without a reply."""
        self._write(data)

    def post(self, data: bytes) -> None:
        """Send as soon as the line is free, without waiting for the reply; for half-duplex lines.

        If an exchange is under way in another thread, that thread sends it as soon as its exchange ends.
        """
        self._posted.append(data)
        with self.clock.transaction():  # outside the lock: its end may dispatch others that use this line
            self._flush_posted()

    # ------------------------------------------------------------------ inside

    @contextmanager
    def _ownership(self) -> Iterator[None]:
        try:
            with self._lock:
                yield
        finally:
            self._flush_posted()  # also after a failed exchange: a stop may be waiting

    def _flush_posted(self) -> None:
        while self._posted and self._lock.acquire(blocking=False):
            try:
                while self._posted:
                    self._send_posted(self._posted.popleft())
            finally:
                self._lock.release()

    def _send_posted(self, data: bytes) -> None:
        self.clock.sleep_until(self._free_at_ns)
        self._write(data)
        self._free_at_ns = self.clock.now_ns() + len(data) * self._byte_ns + self._gap_ns
        self._suspect = True  # its reply, if any, must not be taken for the next one's

    def _prepare(self) -> None:
        self.clock.sleep_until(self._free_at_ns)
        if self._suspect:
            self._resynchronise()
        stale = self._read_available()
        self.counters.discarded_bytes += len(stale)

    def _resynchronise(self) -> None:
        """Read away what is still coming from an earlier request, until the line has been quiet for a while."""
        self.counters.resynchronisations += 1
        limit_ns = self.clock.now_ns() + seconds_to_ns(_RESYNC_LIMIT_S)
        while data := self._read_within(seconds_to_ns(_QUIET_S)):
            self.counters.discarded_bytes += len(data)
            if self.clock.now_ns() > limit_ns:
                raise ProtocolError(
                    "the device sends without being asked and does not stop", received=data[-64:],
                    remedy="check the baud rate, and that nothing else talks on this line",
                )  # fmt: skip
        self._suspect = False

    def _read_reply(
        self,
        request: bytes,
        complete: Callable[[bytes], bool],
        start_ns: int,
        request_end_ns: int,
        wait_ns: int,
    ) -> Exchange:
        reply = b""
        first_ns = 0
        deadline_ns = request_end_ns + wait_ns
        while True:
            data = self._read_within(deadline_ns - self.clock.now_ns())
            now_ns = self.clock.now_ns()
            if not data:
                self._fail(request, reply, wait_ns)
            first_ns = first_ns or now_ns
            reply += data
            if complete(reply):
                return Exchange(reply, start_ns, request_end_ns, first_ns, now_ns)
            if len(reply) > MAX_REPLY_BYTES:
                self._suspect = True
                raise ProtocolError("the reply has no end", sent=request, received=reply[:64])
            deadline_ns = now_ns + wait_ns

    def _fail(self, request: bytes, reply: bytes, wait_ns: int) -> None:
        self._suspect = True
        self._free_at_ns = self.clock.now_ns() + self._gap_ns
        self.counters.timeouts += 1
        waited = f"within {wait_ns / NS_PER_MS:.0f} ms"
        if reply:
            raise LinkTimeout(
                f"only a part of the reply to {request[:64]!r} came {waited}: {reply[:64]!r}",
                remedy="check baud rate and parity, and the cable",
            )
        raise LinkTimeout(
            f"no reply to {request[:64]!r} {waited} on {self.connection.port}",
            remedy="check power, cable, baud rate, parity and the device's address",
        )

    # ------------------------------------------------------------------ the port

    def _use_descriptor(self) -> None:
        if os.name != "posix" or "://" in self.connection.port:
            return
        if self.clock.simulated:
            self.close()
            raise UnsupportedError(
                f"{self.connection.port} is a real port and cannot run on a simulated clock",
                remedy="use --real-time, or an emulator (--fake)",
            )
        self._descriptor = self._port.fileno()
        self._poller = select.poll()
        self._poller.register(self._descriptor, select.POLLIN)

    def _write(self, data: bytes) -> None:
        if self._tap is not None:
            self._tap.sent(self.clock.now_ns(), data)
        with self._link():
            self._require_port().write(data)

    def _read_available(self) -> bytes:
        with self._link():
            port = self._require_port()
            waiting = port.in_waiting
            return self._heard(bytes(port.read(waiting))) if waiting else b""

    def _read_within(self, wait_ns: int) -> bytes:
        """Bytes as soon as there are any, b"" if there are none within `wait_ns`."""
        with self._link():
            port = self._require_port()
            if self._descriptor is None or self._poller is None:
                port.timeout = max(wait_ns, 0) / NS_PER_S
                first = bytes(port.read(1))
                return self._heard(first + bytes(port.read(port.in_waiting))) if first else b""
            if not self._poller.poll(max(wait_ns, 0) / NS_PER_MS):
                return b""
            data = os.read(self._descriptor, 4096)
            if not data:
                raise OSError(errno.EIO, "the port reports data and delivers none: device disconnected")
            return self._heard(data)

    def _heard(self, data: bytes) -> bytes:
        if self._tap is not None:
            self._tap.received(self.clock.now_ns(), data)
        return data

    def _require_port(self) -> Any:
        if self._port is None:
            raise LinkLost("the port is closed", remedy="open the device first", moved="no")
        return self._port

    @contextmanager
    def _link(self) -> Iterator[None]:
        try:
            yield
        except LinkError:
            raise
        except OSError as error:
            raise LinkLost(
                f"port {self.connection.port} failed: {error}",
                remedy="check the cable and the device's power, then close and open the rig again",
            ) from error


def _errno_in(text: str) -> int | None:
    """Pyserial hides the errno of a failed open in its message."""
    return next((code for code in _OPEN_REMEDIES if f"[Errno {code}]" in text), None)
