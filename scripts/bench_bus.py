"""Times sample creation and publication; prints the best and the median of several rounds."""

from __future__ import annotations

import statistics
import time

from microdrivers.core.bus import Bus
from microdrivers.core.samples import XYThetaSample

ROUNDS, SAMPLES = 15, 20_000


def make() -> XYThetaSample:
    """One pose."""
    return XYThetaSample(
        t_ns=1, device="stage", x_um=1.0, y_um=2.0, theta_deg=3.0, moving=False, on_target=True, referenced=True
    )


def publish_us(subscribers: int) -> list[float]:
    """µs a publication, one value a round."""
    topic = Bus().topic("stage", XYThetaSample)
    for _ in range(subscribers):
        topic.subscribe(lambda _sample: None)
    rounds = []
    for _ in range(ROUNDS):
        samples = [make() for _ in range(SAMPLES)]
        begun = time.perf_counter()
        for sample in samples:
            topic.publish(sample)
        rounds.append((time.perf_counter() - begun) / SAMPLES * 1e6)
    return rounds


def create_us() -> list[float]:
    """µs to create a sample, one value a round."""
    rounds = []
    for _ in range(ROUNDS):
        begun = time.perf_counter()
        for _ in range(SAMPLES):
            make()
        rounds.append((time.perf_counter() - begun) / SAMPLES * 1e6)
    return rounds


def main() -> None:
    """Print the table."""
    for name, rounds in (
        ("create a pose sample", create_us()),
        *((f"publish to {n} subscribers", publish_us(n)) for n in (0, 1, 4, 16)),
    ):
        print(f"{name:<28} best {min(rounds):5.2f} µs   median {statistics.median(rounds):5.2f} µs")


if __name__ == "__main__":
    main()
