"""Simulated indentations, identified; every run in a worker process."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.estimators.force.identify import identify
from microdrivers.estimators.force.record import IndentationRecord

Array = npt.NDArray[np.float64]

TESTS = Path(__file__).resolve().parents[2] / "tests"

DEFORMATION_UM, FORCE_UN = 0.06, 0.05
"""Noise of a sample: 0.015 px, and that of the probe over one exposure."""

PROTOCOLS = {"single": "single", "unloading_springs": "unloading_springs", "slip_corrected": "slip_corrected"}
"""Preset → the protocol that matches it."""

PARAMETERS = ("k1", "k2", "b", "offset", "alpha")


def load_indenter() -> ModuleType:
    """The tests' simulator, which shares nothing with the estimators."""
    path = TESTS / "estimators" / "force" / "indenter.py"
    spec = importlib.util.spec_from_file_location("indenter", path)
    if spec is None or spec.loader is None:
        raise SystemExit(f"{path} cannot be loaded; run this script from a checkout")
    module = importlib.util.module_from_spec(spec)
    sys.modules["indenter"] = module
    spec.loader.exec_module(module)
    return module


class Outcome(NamedTuple):
    """What one identification said.

    Attributes:
        preset: of the specimen. best: protocol preferred. misfit: a misfit was found.
        values, sigmas: of `PARAMETERS` by the matching protocol; empty for a specimen outside the model.
        ratio: residual over the noise-only residual. error, error_loading_only: percent, both branches.
        seconds: of one `identify`. samples: of the record. used: places of the samples fitted.
    """

    preset: str
    best: str
    misfit: bool
    values: tuple[float, ...]
    sigmas: tuple[float, ...]
    ratio: float
    error: float
    error_loading_only: float
    seconds: float
    samples: int
    used: tuple[int, ...]


def push_of(indenter: ModuleType, preset: str, seed: int) -> Any:
    """A trapezoid drawn for this seed."""
    return indenter.varied(indenter.Push(), np.random.default_rng((seed, sum(map(ord, preset)))))


def run_records(preset: str, seed: int, draws: int, fixed: bool) -> list[Outcome]:
    """Identify one indentation with several draws of noise; the same indentation for all seeds if `fixed`."""
    indenter = load_indenter()
    push = push_of(indenter, preset, 0 if fixed else seed)
    if fixed:
        push = dataclasses.replace(push, depth_um=120.0, hold_s=0.0)
    truth = indenter.indent(indenter.PRESETS[preset], push)
    rng = np.random.default_rng((seed, 7, sum(map(ord, preset))))
    return [_identified(indenter, preset, truth, rng) for _ in range(draws)]


def _identified(indenter: ModuleType, preset: str, truth: Any, rng: np.random.Generator) -> Outcome:
    noise = indenter.Noise(DEFORMATION_UM, FORCE_UN)
    time_s, deformation, force = indenter.measured(truth, noise, rng)
    record = IndentationRecord(time_s, deformation, force, DEFORMATION_UM, FORCE_UN)
    begun = time.process_time()
    found = identify(record)
    seconds = time.process_time() - begun
    fit = found.protocols[PROTOCOLS.get(preset, found.best)]  # type: ignore[index]
    excluded = np.concatenate(list(found.excluded_samples.values()))
    return Outcome(
        preset=preset,
        best=found.best,
        misfit=found.misfit.found,
        values=(
            fit.k1_uN_per_um,
            fit.k2_uN_per_um3,
            fit.b_loading_uN_s_per_um,
            fit.slip_um,
            fit.slip_rate_per_s,
        ),
        sigmas=(
            fit.sigma_k1_uN_per_um,
            fit.sigma_k2_uN_per_um3,
            fit.sigma_b_uN_s_per_um,
            fit.sigma_slip_um,
            fit.sigma_slip_rate_per_s,
        ),
        ratio=fit.noise_residual_ratio,
        error=fit.error_percent,
        error_loading_only=found.protocols["loading_only"].error_percent,
        seconds=seconds,
        samples=len(time_s),
        used=tuple(np.setdiff1d(np.arange(len(time_s)), excluded).tolist()),
    )


def true_values(indenter: ModuleType, preset: str) -> Array:
    """Of `PARAMETERS`."""
    specimen = indenter.PRESETS[preset]
    return np.array([specimen.k1, specimen.k2, specimen.b_loading, specimen.slip_um, specimen.slip_rate])
