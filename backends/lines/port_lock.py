"""Keeps a serial port that somebody else opens, such as a CAN adapter's, to one program."""

from __future__ import annotations

import contextlib
import os


class PortLock:
    """Holds the lock that pyserial's exclusive ports hold, from when it is made until it is closed.

    A channel that is no device which can be opened is let be: whoever opens it says why. So are all on Windows, which
    locks by itself.

    Args:
        channel: as python-can takes it: a device's path, and maybe @ and a baud rate.

    Raises:
        BlockingIOError: another program holds it.
    """

    def __init__(self, channel: str) -> None:
        self._descriptor: int | None = None
        if os.name != "posix" or not channel.startswith("/"):
            return
        import fcntl

        try:
            descriptor = os.open(channel.split("@")[0], os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError:
            return
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(descriptor)
            raise BlockingIOError(error.errno, "it is in use") from error
        except OSError:
            os.close(descriptor)
            raise
        self._descriptor = descriptor

    def close(self) -> None:
        """Let others have it; idempotent."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            with contextlib.suppress(OSError):  # it may have been unplugged
                os.close(descriptor)
