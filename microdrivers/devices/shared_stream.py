"""One stream for all who want one."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager


class SharedStream:
    """Opens a device's stream for the first who asks, at a higher rate for who wants more, and ends it with the last.

    Args:
        open_at: opens the device's one stream at a rate, Hz.
        running: whether it is open; a device that is closed ends it.
    """

    def __init__(self, open_at: Callable[[float], AbstractContextManager[None]], running: Callable[[], bool]) -> None:
        self._open_at = open_at
        self._running = running
        self._lock = threading.RLock()
        self._users = 0
        self._rate_hz = 0.0
        self._stream: AbstractContextManager[None] | None = None

    @contextmanager
    def at(self, rate_hz: float) -> Iterator[None]:
        """Have samples come at this rate, or faster, while the context is open.

        Raises:
            OutOfRange: the device cannot. LinkError: it does not answer. What was open before stays open.
        """
        with self._lock:
            if not self._running():
                self._begin(rate_hz)
            elif rate_hz > self._rate_hz:
                before_hz = self._rate_hz
                self._end()
                try:
                    self._begin(rate_hz)
                except BaseException:
                    self._begin(before_hz)
                    raise
            self._users += 1
        try:
            yield
        finally:
            with self._lock:
                self._users -= 1
                if not self._users:
                    self._end()

    def _begin(self, rate_hz: float) -> None:
        self._end()
        stream = self._open_at(rate_hz)
        stream.__enter__()
        self._stream, self._rate_hz = stream, rate_hz

    def _end(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.__exit__(None, None, None)
