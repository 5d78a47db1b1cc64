"""Progress on a terminal: phases as lines, counts as a bar; plain lines where there is no terminal."""

from __future__ import annotations

import sys

import click

_BAR_WIDTH = 28


class TerminalProgress:
    """Writes to standard error, so that standard output stays clean for --json."""

    def __init__(self, *, quiet: bool = False) -> None:
        self._quiet = quiet
        self._live = sys.stderr.isatty()
        self._bar_open = False

    def step(self, text: str) -> None:
        """A new phase begins."""
        self._close_bar()
        if not self._quiet:
            click.echo(f"· {text}", err=True)

    def count(self, done: int, total: int, *, what: str = "frames") -> None:
        """So much of the present phase is done."""
        if self._quiet or not self._live:
            return
        filled = round(_BAR_WIDTH * done / total) if total else _BAR_WIDTH
        bar = "█" * filled + "░" * (_BAR_WIDTH - filled)
        click.echo(f"\r  {bar} {done}/{total} {what}", nl=False, err=True)
        self._bar_open = True

    def close(self) -> None:
        """Leave the cursor on a new line."""
        self._close_bar()

    def _close_bar(self) -> None:
        if self._bar_open:
            click.echo("", err=True)
            self._bar_open = False
