"""Ctrl-C that comes at a clean moment: while a rig is open, only a waiting clock lets it through.

Raised at any bytecode, a KeyboardInterrupt could fall between taking a lock and guarding it, and leave the line to a
stage locked for good. The first signal is therefore kept until the main program waits; a second one is not kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class Interruption:
    """What a signal handler asks for, and when it may happen.

    Attributes:
        requested: whether an interruption is being kept.
    """

    def __init__(self) -> None:
        self._rigs_open = 0
        self._waiting = self._held = False
        self.requested = False
        self._signals = 0

    def request(self) -> None:
        """Called by a signal handler in the main thread.

        Raises:
            KeyboardInterrupt: nothing is open, the main program is waiting, or it was asked before.
        """
        self._signals += 1
        if self._signals == 1 and (self._held or (self._rigs_open > 0 and not self._waiting)):
            self.requested = True
            return
        self.requested = False
        raise KeyboardInterrupt

    def check(self) -> None:
        """Let a kept interruption happen; called where nothing is half done."""
        if self.requested and not self._held:
            self.requested = False
            raise KeyboardInterrupt

    @contextmanager
    def held(self) -> Iterator[None]:
        """What is done must be done whole, waiting included: a first interruption is kept until afterwards."""
        before, self._held = self._held, True
        try:
            yield
        finally:
            self._held = before

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """The main program waits: an interruption may happen at once."""
        self._waiting = True
        try:
            self.check()
            yield
        finally:
            self._waiting = False

    def rig_opened(self) -> None:
        """From now on interruptions are kept until the main program waits."""
        self._rigs_open += 1
        self._signals = 0
        self.requested = False  # one that came too late for the last rig is not meant for this one

    def rig_closed(self) -> None:
        """The end of that."""
        self._rigs_open -= 1


INTERRUPTION = Interruption()
