"""The table of figures, and statistics of repeated measurements."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
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


def in_rounds(
    calls: Mapping[str, Callable[[], object]],
    rounds: int,
    *,
    in_a_round: int,
    pause: Callable[[], object] = lambda: None,
) -> dict[str, Times]:
    """Time the calls in turn, `in_a_round` times each; `pause` comes before each and does not count.

    One round more is made at first, which warms up.
    """
    found: dict[str, list[list[int]]] = {name: [] for name in calls}
    for _ in range(rounds + 1):
        for name, call in calls.items():
            times = []
            for _ in range(in_a_round):
                pause()
                begun_ns = time.perf_counter_ns()
                call()
                times.append(time.perf_counter_ns() - begun_ns)
            found[name].append(times)
    return {name: Times(*times[1:]) for name, times in found.items()}


def measure_in_turn(kinds: Mapping[str, Callable[[], list[Figure]]], asked: Sequence[str]) -> list[Figure]:
    """Measure what was asked for, or all; say at first how busy the computer is."""
    figures: list[Figure] = []
    print(f"load average {os.getloadavg()[0]:.2f} on {os.cpu_count()} processors")
    for kind in asked or kinds:
        print(f"measuring {kind} …", flush=True)
        figures += kinds[kind]()
    print()
    return figures


def show(figures: Sequence[Figure]) -> int:
    """Print them as a table; the exit status: 1 if a figure falls short."""
    head = ("figure", "must reach", "measured", "")
    verdicts = {True: "reached", False: "NOT REACHED", None: ""}
    rows = [head, *((f.name, f.limit, f.measured, verdicts[f.reached]) for f in figures)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(head))]
    for number, row in enumerate(rows):
        print("| " + " | ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)) + " |")
        if number == 0:
            print("|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return 1 if any(figure.reached is False for figure in figures) else 0
