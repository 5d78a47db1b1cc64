"""Records for the tests: simulated indentations, integrated once each, and the real one."""

from __future__ import annotations

import csv
import functools
from pathlib import Path

import numpy as np

from microdrivers.estimators.force.record import IndentationRecord
from tests.estimators.force.indenter import PRESETS, Noise, Push, Specimen, Truth, indent, measured

REAL = Path(__file__).resolve().parents[2] / "data" / "force" / "chiaro_aebp1_30hz.csv"


@functools.cache
def indented(specimen: Specimen, push: Push) -> Truth:
    return indent(specimen, push)


def recorded(
    preset: str | Specimen,
    push: Push | None = None,
    noise: Noise | None = None,
    *,
    seed: int = 0,
    of: str = "surface",
    stated: bool = True,
) -> IndentationRecord:
    specimen = PRESETS[preset] if isinstance(preset, str) else preset
    noise = noise or Noise()
    truth = indented(specimen, push or Push())
    columns = measured(truth, noise, np.random.default_rng(seed), of=of)
    sigmas = (noise.deformation_um, noise.force_uN) if stated else (0.0, 0.0)
    return IndentationRecord(*columns, *sigmas)


def part(record: IndentationRecord, start_s: float, stop_s: float) -> IndentationRecord:
    kept = (record.time_s >= start_s) & (record.time_s < stop_s)
    return record._replace(
        time_s=record.time_s[kept], deformation_um=record.deformation_um[kept], force_uN=record.force_uN[kept]
    )


def real() -> IndentationRecord:
    with REAL.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    return IndentationRecord(*(np.array([float(r[k]) for r in rows]) for k in ("time_s", "indentation_um", "force_uN")))
