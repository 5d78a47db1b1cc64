"""Chooses what to measure and prints the table."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from bench_wires import cables, calibration, frames, pose, status
from bench_wires.figures import Figure, measure_in_turn, show


def main() -> int:
    """Measure and print; exit status 1 if a figure falls short."""
    kinds: dict[str, Callable[[], list[Figure]]] = {
        "pose": lambda: pose.measure(asked.repeat),
        "status": lambda: status.measure(asked.repeat),
        "frames": lambda: frames.measure(asked.repeat),
        "cables": lambda: cables.measure(asked.repeat),
        "calibration": lambda: calibration.measure(asked.seeds),
    }
    parser = argparse.ArgumentParser(description="What the wires cost: drivers on ports of the operating system.")
    parser.add_argument("kinds", nargs="*", choices=[[], *kinds], metavar="KIND", help=f"{', '.join(kinds)}; all")
    parser.add_argument("--repeat", type=float, default=1.0, help="share of the usual number of repetitions")
    parser.add_argument("--seeds", type=int, default=5, help="worlds to calibrate in")
    asked = parser.parse_args()
    return show(measure_in_turn(kinds, asked.kinds))
