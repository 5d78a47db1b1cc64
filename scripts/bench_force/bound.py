"""The Cramér–Rao bound of an indentation, from difference quotients of the simulation itself.

Unknown besides the specimen: the stage's place, depth and both speeds, the stiffness of the sensor, the zeros of
deformation and force. Samples: those fitted, and the approach.
"""

from __future__ import annotations

import dataclasses
from types import ModuleType
from typing import Any

import numpy as np

from bench_force.runs import DEFORMATION_UM, FORCE_UN, Array
from microdrivers.estimators.force.prepared import Indices

_STEP = 1e-4
_OF_THE_MOTION = ("start_um", "depth_um", "speed_um_s", "back_um_s", "sensor_uN_per_um")
_OF_THE_SPECIMEN = {
    "single": ("k1", "k2", "b_loading"),
    "unloading_springs": ("k1", "k2", "b_loading"),
    "slip_corrected": ("k1", "k2", "b_loading", "slip_um", "slip_rate"),
}


def cramer_rao(indenter: ModuleType, preset: str, push: Any, used: Indices) -> Array:
    """Least standard deviations of the specimen's parameters.

    Args:
        indenter: the simulator.
        preset: of the specimen; `single` has one damper for both ways.
        push: how it is indented.
        used: indices of the samples that count besides the approach.
    """
    specimen = indenter.PRESETS[preset]
    push = dataclasses.replace(push, back_um_s=push.speed_um_s)
    truth = indenter.indent(specimen, push)
    approach = np.flatnonzero(truth.time_s < truth.contact_s - 1.0 / indenter.FRAME_HZ)
    at = np.union1d(approach, used)
    columns = []
    for name in (*_OF_THE_SPECIMEN[preset], *_OF_THE_MOTION):
        of_specimen = name in _OF_THE_SPECIMEN[preset]
        size = getattr(specimen if of_specimen else push, name)
        names = ("b_loading", "b_unloading") if name == "b_loading" and preset == "single" else (name,)
        sides = []
        for step in (_STEP * abs(size), -_STEP * abs(size)):
            changed = dict.fromkeys(names, size + step)
            truth = indenter.indent(
                dataclasses.replace(specimen, **changed) if of_specimen else specimen,
                push if of_specimen else dataclasses.replace(push, **changed),
            )
            sides.append(np.concatenate([truth.deformation_um[at] / DEFORMATION_UM, truth.force_uN[at] / FORCE_UN]))
        columns.append((sides[0] - sides[1]) / (2.0 * _STEP * abs(size)))
    zero = np.zeros(len(at))
    columns += [np.concatenate([zero + 1.0, zero]), np.concatenate([zero, zero + 1.0])]
    jacobian = np.column_stack(columns)
    scale = np.linalg.norm(jacobian, axis=0)
    covariance = np.linalg.inv((jacobian / scale).T @ (jacobian / scale)) / np.outer(scale, scale)
    deviations: Array = np.sqrt(np.diag(covariance))[: len(_OF_THE_SPECIMEN[preset])]
    return deviations
