"""Chooses what to measure and prints the table."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable

from bench_wires import cables, calibration, frames, pose, status
from bench_wires.figures import Figure, show


def main() -> None:
    """Measure and print."""
    kinds: dict[str, Callable[[argparse.Namespace], list[Figure]]] = {
        "pose": lambda asked: pose.measure(asked.repeat),
        "status": lambda asked: status.measure(asked.repeat),
        "frames": lambda asked: frames.measure(asked.repeat),
        "cables": lambda asked: cables.measure(asked.repeat),
        "calibration": lambda asked: calibration.measure(asked.seeds),
    }
    parser = argparse.ArgumentParser(description="What the wires cost: drivers on ports of the operating system.")
    parser.add_argument("kinds", nargs="*", choices=[[], *kinds], metavar="KIND", help=f"{', '.join(kinds)}; all")
    parser.add_argument("--repeat", type=float, default=1.0, help="share of the usual number of repetitions")
    parser.add_argument("--seeds", type=int, default=5, help="worlds to calibrate in")
    asked = parser.parse_args()
    figures = []
    print(f"load average {os.getloadavg()[0]:.2f} on {os.cpu_count()} processors")
    for kind in asked.kinds or kinds:
        print(f"measuring {kind} …", flush=True)
        figures += kinds[kind](asked)
    print()
    show(figures)
