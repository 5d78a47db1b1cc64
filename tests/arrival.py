"""Bytes on their way: a kernel hands over what was written to a terminal or a connection in its own time."""

import fcntl
import sys
import termios
import time


def unread(descriptor: int) -> int:
    """Bytes that have come and wait to be read."""
    return int.from_bytes(fcntl.ioctl(descriptor, termios.FIONREAD, bytes(4)), sys.byteorder)


def wait_for_unread(descriptor: int, count: int) -> None:
    """Until that many have come; the test has failed if they do not."""
    deadline_s = time.monotonic() + 5.0
    while unread(descriptor) < count:
        assert time.monotonic() < deadline_s, f"{unread(descriptor)} of {count} bytes came"
        time.sleep(0.0005)
