"""What every clock offers."""

from __future__ import annotations

import datetime
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Protocol

from microdrivers.core.errors import MicrodriversError
from microdrivers.core.units import seconds_to_ns


class ClockError(MicrodriversError):
    """The clock was used in a way that would make time run backwards or dead-lock."""


class Timer(Protocol):
    """A pending or periodic call."""

    def cancel(self) -> None:
        """No call starts after this returns; a running one has ended, unless it is the caller."""


class ClockEvent(Protocol):
    """A flag that can be waited for on the clock."""

    def set(self) -> None:
        """Raise the flag and wake whoever waits."""

    def is_set(self) -> bool:
        """Whether the flag is up."""

    def clear(self) -> None:
        """Take the flag down."""

    def wait(self, timeout_s: float) -> bool:
        """Wait until the flag is up or `timeout_s` has passed; tells whether it is up."""


class Clock(ABC):
    """Time in ns since an arbitrary origin, monotone; and every way of waiting for it.

    `transaction()` marks a request/reply exchange. On a simulated clock, time inside it belongs to the exchange
    alone: nothing else is dispatched until it ends (see docs/decisions/0003).
    """

    simulated: bool

    @abstractmethod
    def now_ns(self) -> int:
        """The present, ns."""

    @abstractmethod
    def sleep_until(self, t_ns: int) -> None:
        """Wait until `t_ns`; returns at once if that has passed."""

    @abstractmethod
    def call_at(self, t_ns: int, call: Callable[[], object], *, name: str = "") -> Timer:
        """Call once, at `t_ns` or as soon as possible after it."""

    @abstractmethod
    def every(
        self, period_s: float, call: Callable[[], object], *, start_ns: int | None = None, name: str = ""
    ) -> Timer:
        """Call at `start_ns` (default: now) and each `period_s` after it; a call that lasts longer skips beats."""

    @abstractmethod
    def deliver(self, call: Callable[[], object]) -> None:
        """Call at the caller's present, after all that is due before it."""

    @abstractmethod
    def transaction(self) -> AbstractContextManager[None]:
        """Mark a request/reply exchange; may be nested."""

    @property
    def in_transaction(self) -> bool:
        """Whether time belongs to an exchange alone, so that waiting dispatches nothing else; never in real time."""
        return False

    @abstractmethod
    def event(self) -> ClockEvent:
        """A new flag, down."""

    @abstractmethod
    def close(self) -> None:
        """Cancel everything that is pending."""

    def sleep(self, seconds: float) -> None:
        """Wait for `seconds`."""
        self.sleep_until(self.now_ns() + seconds_to_ns(seconds))

    def run_for(self, seconds: float) -> None:
        """Let the rig run for `seconds`; reads better than `sleep` in a notebook on a simulated clock."""
        self.sleep(seconds)


def utc_now() -> datetime.datetime:
    """The calendar's date and time, for names and provenance only; never for measuring."""
    return datetime.datetime.now(datetime.UTC)
