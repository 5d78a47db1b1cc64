"""Chooses what to measure and prints the table."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

from bench_wires.figures import Figure, measure_in_turn, show

from bench_can import exchanges, move, socketcan, streams


def main() -> int:
    """Measure and print; exit status 1 if a figure falls short."""
    kinds: dict[str, Callable[[], list[Figure]]] = {
        "move": lambda: move.measure(asked.seeds),
        "streams": lambda: streams.measure(asked.repeat),
        "exchanges": lambda: exchanges.measure(asked.repeat),
        "socketcan": lambda: socketcan.measure(asked.repeat),
    }
    parser = argparse.ArgumentParser(description="What CAN costs and keeps: fine stage and force sensor.")
    parser.add_argument("kinds", nargs="*", choices=[[], *kinds], metavar="KIND", help=f"{', '.join(kinds)}; all")
    parser.add_argument("--repeat", type=float, default=1.0, help="share of the usual times and repetitions")
    parser.add_argument("--seeds", type=int, default=5, help="worlds to move in")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there too")
    asked = parser.parse_args()
    figures = measure_in_turn(kinds, asked.kinds)
    if asked.json:
        asked.json.write_text(json.dumps(figures), encoding="utf-8")
    return show(figures)
