"""Measures the recursion that identifies a specimen on line: speed, exactness, stability, and how near it comes.

Run as `python scripts/bench_specimen_recursion.py` with the package installed; it takes about 10 s. Read the wall times
on a machine with nothing else to do; on a busy one the processor's time is nearer to the truth.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from bench_wires.figures import Figure, show

from microdrivers.core.contact_samples import IndentationSample
from microdrivers.estimators.force.four_samples import STACK, FourSampleRecursion
from microdrivers.estimators.force.recursion import RecursionSettings, SpecimenRecursion

Array = npt.NDArray[np.float64]

RATE_HZ = 30.0
SPEED_UM_S = 5.0
DEPTH_UM = 110.0
CONTACT_S = 2.0
PIXEL_UM = 0.06
SENSOR_UN = 0.05
RIDGE = 1e-9
LONGEST_US = 50.0
"""Of one update, in processor time and the best round."""


class Specimen(NamedTuple):
    """Eq. (21) of Bilen et al. with a damper for either direction; the paper's printed parameters."""

    k1: float
    k2: float
    b_loading: float
    b_unloading: float


SPECIMENS = {
    "single": Specimen(4.5161, 1e-4, 27.72, 27.72),
    "unloading_springs": Specimen(2.9577, 1e-4, 51.3317, 0.0),
}


def indentation(specimen: Specimen, rng: np.random.Generator) -> list[IndentationSample]:
    """In and out again at one speed, from before the contact, as camera and sensor see it."""
    turn_s = DEPTH_UM / SPEED_UM_S
    t = np.arange(0.0, CONTACT_S + 2.0 * turn_s, 1.0 / RATE_HZ) + rng.uniform(0.0, 1.0 / RATE_HZ)
    x = np.maximum(SPEED_UM_S * np.minimum(t - CONTACT_S, CONTACT_S + 2.0 * turn_s - t), 0.0)
    v = np.where(t < CONTACT_S, 0.0, np.where(t < CONTACT_S + turn_s, SPEED_UM_S, -SPEED_UM_S))
    damped = np.where(v > 0.0, specimen.b_loading, specimen.b_unloading) * v
    force = np.where(x > 0.0, np.maximum(specimen.k1 * x + specimen.k2 * x**3 + damped, 0.0), 0.0)
    x = x + PIXEL_UM * rng.standard_normal(len(t))
    force = force + SENSOR_UN * rng.standard_normal(len(t))
    return [
        IndentationSample(
            t_ns=round(1e9 * instant),
            device="indentation",
            deformation_um=float(deformation),
            deformation_sigma_um=PIXEL_UM,
            force_uN=float(felt),
            force_sigma_uN=SENSOR_UN,
            readings=2,
            frame_seq=k,
        )
        for k, (instant, deformation, felt) in enumerate(zip(t, x, force, strict=True))
    ]


def speed(rounds: int, *, with_mass: bool) -> Figure:
    """Time per update in contact: velocity, stack, solution, covariance and the estimate itself."""
    samples = indentation(SPECIMENS["single"], np.random.default_rng(0))
    begin = round((CONTACT_S + 1.5) * RATE_HZ)
    end = round((CONTACT_S + DEPTH_UM / SPEED_UM_S) * RATE_HZ)
    figures, busy = [], []
    for _ in range(rounds):
        estimator = SpecimenRecursion(RecursionSettings(with_mass=with_mass))
        for sample in samples[:begin]:
            estimator.update(sample)
        started, began = time.perf_counter(), time.thread_time()
        for sample in samples[begin:end]:
            estimator.update(sample)
        figures.append((time.perf_counter() - started) / (end - begin) * 1e6)
        busy.append((time.thread_time() - began) / (end - begin) * 1e6)
    name = "with the mass" if with_mass else "k1, k2, b"
    return Figure(
        f"update in contact, {name}",
        f"≤ {LONGEST_US:g} µs",
        f"{np.median(figures):.1f} µs median, {min(figures):.1f} µs best of {rounds} rounds "
        f"(processor time {np.median(busy):.1f}, {min(busy):.1f})",
        bool(min(busy) <= LONGEST_US),
    )


def exactness(count: int) -> None:
    """The recursion against eq. (25) on all rows of all stacks, weighted."""
    rng = np.random.default_rng(1)
    x, v, a = rng.uniform(0.0, 100.0, count), rng.uniform(-6.0, 6.0, count), rng.normal(0.0, 30.0, count)
    force = 4.5 * x + 1e-4 * x**3 + 27.0 * v + 0.2 * a + rng.standard_normal(count)
    factors = np.where(rng.uniform(size=count) < 0.02, 0.1, rng.uniform(0.95, 1.0, count))
    estimator = FourSampleRecursion(ridge=RIDGE, with_mass=True)
    for k in range(count):
        estimator.update(
            x_um=float(x[k]),
            v_um_s=float(v[k]),
            a_um_s2=float(a[k]),
            force_uN=float(force[k]),
            forgetting=float(factors[k]),
        )
    scales = estimator.scales
    rows = np.column_stack([(x / scales.x_um) ** 3, x / scales.x_um, v / scales.v_um_s, a / scales.a_um_s2])
    R, f = np.zeros((4, 4)), np.zeros(4)
    for k in range(count):
        beta = np.prod(factors[k + 1 :])
        stack = slice(max(0, k - STACK + 1), k + 1)
        R += beta * (rows[stack].T @ rows[stack] + RIDGE * np.eye(4))
        f += beta * (rows[stack].T @ force[stack])
    batch = np.linalg.solve(R, f)
    relative = np.abs(np.array(estimator.theta) - batch).max() / np.linalg.norm(batch)
    print(f"max |recursive − batch ridge of the stacked rows|, relative: {relative:.1e} ({count} samples)")


def stability(updates: int) -> None:
    """One speed, depths that differ by noise only: nothing but their sum is determined, for a long time."""
    rng = np.random.default_rng(2)
    estimator = FourSampleRecursion(ridge=RIDGE)
    largest = 0.0
    for x, noise in rng.standard_normal((updates, 2)).tolist():
        estimator.update(x_um=50.0 + 1e-6 * x, v_um_s=5.0, force_uN=300.0 + 0.05 * noise, forgetting=0.99)
        size = max(map(abs, estimator.theta))
        largest = size if not size <= largest else largest
    predicted = estimator.predict_uN(x_um=50.0, v_um_s=5.0)
    print(
        f"{updates} singular updates: max |θ| {largest:.0f} µN, finite: {math.isfinite(largest)}, "
        f"force there {predicted:.2f} µN (true 300), determined: {estimator.spread().determined}"
    )


def accuracy(runs: int) -> None:
    """Bias and RMS of the last estimate of a branch, each branch by its own recursion; share inside ±1.96 σ."""
    rng = np.random.default_rng(3)
    for name, specimen in SPECIMENS.items():
        for branch, b in (("LOADING", specimen.b_loading), ("UNLOADING", specimen.b_unloading)):
            truth = np.array([specimen.k1, specimen.k2, b])
            errors, inside = [], np.zeros(3)
            for _ in range(runs):
                estimator = SpecimenRecursion(RecursionSettings(forgetting=1.0, separate_branches=True))
                found = [e for s in indentation(specimen, rng) for e in estimator.update(s) if branch in e.flags][-1]
                error = np.array([found.k1_uN_per_um, found.k2_uN_per_um3, found.b_uN_s_per_um]) - truth
                errors.append(error / np.array([specimen.k1, specimen.k2, specimen.b_loading]))
                inside += np.abs(error) <= 1.96 * np.sqrt(np.array(found.covariance)[[0, 4, 8]])
            bias, rms = 100.0 * np.mean(errors, axis=0), 100.0 * np.sqrt(np.mean(np.square(errors), axis=0))
            print(
                f"{name}, {branch.lower()}, {runs} runs, (k1, k2, b) in % (b of the loading one): "
                f"bias {np.array2string(bias, precision=2)} RMS {np.array2string(rms, precision=2)}, "
                f"inside ±1.96 σ {np.array2string(100.0 * inside / runs, precision=0)} %"
            )


def main() -> int:
    """Print all figures; exit status 1 if the recursion is too slow."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=20, help="simulated indentations a specimen")
    parser.add_argument("--rounds", type=int, default=25, help="rounds of the timing")
    arguments = parser.parse_args()
    status = show([speed(arguments.rounds, with_mass=with_mass) for with_mass in (False, True)])
    exactness(count=1500)
    stability(updates=100_000)
    accuracy(arguments.runs)
    return status


if __name__ == "__main__":
    sys.exit(main())
