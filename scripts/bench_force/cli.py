"""Runs everything and prints the table."""

from __future__ import annotations

import argparse
import csv
import dataclasses
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from types import ModuleType

import numpy as np
import numpy.typing as npt
from bench_wires.figures import Figure, show

from bench_force.bound import cramer_rao
from bench_force.runs import PROTOCOLS, TESTS, Array, Outcome, load_indenter, push_of, run_records, true_values
from microdrivers.estimators.force.identify import identify
from microdrivers.estimators.force.record import IndentationRecord

RECORDS, COVERED, EFFICIENCY = 100, 200, 400
_INTERVAL = 1.96
_LIMIT_PERCENT = (1.0, 3.0, 3.0)
_REAL = TESTS / "data" / "force" / "chiaro_aebp1_30hz.csv"

Map = Callable[[str, Sequence[int], int, bool], list[Outcome]]


def main() -> int:
    """Print all figures; exit status 1 if one falls short."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--share", type=float, default=1.0, help="of the records to run")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    arguments = parser.parse_args()
    begun = time.perf_counter()
    indenter = load_indenter()
    records, covered, efficiency = (max(8, round(n * arguments.share)) for n in (RECORDS, COVERED, EFFICIENCY))
    figures: list[Figure] = []
    with ProcessPoolExecutor(arguments.workers) as workers:

        def run(preset: str, seeds: Sequence[int], draws: int, fixed: bool) -> list[Outcome]:
            n = len(seeds)
            found = workers.map(run_records, [preset] * n, seeds, [draws] * n, [fixed] * n)
            return [outcome for outcomes in found for outcome in outcomes]

        varied = {}
        for preset in PROTOCOLS:
            outcomes = varied[preset] = run(preset, range(records), max(1, round(covered / records)), False)
            repeats = run(preset, range(8), efficiency // 8, True)
            figures += _preset_figures(indenter, preset, outcomes[:: max(1, round(covered / records))], repeats)
            figures += _coverage(indenter, preset, outcomes)
        figures += _slip_figures(varied["slip_corrected"])
        viscoelastic = run("viscoelastic", range(records), 1, False)
    figures += _misfit_figures(varied, viscoelastic)
    figures += _real_figures()
    seconds = [outcome.seconds for outcomes in (*varied.values(), viscoelastic) for outcome in outcomes]
    samples = np.mean([outcome.samples for outcomes in varied.values() for outcome in outcomes])
    figures.append(
        Figure(
            f"identify, {samples:.0f} samples, CPU",
            "≤ 1 s",
            f"{np.median(seconds):.2f} s median, {max(seconds):.2f} s longest",
            bool(np.median(seconds) <= 1.0),
        )
    )
    status = show(figures)
    print(f"{len(seconds) + 3 * efficiency} identifications in {time.perf_counter() - begun:.0f} s")
    return status


def _preset_figures(
    indenter: ModuleType, preset: str, outcomes: Sequence[Outcome], repeats: Sequence[Outcome]
) -> list[Figure]:
    """Accuracy over many indentations, and efficiency of repeated noise on one."""
    truth = true_values(indenter, preset)
    values = np.array([outcome.values for outcome in outcomes])
    push = dataclasses.replace(push_of(indenter, preset, 0), depth_um=120.0, hold_s=0.0)
    # The samples that most repeats fit: how many are left out after a reversal varies a little.
    votes = np.bincount(np.concatenate([outcome.used for outcome in repeats]))
    bound = cramer_rao(indenter, preset, push, np.flatnonzero(votes > len(repeats) / 2))
    figures = []
    for index, (name, limit) in enumerate(zip(("k1", "k2", "b"), _LIMIT_PERCENT, strict=True)):
        error = 100.0 * (values[:, index] / truth[index] - 1.0)
        bias, rms = abs(error.mean()), float(np.sqrt(np.mean(error**2)))
        allowed = limit
        if preset == "slip_corrected" and name == "b":
            allowed = max(limit, 200.0 * float(bound[index]) / truth[index])
        figures.append(
            Figure(
                f"{preset}: {name}, |bias| + RMS of {len(error)} records",
                f"≤ {allowed:.3g} %",
                f"{bias:.4f} + {rms:.4f} %",
                bool(bias + rms <= allowed),
            )
        )
    ratio = max(outcome.ratio for outcome in outcomes)
    figures.append(
        Figure(f"{preset}: residual over noise-only residual, largest", "≤ 1.3", f"{ratio:.3f}", ratio <= 1.3)
    )
    spread = np.array([outcome.values for outcome in repeats])[:, : len(bound)].var(axis=0, ddof=1) / bound**2
    text = ", ".join(f"{name} {x:.2f}" for name, x in zip(("k1", "k2", "b", "offset", "α"), spread, strict=False))
    figures.append(
        Figure(
            f"{preset}: variance over Cramér–Rao bound, {len(repeats)} runs",
            "≤ 1.3",
            text,
            bool(np.max(spread) <= 1.3),
        )
    )
    return figures


def _coverage(indenter: ModuleType, preset: str, outcomes: Sequence[Outcome]) -> list[Figure]:
    truth = true_values(indenter, preset)
    n = 5 if preset == "slip_corrected" else 3
    values, sigmas = (np.array([getattr(o, name)[:n] for o in outcomes]) for name in ("values", "sigmas"))
    shares = 100.0 * np.mean(np.abs(values - truth[:n]) <= _INTERVAL * sigmas, axis=0)
    text = ", ".join(f"{name} {x:.1f}" for name, x in zip(("k1", "k2", "b", "offset", "α"), shares, strict=False))
    reached = bool(np.all((shares >= 90.0) & (shares <= 99.0)))
    return [Figure(f"{preset}: 95 % intervals cover, {len(outcomes)} runs", "90–99 %", text, reached)]


def _slip_figures(outcomes: Sequence[Outcome]) -> list[Figure]:
    falls = np.array([outcome.error_loading_only / outcome.error for outcome in outcomes])
    errors = [np.mean([getattr(o, name) for o in outcomes]) for name in ("error_loading_only", "error")]
    offset = max(abs(outcome.values[3] - 25.0) for outcome in outcomes)
    alpha = max(abs(outcome.values[4] / 0.1 - 1.0) for outcome in outcomes)
    return [
        Figure(
            "slip: error loading_only → slip_corrected, both branches",
            "falls ≥ 2.5 ×",
            f"{errors[0]:.2f} → {errors[1]:.3f} %, ≥ {falls.min():.0f} ×",
            bool(falls.min() >= 2.5),
        ),
        Figure("slip: offset 25 µm, largest error", "≤ 0.5 µm", f"{offset:.3f} µm", offset <= 0.5),
        Figure("slip: α 0.1 /s, largest error", "≤ 5 %", f"{100.0 * alpha:.2f} %", alpha <= 0.05),
    ]


def _misfit_figures(varied: dict[str, list[Outcome]], viscoelastic: Sequence[Outcome]) -> list[Figure]:
    found = sum(outcome.misfit for outcome in viscoelastic)
    figures = [
        Figure("viscoelastic: misfit found", "always", f"{found} of {len(viscoelastic)}", found == len(viscoelastic))
    ]
    for preset, outcomes in varied.items():
        false = 100.0 * np.mean([outcome.misfit for outcome in outcomes])
        right = 100.0 * np.mean([outcome.best == PROTOCOLS[preset] for outcome in outcomes])
        figures.append(Figure(f"{preset}: misfit said wrongly", "≤ 5 %", f"{false:.1f} %", bool(false <= 5.0)))
        figures.append(Figure(f"{preset}: its protocol is preferred", "", f"{right:.1f} %"))
    return figures


def _real_figures() -> list[Figure]:
    with _REAL.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    time_s, deformation, force = (
        np.array([float(row[name]) for row in rows]) for name in ("time_s", "indentation_um", "force_uN")
    )
    found = identify(IndentationRecord(time_s, deformation, force))
    loading, single = found.protocols["loading"], found.protocols["single"]
    everything = np.arange(len(rows))
    used = np.setdiff1d(everything, np.concatenate(list(found.excluded_samples.values())))
    turn = len(found.branches.loading)
    least = [_least_error(time_s, deformation, force, turn, at) for at in (used[used < turn], used, everything)]
    everywhere = 100.0 * np.sqrt(np.mean((force - single.force_uN) ** 2) / np.mean(force**2))
    b, sigma = loading.b_loading_uN_s_per_um, loading.sigma_b_uN_s_per_um
    return [
        Figure("real indentation: error of loading", "≤ 5.6 %",
               f"{loading.error_percent:.2f} % (least squares {least[0]:.2f} %)", loading.error_percent <= 5.6),
        Figure(f"real indentation: error of single, both branches, the {len(used)} samples fitted", "≤ 16 %",
               f"{single.error_percent:.1f} % (least squares {least[1]:.1f} %)", single.error_percent <= 16.0),
        Figure(f"the same over all {len(rows)}, with those at the reversal, which it does not fit", "",
               f"{everywhere:.1f} % (least squares {least[2]:.1f} %)"),
        Figure("real indentation: b of loading, µN·s/µm", "weak, and said",
               f"{b:.2g} ± {_INTERVAL * sigma:.2g}, identifiable: {loading.identifiable['b']}",
               not loading.identifiable["b"]),
        Figure("real indentation: misfit found", "", str(found.misfit.found)),
    ]  # fmt: skip


def _least_error(time_s: Array, deformation: Array, force: Array, turn: int, at: npt.NDArray[np.int64]) -> float:
    """Least squares on the samples themselves, percent: any k1, k2, b and contact point, speeds within a branch."""
    parts = (slice(None, turn), slice(turn, None))
    speed = np.concatenate([np.gradient(deformation[part], time_s[part]) for part in parts])
    errors = []
    for contact_um in np.linspace(-2.0, 3.0, 201):
        x = deformation - contact_um
        columns = np.column_stack([x, x**3, speed])[at]
        columns /= np.linalg.norm(columns, axis=0)
        left = force[at] - columns @ np.linalg.lstsq(columns, force[at], rcond=None)[0]
        errors.append(100.0 * float(np.sqrt(np.mean(left**2) / np.mean(force[at] ** 2))))
    return min(errors)
