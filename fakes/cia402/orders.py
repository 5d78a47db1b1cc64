"""Control words and modes on their way into effect."""

from __future__ import annotations

import random
from collections import deque
from typing import NamedTuple

from microdrivers.core.units import NS_PER_S


class Reaction(NamedTuple):
    """How long the drive takes, as (shortest, longest): to follow a control word, and to put its motor under power."""

    control_s: tuple[float, float] = (0.2e-3, 1.2e-3)
    enable_s: tuple[float, float] = (1e-3, 5e-3)


AT_ONCE = Reaction((0.0, 0.0), (0.0, 0.0))
"""A drive that takes no time for anything."""


class Order(NamedTuple):
    """A control word, or a mode, that takes effect at `t_ns`."""

    t_ns: int
    value: int
    is_mode: bool


class Orders:
    """They take effect one after the other, in the order in which they came; `seed` draws how long each takes."""

    def __init__(self, reaction: Reaction, *, seed: int) -> None:
        self._reaction = reaction
        self._random = random.Random(seed)
        self._waiting: deque[Order] = deque()

    def add(self, value: int, t_ns: int, *, is_mode: bool = False, enables: bool = False) -> None:
        """One has come; `enables` if it puts the motor under power."""
        low, high = self._reaction.enable_s if enables else self._reaction.control_s
        due_ns = t_ns + int((low + (high - low) * self._random.random()) * NS_PER_S)
        if self._waiting:
            due_ns = max(due_ns, self._waiting[-1].t_ns)
        self._waiting.append(Order(due_ns, value, is_mode))

    @property
    def due_ns(self) -> int | None:
        """When the next takes effect."""
        return self._waiting[0].t_ns if self._waiting else None

    def take(self) -> Order:
        """The next one."""
        return self._waiting.popleft()

    def clear(self) -> None:
        """As after power-on."""
        self._waiting.clear()
