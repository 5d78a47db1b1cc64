"""pyserial's handler of `fake://NAME` (the file's name is pyserial's rule)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import serial

from microdrivers.core.errors import LinkLost
from microdrivers.core.units import seconds_to_ns
from microdrivers.fakes.wire.wire import Wire, wire_named

P = ParamSpec("P")
T = TypeVar("T")


class Serial(serial.SerialBase):  # type: ignore[misc]
    """A port whose other end is an emulator.

    A second open is refused, as the real driver's exclusive lock does. Reading waits on the wire's clock,
    never on the operating system's.
    """

    is_open: bool

    def open(self) -> None:
        """Take the wire.

        Raises:
            serial.SerialException: there is no such wire, it is unplugged, or it is already open.
        """
        if self.is_open:
            raise serial.SerialException("the port is already open")
        name = str(self.portstr).removeprefix("fake://")
        wire = wire_named(name)
        if wire is None or not wire.plugged:
            raise serial.SerialException(2, f"could not open port {self.portstr}: no such emulator")
        if wire.in_use:
            raise serial.SerialException(16, f"could not open port {self.portstr}: it is in use")
        wire.in_use = True
        wire.connect()
        self._wire: Wire = wire
        self.is_open = True

    def close(self) -> None:
        """Give the wire back."""
        if self.is_open:
            self._wire.in_use = False
            self.is_open = False

    def read(self, size: int = 1) -> bytes:
        """Read up to `size` bytes within the time-out."""
        self._check_open()
        clock = self._wire.clock
        deadline_ns = clock.now_ns() + seconds_to_ns(self._timeout_s())
        received = b""
        while True:
            received += self._link(self._wire.read, size - len(received))
            now_ns = clock.now_ns()
            if len(received) >= size or now_ns >= deadline_ns:
                return received
            next_ns = self._wire.next_arrival_ns()
            clock.sleep_until(deadline_ns if next_ns is None else min(max(next_ns, now_ns + 1), deadline_ns))

    def write(self, data: Any) -> int:
        """Send bytes; returns at once, as a UART's buffer does."""
        self._check_open()
        self._link(self._wire.write, bytes(data))
        return len(data)

    @property
    def in_waiting(self) -> int:
        """Bytes that have arrived."""
        self._check_open()
        return self._link(self._wire.waiting)

    def reset_input_buffer(self) -> None:
        """Drop what has arrived."""
        self.read(self.in_waiting)

    def reset_output_buffer(self) -> None:
        """Nothing waits: written bytes are on the line."""

    def flush(self) -> None:
        """Nothing to wait for."""

    def _timeout_s(self) -> float:
        if self._timeout is None:
            raise serial.SerialException("an emulated port needs a time-out")
        return float(self._timeout)

    def _check_open(self) -> None:
        if not self.is_open:
            raise serial.PortNotOpenError()

    def _link(self, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return call(*args, **kwargs)
        except LinkLost as error:
            raise serial.SerialException(5, error.what) from error

    def _reconfigure_port(self) -> None:
        """Baud rate and framing belong to the wire."""
