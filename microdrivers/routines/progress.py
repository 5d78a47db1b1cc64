"""How a routine tells what it is doing."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Somewhere to show progress."""

    def step(self, text: str) -> None:
        """A new phase begins."""

    def count(self, done: int, total: int) -> None:
        """So much of the present phase is done."""


class SilentProgress:
    """Shows nothing."""

    def step(self, text: str) -> None:
        """Show nothing."""

    def count(self, done: int, total: int) -> None:
        """Show nothing."""
