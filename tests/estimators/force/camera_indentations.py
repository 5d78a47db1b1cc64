"""Closed-form indentations as a camera sees them, of specimens whose model is known."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.core.contact_samples import DeformationSample, VisionForceSample
from microdrivers.estimators.force.model import SpecimenModel
from microdrivers.estimators.force.vision_force import VisionForce

Array = npt.NDArray[np.float64]

RATE_HZ = 30.0
PIXEL_UM = 0.06
CONTACT_S = 2.0

PRESETS = {
    "single": SpecimenModel(4.5161, 1e-4, 27.72, 27.72),
    "unloading_springs": SpecimenModel(2.9577, 1e-4, 51.3317, 0.0),
    "slip_corrected": SpecimenModel(5.8781, 3.8346e-5, 1.1834, 0.0, slip_um=25.0, slip_rate_per_s=0.1),
}


class Record(NamedTuple):
    t_s: Array
    deformation_um: Array
    force_uN: Array


def indentation(
    preset: SpecimenModel, *, speed_um_s: float = 5.0, depth_um: float = 100.0, hold_s: float = 0.0, phase: float = 0.3
) -> Record:
    """Eqs. (21) and (26) along a trapezoid. The specimen pushes only: once its force is used up it is on its own."""
    in_s = depth_um / speed_um_s
    t = np.arange(0.0, CONTACT_S + 2.0 * in_s + hold_s + 1.0, 1.0 / RATE_HZ) + phase / RATE_HZ
    since = t - CONTACT_S
    tool = speed_um_s * np.minimum(np.minimum(since, in_s), 2.0 * in_s + hold_s - since)
    tool_speed = np.where(since < in_s, speed_um_s, np.where(since < in_s + hold_s, 0.0, -speed_um_s))
    gone = np.exp(-preset.slip_rate_per_s * np.maximum(since, 0.0))
    slip = preset.slip_um * (1.0 - gone)
    x, v = tool - slip, tool_speed - preset.slip_um * preset.slip_rate_per_s * gone
    b = np.where(v > 0.0, preset.b_loading_uN_s_per_um, preset.b_unloading_uN_s_per_um)
    force = preset.k1_uN_per_um * x + preset.k2_uN_per_um3 * x**3 + b * v
    touching = (since > 0.0) & (x > 0.0) & (force > 0.0)
    lost = int(np.flatnonzero(~touching & (since > in_s))[0])
    touching[lost:] = False
    seen = np.where(since > 0.0, tool, 0.0)
    seen[lost:] = relaxing(preset, x[lost - 1], len(t) - lost) + slip[lost:]
    return Record(t, seen, np.where(touching, force, 0.0))


def relaxing(preset: SpecimenModel, start_um: float, count: int) -> Array:
    """A specimen that nothing presses: `b ẋ + k1 x + k2 x³ = 0`, in fine steps; at once without a damper."""
    x, found = start_um, []
    for _ in range(count):
        if preset.b_unloading_uN_s_per_um > 0.0:
            for _ in range(10):
                x -= (
                    (preset.k1_uN_per_um + preset.k2_uN_per_um3 * x * x)
                    * x
                    / (preset.b_unloading_uN_s_per_um * 10.0 * RATE_HZ)
                )
        else:
            x = 0.0
        found.append(x)
    return np.array(found)


def frame(k: int, t_s: float, deformation_um: float, **changes: Any) -> DeformationSample:
    return DeformationSample(
        **{
            "t_ns": round(1e9 * t_s),
            "dt_ns": 1000,
            "device": "microscope",
            "seq": k,
            "deformation_um": deformation_um,
            "sigma_um": PIXEL_UM,
            "tip_um": math.nan,
            "tip_sigma_um": math.nan,
            "u_px": 0.0,
            "v_px": 0.0,
            "found": True,
            "frame_seq": k,
            "exposure_ms": 2.0,
        }
        | changes
    )


def frames(record: Record, *, seed: int = 0, noise_um: float = PIXEL_UM) -> list[DeformationSample]:
    noise = noise_um * np.random.default_rng(seed).standard_normal(len(record.t_s))
    seen = (record.deformation_um + noise).tolist()
    return [frame(k, t, x) for k, (t, x) in enumerate(zip(record.t_s.tolist(), seen, strict=True))]


def fed(estimator: VisionForce, samples: list[DeformationSample]) -> list[VisionForceSample]:
    return [force for sample in samples for force in estimator.update(sample)]


def error_percent(found: list[VisionForceSample], record: Record) -> float:
    """RMS(F − F̂)/RMS(F)."""
    truth = record.force_uN[: len(found)]
    estimate = np.array([force.force_uN for force in found])
    return float(100.0 * np.sqrt(np.mean((truth - estimate) ** 2) / np.mean(truth**2)))


def swinging(preset: SpecimenModel, *, rate_hz: float, speed_um_s: float) -> Record:
    """Eq. (21) along a ramp of 5 µm/s that passes into an oscillation."""
    t = np.arange(0.0, CONTACT_S + 30.0, 1.0 / RATE_HZ) + 0.3 / RATE_HZ
    since, angular = t - CONTACT_S, 2.0 * np.pi * rate_hz
    swings = since - 8.0
    x = np.where(swings < 0.0, 5.0 * np.maximum(since, 0.0), 40.0 + speed_um_s / angular * np.sin(angular * swings))
    v = np.where(since < 0.0, 0.0, np.where(swings < 0.0, 5.0, speed_um_s * np.cos(angular * swings)))
    force = preset.k1_uN_per_um * x + preset.k2_uN_per_um3 * x**3 + preset.b_loading_uN_s_per_um * v
    return Record(t, x, force)
