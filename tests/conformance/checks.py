"""Names checks, runs them, and tells which failed."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import pytest

from microdrivers.core.errors import MicrodriversError

Check = Callable[[Any], None]


class Suite:
    """The checks of one device kind, by name."""

    def __init__(self) -> None:
        self.checks: dict[str, Check] = {}

    def check(self, function: Check) -> Check:
        """Add a check under its function's name."""
        self.checks[function.__name__] = function
        return function

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
