"""The specimen's model, Bilen et al., eq. (21), with the slip of eq. (26): deformation in, force out."""

from __future__ import annotations

import math
from numbers import Real
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.core.errors import OutOfRange

Array = npt.NDArray[np.float64]


class SpecimenModel(NamedTuple):
    """An identified specimen: `F = m·ẍ + b·ẋ + k1·x + k2·x³`, x ≥ 0 the compression from the undeformed surface.

    Attributes:
        k1_uN_per_um: linear spring.
        k2_uN_per_um3: hardening spring.
        b_loading_uN_s_per_um: damper while the compression grows.
        b_unloading_uN_s_per_um: damper while it shrinks.
        m_kg: mass; 1 kg·µm/s² is 1 µN. 0 where it was not estimated.
        contact_um: where x = 0 lies in the deformation's own coordinate.
        slip_um: how far the specimen slips into its holder in the end, eq. (26).
        slip_rate_per_s: α of eq. (26).
        covariance: of (k1, k2, b_loading), row-major 3 × 3, in these units; empty if unknown.
        residual_uN: RMS of what the model left over of the force when it was identified, without what the noise of
            the deformation explains.
        deepest_um: largest compression x that was characterised; with a slip, the deformation was deeper by that.
        fastest_um_s, fastest_unloading_um_s: largest speeds that were characterised while the compression grows and
            while it shrinks; the latter is 0 where nothing is known of the way back.
    """

    k1_uN_per_um: float
    k2_uN_per_um3: float
    b_loading_uN_s_per_um: float
    b_unloading_uN_s_per_um: float
    m_kg: float = 0.0
    contact_um: float = 0.0
    slip_um: float = 0.0
    slip_rate_per_s: float = 0.0
    covariance: tuple[float, ...] = ()
    residual_uN: float = 0.0
    deepest_um: float = math.inf
    fastest_um_s: float = math.inf
    fastest_unloading_um_s: float = math.inf


_POSITIVE = ("deepest_um", "fastest_um_s")
_NOT_NEGATIVE = ("residual_uN", "fastest_unloading_um_s")
_MAY_BE_INFINITE = ("deepest_um", "fastest_um_s", "fastest_unloading_um_s")
_PARAMETERS = 3
"""That the covariance is of."""


def check_model(model: SpecimenModel) -> None:
    """Refuse a model that tells no force. A damper may be negative: a specimen may be fitted best by one.

    Raises:
        OutOfRange: a number is not finite (how deep and how fast may be infinite, but not 0 or less, save on the way
            back); the residual or a speed is negative; a slip has no positive rate; the covariance is neither empty
            nor 9 numbers.
    """
    for name, value in model._asdict().items():
        if name == "covariance":
            continue
        number = float(value) if isinstance(value, Real) else math.nan
        fine = math.isfinite(number) or (number == math.inf and name in _MAY_BE_INFINITE)
        if not fine or (name in _POSITIVE and number <= 0.0) or (name in _NOT_NEGATIVE and number < 0.0):
            raise _no_model(f"{name} is {value}")
    if model.slip_um != 0.0 and not model.slip_rate_per_s > 0.0:
        raise _no_model(f"slip of {model.slip_um:g} µm has the rate {model.slip_rate_per_s:g} /s, which is not above 0")
    covariance: object = model.covariance  # callers from notebooks have no type checker
    if not isinstance(covariance, tuple | list):
        raise _no_model(f"covariance is a {type(covariance).__name__}, not a tuple of 9 numbers (3 × 3, row-major)")
    if len(covariance) not in (0, _PARAMETERS**2):
        raise _no_model(f"covariance has {len(covariance)} entries, not 9 (3 × 3, row-major) or none")
    if not all(isinstance(value, Real) and math.isfinite(value) for value in covariance):
        raise _no_model("covariance has an entry that is not a finite number")


def _no_model(what: str) -> OutOfRange:
    return OutOfRange(
        f"the model's {what}", remedy="identify the specimen, or read its specimen.yaml, and use that model unchanged"
    )


def force_uN(
    model: SpecimenModel,
    compression_um: npt.ArrayLike,
    velocity_um_s: npt.ArrayLike,
    acceleration_um_s2: npt.ArrayLike = 0.0,
    *,
    adhesion: bool = False,
) -> Array:
    """Force on the tool, Bilen et al., eq. (21); arguments broadcast.

    Args:
        model: the specimen.
        compression_um: x, what the slip leaves of the deformation; the tool does not touch where x ≤ 0.
        velocity_um_s: ẋ, positive while loading.
        acceleration_um_s2: ẍ.
        adhesion: the specimen may pull: forces below zero and beyond the surface are kept.

    Returns:
        µN, positive where the specimen pushes the tool away; never negative unless `adhesion`.
    """
    x = np.asarray(compression_um, dtype=np.float64)
    v = np.asarray(velocity_um_s, dtype=np.float64)
    a = np.asarray(acceleration_um_s2, dtype=np.float64)
    damper = np.where(v > 0.0, model.b_loading_uN_s_per_um, model.b_unloading_uN_s_per_um)
    force: Array = model.m_kg * a + damper * v + (model.k1_uN_per_um + model.k2_uN_per_um3 * x * x) * x
    if adhesion:
        return force
    # NaN stays NaN: a deformation that was not seen has no force.
    return np.where(x <= 0.0, 0.0, np.maximum(force, 0.0))


def slipped_um(model: SpecimenModel, since_contact_s: npt.ArrayLike) -> Array:
    """How far the specimen has slipped, Bilen et al., eq. (26): `offset·(1 − e^(−α t))`, 0 before contact.

    Args:
        model: the specimen.
        since_contact_s: t, time since the tool touched.
    """
    t = np.maximum(np.asarray(since_contact_s, dtype=np.float64), 0.0)
    return -model.slip_um * np.expm1(-model.slip_rate_per_s * t)


def slip_speed_um_s(model: SpecimenModel, since_contact_s: npt.ArrayLike) -> Array:
    """Rate of `slipped_um`, µm/s; 0 before contact."""
    t = np.asarray(since_contact_s, dtype=np.float64)
    rate = model.slip_um * model.slip_rate_per_s * np.exp(-model.slip_rate_per_s * np.maximum(t, 0.0))
    return np.where(t < 0.0, 0.0, rate)


def stiffness_uN_per_um(model: SpecimenModel, compression_um: npt.ArrayLike) -> Array:
    """Slope of the springs at a compression, `k1 + 3 k2 x²`, µN/µm."""
    x = np.asarray(compression_um, dtype=np.float64)
    return model.k1_uN_per_um + 3.0 * model.k2_uN_per_um3 * x * x
