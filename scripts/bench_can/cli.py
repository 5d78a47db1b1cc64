"""Chooses what to measure and prints the table."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable
from pathlib import Path

from bench_wires.figures import Figure, show

from bench_can import exchanges, move, socketcan, streams


def main() -> None:
    """Measure and print."""
    kinds: dict[str, Callable[[argparse.Namespace], list[Figure]]] = {
        "move": lambda asked: move.measure(asked.seeds),
        "streams": lambda asked: streams.measure(asked.repeat),
        "exchanges": lambda asked: exchanges.measure(asked.repeat),
        "socketcan": lambda asked: socketcan.measure(asked.repeat),
    }
    parser = argparse.ArgumentParser(description="What CAN costs and keeps: fine stage and force sensor.")
    parser.add_argument("kinds", nargs="*", choices=[[], *kinds], metavar="KIND", help=f"{', '.join(kinds)}; all")
    parser.add_argument("--repeat", type=float, default=1.0, help="share of the usual times and repetitions")
    parser.add_argument("--seeds", type=int, default=5, help="worlds to move in")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there too")
    asked = parser.parse_args()
    figures = []
    print(f"load average {os.getloadavg()[0]:.2f} on {os.cpu_count()} processors")
    for kind in asked.kinds or kinds:
        print(f"measuring {kind} …", flush=True)
        figures += kinds[kind](asked)
    print()
    show(figures)
    if asked.json:
        asked.json.write_text(json.dumps(figures), encoding="utf-8")
