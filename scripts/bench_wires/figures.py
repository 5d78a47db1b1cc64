"""The table of figures, and statistics of repeated measurements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Figure(NamedTuple):
    """One line of the table; `reached` is None where there is nothing to reach."""

    name: str
    limit: str
    measured: str
    reached: bool | None = None


class Times:
    """Measurements in rounds, ns. Other programs disturb whole rounds: the best one is what a quiet computer gives."""

    def __init__(self, *rounds_ns: Sequence[int]) -> None:
        self.number = sum(len(found) for found in rounds_ns)
        self.best_us = min(float(np.median(found)) for found in rounds_ns) / 1e3
        together = np.concatenate(rounds_ns)
        self.median_us = float(np.median(together)) / 1e3
        self.p95_us = float(np.percentile(together, 95)) / 1e3

    def in_us(self) -> str:
        """Median, 95th percentile, number."""
        return f"{self.median_us:.1f} µs (95 % {self.p95_us:.1f}, n {self.number})"

    def in_ms(self) -> str:
        """Median, 95th percentile, number."""
        return f"{self.median_us / 1e3:.2f} ms (95 % {self.p95_us / 1e3:.2f}, n {self.number})"


def show(figures: Sequence[Figure]) -> None:
    """Print them as a table."""
    head = ("figure", "must reach", "measured", "")
    verdicts = {True: "reached", False: "NOT REACHED", None: ""}
    rows = [head, *((f.name, f.limit, f.measured, verdicts[f.reached]) for f in figures)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(head))]
    for number, row in enumerate(rows):
        print("| " + " | ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)) + " |")
        if number == 0:
            print("|" + "|".join("-" * (width + 2) for width in widths) + "|")
