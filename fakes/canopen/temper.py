"""How long a node takes for things."""

from __future__ import annotations

from typing import NamedTuple


class Temper(NamedTuple):
    """How long things take, as (shortest, longest); a seed draws from between.

    Attributes:
        sdo_s: from a request to its reply.
        pdo_s: from a SYNC, a timer or an event to the moment when the frame is ready.
        reset_s, power_on_s: from an NMT reset, or from switching on, to the boot-up.
    """

    sdo_s: tuple[float, float] = (150e-6, 600e-6)
    pdo_s: tuple[float, float] = (20e-6, 80e-6)
    reset_s: tuple[float, float] = (0.05, 0.25)
    power_on_s: tuple[float, float] = (0.6, 1.2)


PROMPT = Temper((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
"""A node that takes no time for anything."""
