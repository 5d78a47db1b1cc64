"""A serial port with one request under way at a time; how its bytes are read stands in `ports`."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

import msgspec

from microdrivers.backends.lines.ports import Port, open_port
from microdrivers.backends.lines.settings import SerialConnection
from microdrivers.core.clock import Clock
from microdrivers.core.clock.interruption import INTERRUPTION
from microdrivers.core.errors import LinkLost, LinkTimeout, ProtocolError
from microdrivers.core.units import NS_PER_MS, NS_PER_S, seconds_to_ns
from microdrivers.devices.wire_tap import WireTap

MAX_REPLY_BYTES = 65536
_QUIET_S = 0.03
_RESYNC_LIMIT_S = 1.0


class Exchange(msgspec.Struct, frozen=True, gc=False):
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

    Attributes:
        byte_ns: what a byte takes on the line, by the baud rate.
    """

    def __init__(
        self, connection: SerialConnection, *, clock: Clock, gap_s: float = 0.0, tap: WireTap | None = None
    ) -> None:
        self.connection = connection
        self.clock = clock
        self.counters = LineCounters()
        self._tap = tap
        self._gap_ns = seconds_to_ns(gap_s)
        self._wait_ns = seconds_to_ns(connection.timeout_s)
        self.byte_ns = round(connection.bits_per_byte * NS_PER_S / connection.baudrate)
        self._lock = threading.Lock()
        self._posted: deque[bytes] = deque()
        self._free_at_ns = 0
        self._suspect = False
        self._port: Port | None = None

    # ------------------------------------------------------------------ life

    def open(self) -> None:
        """Open and configure the port.

        Raises:
            LinkLost: it is absent, busy or forbidden; the remedy says which.
            UnsupportedError: it exists in real time only, and the clock is simulated.
        """
        self._port = open_port(self.connection, self.clock)
        self._free_at_ns = 0
        self._suspect = False

    def close(self) -> None:
        """Close the port; idempotent."""
        port, self._port = self._port, None
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
        wait_ns = self._wait_ns if timeout_s is None else seconds_to_ns(timeout_s)
        if not self.clock.simulated:  # a transaction marks nothing in real time
            return self._exchange(request, complete, wait_ns)
        with self.clock.transaction():
            return self._exchange(request, complete, wait_ns)

    def send_now(self, data: bytes) -> None:
        """Send at once, past any exchange under way; for full-duplex lines and commands without a reply."""
        try:
            self._transmit(self._require_port(), data)
        except OSError as error:
            raise self._lost(error) from error

    def post(self, data: bytes) -> None:
        """Send as soon as the line is free, without waiting for the reply; for half-duplex lines.

        If an exchange is under way in another thread, that thread sends it as soon as its exchange ends.
        """
        self._posted.append(data)
        with self.clock.transaction():  # outside the lock: its end may dispatch others that use this line
            self._flush_posted()

    # ------------------------------------------------------------------ inside

    def _exchange(self, request: bytes, complete: Callable[[bytes], bool], wait_ns: int) -> Exchange:
        # In one piece: this is what a poll costs beyond the port itself (docs/decisions/0006).
        try:
            with self._lock:
                now_ns = self.clock.now_ns
                port = self._port or self._require_port()
                if self._suspect or self._free_at_ns > now_ns() or INTERRUPTION.requested:
                    self._await_quiet(port)
                stale = port.read_available()
                if stale:
                    self._discard(stale)
                tap = self._tap
                if tap is not None and not tap.topic.heard:
                    tap = None
                if tap is not None:
                    tap.sent(now_ns(), request)
                start_ns = now_ns()
                port.write(request)
                request_ns = len(request) * self.byte_ns
                reply, first_byte_ns, remaining_ns = b"", 0, request_ns + wait_ns
                try:
                    while True:
                        data = port.read_within(remaining_ns)
                        arrived_ns = now_ns()
                        if not data:
                            raise self._silence(request, reply, wait_ns)
                        if tap is not None:
                            tap.received(arrived_ns, data)
                        first_byte_ns = first_byte_ns or arrived_ns
                        reply += data
                        if complete(reply):
                            break
                        if len(reply) > MAX_REPLY_BYTES:
                            raise ProtocolError("the reply has no end", sent=request, received=reply[:64])
                        remaining_ns = wait_ns
                except BaseException:
                    self._suspect = True  # also when interrupted: the reply may still be coming
                    raise
                self._free_at_ns = arrived_ns + self._gap_ns
                self.counters.exchanges += 1
                return Exchange(reply, start_ns, start_ns + request_ns, first_byte_ns, arrived_ns)
        except OSError as error:
            raise self._lost(error) from error
        finally:
            if self._posted:
                self._flush_posted()  # also after a failed exchange: a stop may be waiting

    def _silence(self, request: bytes, reply: bytes, wait_ns: int) -> LinkTimeout:
        self._free_at_ns = self.clock.now_ns() + self._gap_ns
        self.counters.timeouts += 1
        waited = f"within {wait_ns / NS_PER_MS:.0f} ms"
        if reply:
            return LinkTimeout(
                f"only a part of the reply to {request[:64]!r} came {waited}: {reply[:64]!r}",
                remedy="check baud rate and parity, and the cable",
            )
        return LinkTimeout(
            f"no reply to {request[:64]!r} {waited} on {self.connection.port}",
            remedy="check power, cable, baud rate, parity and the device's address",
        )

    def _await_quiet(self, port: Port) -> None:
        """Wait until the line is free and nothing more comes that answers an earlier request."""
        self.clock.sleep_until(self._free_at_ns)
        if self._suspect:
            self._resynchronise(port)

    def _resynchronise(self, port: Port) -> None:
        """Read away what is still coming from an earlier request, until the line has been quiet for a while."""
        self.counters.resynchronisations += 1
        limit_ns = self.clock.now_ns() + seconds_to_ns(_RESYNC_LIMIT_S)
        while data := port.read_within(seconds_to_ns(_QUIET_S)):
            self._discard(data)
            if self.clock.now_ns() > limit_ns:
                raise ProtocolError(
                    "the device sends without being asked and does not stop", received=data[-64:],
                    remedy="check the baud rate, and that nothing else talks on this line",
                )  # fmt: skip
        self._suspect = False

    def _flush_posted(self) -> None:
        while self._posted and self._lock.acquire(blocking=False):
            try:
                while self._posted:
                    self._send_posted(self._posted.popleft())
            finally:
                self._lock.release()

    def _send_posted(self, data: bytes) -> None:
        self.clock.sleep_until(self._free_at_ns)
        self.send_now(data)
        self._free_at_ns = self.clock.now_ns() + len(data) * self.byte_ns + self._gap_ns
        self._suspect = True  # its reply, if any, must not be taken for the next one's

    # ------------------------------------------------------------------ the port

    def _transmit(self, port: Port, data: bytes) -> None:
        if self._tap is not None:
            self._tap.sent(self.clock.now_ns(), data)
        port.write(data)

    def _discard(self, data: bytes) -> None:
        if self._tap is not None:
            self._tap.received(self.clock.now_ns(), data)
        self.counters.discarded_bytes += len(data)

    def _require_port(self) -> Port:
        if self._port is None:
            raise LinkLost("the port is closed", remedy="open the device first", moved="no")
        return self._port

    def _lost(self, error: OSError) -> LinkLost:
        return LinkLost(
            f"port {self.connection.port} failed: {error}",
            remedy="check the cable and the device's power, then close and open the rig again",
        )
