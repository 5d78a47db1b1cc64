"""Reads a device in one thread and hands its frames on in another, so that reading never waits for subscribers."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from microdrivers.core.clock import Clock, Timer
from microdrivers.core.errors import LinkLost, UnsupportedError
from microdrivers.devices.camera import FrameSink, LossHandler, RawFrame

_QUEUE_LENGTH = 4
_IDLE_S = 0.5


def require_real_time(clock: Clock, what: str) -> None:
    """Raises UnsupportedError if `what` would have to run on a simulated clock."""
    if clock.simulated:
        raise UnsupportedError(
            f"{what} is a real device and cannot run on a simulated clock",
            remedy="use --real-time, or an emulator (--fake)",
        )


class FramePump:
    """Two threads of the clock between a device that is read by waiting for it and the camera.

    A device that is always being read holds no stale frames, and arrival times are those of the device's frames and
    not of the subscribers' leisure. If subscribers are slower than the device for longer than four frames, the oldest
    are dropped; that shows as a gap in `frame_id`.

    Args:
        read: waits for a frame; None if this one is of no use.
        interrupt: makes a waiting `read` return or raise LinkLost soon.
    """

    def __init__(
        self,
        read: Callable[[], RawFrame | None],
        interrupt: Callable[[], None],
        *,
        clock: Clock,
        sink: FrameSink,
        lost: LossHandler,
        name: str,
    ) -> None:
        self._read = read
        self._interrupt = interrupt
        self._sink = sink
        self._lost = lost
        self._queue: deque[RawFrame | LinkLost] = deque(maxlen=_QUEUE_LENGTH)
        self._filled = clock.event()
        self._stopping = clock.event()
        self._threads: tuple[Timer, ...] = tuple(
            clock.call_at(clock.now_ns(), loop, name=f"{name} {role}")
            for loop, role in ((self._reading, "reader"), (self._delivering, "delivery"))
        )

    def stop(self) -> None:
        """End both threads; no frame is handed on after this returns."""
        self._stopping.set()
        self._filled.set()
        self._interrupt()
        for thread in self._threads:
            thread.cancel()

    def _reading(self) -> None:
        while not self._stopping.is_set():
            try:
                frame = self._read()
            except LinkLost as error:
                self._put(error)
                return
            if frame is not None:
                self._put(frame)

    def _put(self, item: RawFrame | LinkLost) -> None:
        self._queue.append(item)
        self._filled.set()

    def _delivering(self) -> None:
        while not self._stopping.is_set():
            self._filled.wait(_IDLE_S)
            self._filled.clear()
            while self._queue and not self._stopping.is_set():
                item = self._queue.popleft()
                if isinstance(item, LinkLost):
                    self._lost(item)
                    return
                self._sink(item)
