"""Ports: bytes in and out, and nothing about requests or replies.

pyserial opens and configures serial ports. On POSIX they and TCP connections are polled, read and written by their
descriptors: pyserial's own methods cost many times the system calls that they make, and read a TCP connection byte by
byte (docs/decisions/0006). Elsewhere, and for all other URLs of pyserial, its methods are used.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import urllib.parse
from collections.abc import Callable
from typing import Any, Protocol

import serial

from microdrivers.backends.lines.settings import SerialConnection
from microdrivers.core.clock import Clock
from microdrivers.core.errors import LinkLost, UnsupportedError
from microdrivers.core.units import NS_PER_MS, NS_PER_S

_CHUNK = 4096
_MOST_WAITING = 65536
_CONNECT_TIMEOUT_S = 2.0
_TCP = "socket://"

OPEN_REMEDIES = {
    errno.ENOENT: "check the cable and the port's name (ls -l /dev/serial/by-id); without hardware use --fake",
    errno.EACCES: "you may not open the port: add yourself to the group that owns it (often dialout) and log in again",
    errno.EBUSY: "another program, or another device of this rig, uses the port: close it first",
    errno.EAGAIN: "another program uses the port: close it first",
    errno.ECONNREFUSED: "nobody listens there: check the address, and that the device or `microdrivers serve` runs",
}
"""What to do about a port that cannot be opened, by the operating system's error number."""


class Port(Protocol):
    """An open port. All methods raise `OSError` once the device is gone."""

    def write(self, data: bytes) -> None:
        """Hand bytes to the operating system; waits only if its buffer is full."""

    def read_available(self) -> bytes:
        """What has arrived."""

    def read_within(self, wait_ns: int) -> bytes:
        """Bytes as soon as there are any, b"" if there are none within `wait_ns`."""

    def close(self) -> None:
        """Give the port up."""


class DescriptorPort:
    """A serial port or TCP connection of the operating system, which does not block.

    Args:
        descriptor: what to poll, read and write.
        write_rest: waits until there is room for what the operating system's buffer has not taken at once.
        close: gives the port up.
    """

    def __init__(self, descriptor: int, write_rest: Callable[[bytes], object], close: Callable[[], object]) -> None:
        self._write_rest = write_rest
        self._give_up = close
        self._descriptor = descriptor
        poller = select.poll()
        poller.register(self._descriptor, select.POLLIN)
        self._poll = poller.poll

    def write(self, data: bytes) -> None:
        """Hand bytes to the operating system; waits only if its buffer is full."""
        try:
            taken = os.write(self._descriptor, data)
        except BlockingIOError:
            taken = 0
        if taken < len(data):
            self._write_rest(data[taken:])

    def read_available(self) -> bytes:
        """What has arrived."""
        waiting = b""
        try:
            while (data := os.read(self._descriptor, _CHUNK)) and len(waiting) < _MOST_WAITING:
                waiting += data
        except BlockingIOError:  # nothing there; a terminal says so with no bytes instead
            pass
        return waiting

    def read_within(self, wait_ns: int) -> bytes:
        """Bytes as soon as there are any, b"" if there are none within `wait_ns`."""
        if not self._poll(wait_ns / NS_PER_MS if wait_ns > 0 else 0):
            return b""
        data = os.read(self._descriptor, _CHUNK)
        if not data:
            raise OSError(errno.EIO, "the port reports data and delivers none: device disconnected")
        return data

    def close(self) -> None:
        """Give the port up."""
        self._descriptor = -1  # its number may soon belong to another file
        self._give_up()


class PyserialPort:
    """A port that is not polled by descriptor: pyserial reads and writes it."""

    def __init__(self, opened: Any) -> None:
        self._opened = opened

    def write(self, data: bytes) -> None:
        """Hand bytes to pyserial."""
        self._opened.write(data)

    def read_available(self) -> bytes:
        """What has arrived."""
        waiting = self._opened.in_waiting
        return bytes(self._opened.read(waiting)) if waiting else b""

    def read_within(self, wait_ns: int) -> bytes:
        """Bytes as soon as there are any, b"" if there are none within `wait_ns`."""
        self._opened.timeout = max(wait_ns, 0) / NS_PER_S
        first = bytes(self._opened.read(1))
        return first + bytes(self._opened.read(self._opened.in_waiting)) if first else b""

    def close(self) -> None:
        """Give the port up."""
        self._opened.close()


def open_port(wanted: SerialConnection, clock: Clock) -> Port:
    """Open and configure a port.

    Raises:
        LinkLost: it is absent, busy or forbidden; the remedy says which.
        UnsupportedError: it exists in real time only, and the clock is simulated.
    """
    has_descriptor = os.name == "posix" and (wanted.port.startswith(_TCP) or "://" not in wanted.port)
    if has_descriptor and clock.simulated:
        raise UnsupportedError(
            f"{wanted.port} is a real port and cannot run on a simulated clock",
            remedy="use --real-time, or an emulator (--fake)",
        )
    try:
        if has_descriptor and wanted.port.startswith(_TCP):
            return _open_tcp(wanted)
        opened = serial.serial_for_url(
            wanted.port, baudrate=wanted.baudrate, parity=wanted.parity, stopbits=wanted.stopbits,
            timeout=0, write_timeout=wanted.timeout_s, exclusive=True if os.name == "posix" else None,
        )  # fmt: skip
    except (OSError, ValueError) as error:  # SerialException is an OSError
        code = getattr(error, "errno", None) or _errno_in(str(error))
        remedy = OPEN_REMEDIES.get(code or 0, "check the port's name and settings in the rig file")
        raise LinkLost(f"cannot open port {wanted.port}: {error}", remedy=remedy, moved="no") from error
    return DescriptorPort(opened.fileno(), opened.write, opened.close) if has_descriptor else PyserialPort(opened)


def _open_tcp(wanted: SerialConnection) -> Port:
    address = urllib.parse.urlsplit(wanted.port)
    if not address.hostname or not address.port:
        raise ValueError(f"a TCP port is written {_TCP}HOST:PORT")
    connection = socket.create_connection((address.hostname, address.port), timeout=_CONNECT_TIMEOUT_S)
    # A stop must not wait until what was sent before it has been acknowledged (Nagle's algorithm).
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.settimeout(wanted.timeout_s)
    return DescriptorPort(connection.fileno(), connection.sendall, connection.close)


def _errno_in(text: str) -> int | None:
    """Pyserial hides the errno of a failed open in its message."""
    return next((code for code in OPEN_REMEDIES if f"[Errno {code}]" in text), None)
