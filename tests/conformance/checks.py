"""Names checks, runs them, and tells which failed."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from typing import Any

import pytest

from microdrivers.core.errors import MicrodriversError

Check = Callable[[Any], None]

_MAY_FAIL = 2


class Suite:
    """The checks of one device kind, by name."""

    def __init__(self) -> None:
        self.checks: dict[str, Check] = {}

    def check(self, function: Check) -> Check:
        """Add a check under its function's name."""
        self.checks[function.__name__] = function
        return function

    def hold_in_real_time(self, name: str, make_bench: Callable[[], AbstractContextManager[Any]]) -> None:
        """Run a check on a fresh bench whose emulator is a thread of this computer.

        While the computer is busy with something else the emulator latches later than the bytes came, and no driver
        can know. Checks of stamps may therefore fail twice; a driver that is wrong fails them always.
        """
        for _ in range(_MAY_FAIL if name.startswith("stamps_") else 0):
            with make_bench() as bench, suppress(AssertionError):
                self.checks[name](bench)
                return
        with make_bench() as bench:
            self.checks[name](bench)

    def failing(self, make_bench: Callable[[], AbstractContextManager[Any]]) -> dict[str, str]:
        """Run every check on a fresh bench; the names of those that failed, and why."""
        failed = {}
        for name, function in self.checks.items():
            with make_bench() as bench:
                try:
                    function(bench)
                except (AssertionError, MicrodriversError, pytest.fail.Exception) as error:
                    failed[name] = str(error)
        return failed
