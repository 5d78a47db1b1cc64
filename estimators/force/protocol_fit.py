"""One protocol's result, and which of its parameters the record determines."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from microdrivers.estimators.force.joint import (
    B_LOADING,
    B_UNLOADING,
    CONTACT,
    CONTACT_S,
    K1,
    K2,
    RATE,
    SLIP,
    Motion,
    slopes_of,
)
from microdrivers.estimators.force.model import Array, SpecimenModel
from microdrivers.estimators.force.prepared import Prepared
from microdrivers.estimators.force.protocols import ProtocolName
from microdrivers.estimators.force.record import CLEAR
from microdrivers.estimators.force.structure import StructureTest

INTERVAL = 1.96
"""Half-width of a 95 % interval in standard deviations."""

_WIDEST = 0.25
"""Half-width of a 95 % interval, relative to its parameter, that still tells something about the specimen."""

_CONFOUNDED = 0.9
"""Correlation of damper and contact point beyond which the record hardly tells them apart."""

_COMES_BACK = 0.2
"""Of what was left when the tip let go: what comes back of a specimen that has not slipped."""

_AT_THE_ENDS = 5
"""Samples after the loss of contact, and at the end, that tell what came back."""

_SPRINGS_AND_DAMPER = (K1, K2, B_LOADING)
_PLACES = {"k1": K1, "k2": K2, "b": B_LOADING, "slip": SLIP, "slip_rate": RATE}


@dataclass(frozen=True)
class ProtocolFit:
    """Parameters of `F = m·ẍ + b·ẋ + k1·x + k2·x³` from one way of fitting, Bilen et al., section III.C.

    Attributes:
        name: of the protocol.
        k1_uN_per_um, k2_uN_per_um3, b_loading_uN_s_per_um, b_unloading_uN_s_per_um: springs and damper.
        m_kg: mass; None, as no record at constant speed supports one. `weak` says which mass would have shown.
        contact_um: where x = 0 lies in the deformation's own coordinate. contact_time_s: when it was touched.
        slip_um, slip_rate_per_s: offset and α of eq. (26); 0 unless the protocol has them.
        covariance: 3 × 3, of (k1, k2, b_loading) in these units.
        sigma_k1_uN_per_um, sigma_k2_uN_per_um3, sigma_b_uN_s_per_um, sigma_contact_um, sigma_slip_um,
           , sigma_slip_rate_per_s: standard deviations; 95 % intervals are ±1.96 of them.
        error_percent: 100·RMS(F − F̂)/RMS(F) over all used samples (of the loading alone for `loading`), F̂ from the
            measured deformation and the trajectory's speed.
        noise_residual_ratio: RMS(F − F̂) relative to what noise of force and deformation alone leaves.
        condition_number: of the scaled regressor of eq. (22) on the protocol's samples.
        identifiable: for k1, k2, b, m (and slip, slip_rate): the record determines it, and the model explains the
            samples that it is estimated from within their noise, and no other that explains both branches contradicts
            it (see `Identification`); otherwise the number is no property of the specimen.
        weak: reasons, for those that it does not determine. imprecise: of these, the ones of which no more is amiss
            than that their intervals are wide.
        force_uN: F̂ at every sample of the record, baseline included; without contact the baseline.
        residual_uN: RMS of the force's own residual, the noise of the deformation taken off.
        within_noise: noise alone explains the residuals.
        misfit: test of the residual's structure.
        deepest_um: largest compression among the samples. fastest_um_s, fastest_unloading_um_s: largest speeds among
            them, of the contact point or, where that is faster, of the compression; the latter is 0 where the way
            back was not fitted.
        likelihood_cost: −2·log-likelihood but for a constant, plus the price of the parameters (Schwarz' criterion).
    """

    name: ProtocolName
    k1_uN_per_um: float
    k2_uN_per_um3: float
    b_loading_uN_s_per_um: float
    b_unloading_uN_s_per_um: float
    m_kg: float | None
    contact_um: float
    contact_time_s: float
    slip_um: float
    slip_rate_per_s: float
    covariance: Array
    sigma_k1_uN_per_um: float
    sigma_k2_uN_per_um3: float
    sigma_b_uN_s_per_um: float
    sigma_contact_um: float
    sigma_slip_um: float
    sigma_slip_rate_per_s: float
    error_percent: float
    noise_residual_ratio: float
    condition_number: float
    identifiable: Mapping[str, bool]
    weak: Mapping[str, str]
    imprecise: frozenset[str]
    force_uN: Array
    residual_uN: float
    within_noise: bool
    misfit: StructureTest
    deepest_um: float
    fastest_um_s: float
    fastest_unloading_um_s: float
    likelihood_cost: float

    @property
    def springs_and_damper(self) -> dict[str, tuple[float, float]]:
        """k1, k2 and b of the loading, each with its standard deviation, by the names of `identifiable`."""
        return {
            "k1": (self.k1_uN_per_um, self.sigma_k1_uN_per_um),
            "k2": (self.k2_uN_per_um3, self.sigma_k2_uN_per_um3),
            "b": (self.b_loading_uN_s_per_um, self.sigma_b_uN_s_per_um),
        }

    def with_weak(self, more: Mapping[str, str]) -> ProtocolFit:
        """The same with more reasons why parameters are not determined, by name."""
        weak = {
            **self.weak,
            **{name: "; ".join(filter(None, (self.weak.get(name), why))) for name, why in more.items()},
        }
        return dataclasses.replace(self, weak=weak, identifiable={name: name not in weak for name in self.identifiable})

    def model(self) -> SpecimenModel:
        """What reading force from the camera needs; without a covariance where the record does not tell it."""
        known = bool(np.isfinite(self.covariance).all())
        return SpecimenModel(
            k1_uN_per_um=self.k1_uN_per_um,
            k2_uN_per_um3=self.k2_uN_per_um3,
            b_loading_uN_s_per_um=self.b_loading_uN_s_per_um,
            b_unloading_uN_s_per_um=self.b_unloading_uN_s_per_um,
            m_kg=self.m_kg or 0.0,
            contact_um=self.contact_um,
            slip_um=self.slip_um,
            slip_rate_per_s=self.slip_rate_per_s,
            covariance=tuple(self.covariance.ravel().tolist()) if known else (),
            residual_uN=self.residual_uN,
            deepest_um=self.deepest_um,
            fastest_um_s=self.fastest_um_s,
            fastest_unloading_um_s=self.fastest_unloading_um_s,
        )


def named_parameters(theta: Array, covariance: Array) -> dict[str, float]:
    """Parameters and standard deviations under the names that `ProtocolFit` gives them."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    values = {
        "k1_uN_per_um": theta[K1],
        "k2_uN_per_um3": theta[K2],
        "b_loading_uN_s_per_um": theta[B_LOADING],
        "b_unloading_uN_s_per_um": theta[B_UNLOADING],
        "contact_um": theta[CONTACT],
        "contact_time_s": theta[CONTACT_S],
        "slip_um": theta[SLIP],
        "slip_rate_per_s": theta[RATE],
        "sigma_k1_uN_per_um": sigma[K1],
        "sigma_k2_uN_per_um3": sigma[K2],
        "sigma_b_uN_s_per_um": sigma[B_LOADING],
        "sigma_contact_um": sigma[CONTACT],
        "sigma_slip_um": sigma[SLIP],
        "sigma_slip_rate_per_s": sigma[RATE],
    }
    return {name: float(value) for name, value in values.items()}


def weak_parameters(
    prepared: Prepared,
    theta: Array,
    covariance: Array,
    motion: Motion,
    *,
    slips: bool,
    structured_uN: float,
    misfit: str,
) -> tuple[dict[str, str], frozenset[str]]:
    """Why the record does not determine a parameter, for those that it does not; and those that are only imprecise.

    Args:
        prepared: the samples.
        theta: all parameters.
        covariance: of them.
        motion: of the samples that the protocol is judged by.
        slips: offset and α were estimated.
        structured_uN: RMS of what the model does not explain; a parameter may be off by as much as explains this.
        misfit: how the model does not explain these samples; empty where it does. Springs and damper then follow from
            which samples were fitted, and their intervals say nothing.
    """
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    x, v, a = motion
    levers = {K1: x, K2: x**3, B_LOADING: v, SLIP: slopes_of(theta, motion)[0]}
    came_back = _came_back(prepared) if slips else []
    reasons: dict[str, str] = {}
    imprecise = set()
    for name, place in _PLACES.items():
        if place in (SLIP, RATE) and not slips:
            continue
        value, half = float(theta[place]), float(INTERVAL * sigma[place])
        systematic = structured_uN / float(np.sqrt(np.mean(levers[place] ** 2))) if place in levers else 0.0
        why = []
        if misfit and place in _SPRINGS_AND_DAMPER:
            why.append(misfit)
        if value <= 0.0:
            why.append(f"the estimate {value:.3g} is not positive")
        wide = not half <= _WIDEST * abs(value)
        if wide:
            why.append(f"95 % interval {value - half:.3g} to {value + half:.3g}")
        if not systematic <= _WIDEST * abs(value):
            why.append(f"what the model leaves unexplained is worth {systematic:.2g} of it")
        if place in (SLIP, RATE):
            why += came_back
        if wide and len(why) == 1:
            imprecise.add(name)
        if why and name == "b":
            why.append(_confounded(prepared, theta, covariance, sigma))
        if why:
            reasons[name] = "; ".join(part for part in why if part)
    reasons["m"] = _no_mass(prepared, a)
    return reasons, frozenset(imprecise)


def _came_back(prepared: Prepared) -> list[str]:
    """What has slipped stays where it is: a surface that comes back once it is let go has yielded, Bilen et al., III.C.

    Empty where the surface did not, or was not seen by itself.
    """
    after = prepared.deformation_um[prepared.branches.lost.start : prepared.branches.lost.stop]
    if prepared.contact.seen != "surface" or len(after) < 2 * _AT_THE_ENDS:
        return []
    left_um = float(np.median(after[:_AT_THE_ENDS])) - prepared.contact.contact_um
    back_um = float(np.median(after[:_AT_THE_ENDS]) - np.median(after[-_AT_THE_ENDS:]))
    if back_um < max(_COMES_BACK * left_um, CLEAR * prepared.deformation_sigma_um):
        return []
    return [
        f"after the tip had left, the surface came back by {back_um:.2g} of the {left_um:.2g} µm that were left: the "
        "specimen yields slowly, it has not slipped"
    ]


def _no_mass(prepared: Prepared, acceleration_um_s2: Array) -> str:
    """At constant speed a mass leaves no trace: say how large it would have to be."""
    least = INTERVAL * prepared.force_sigma_uN / max(float(np.sqrt(np.sum(acceleration_um_s2**2))), 1e-12)
    typical = float(np.sqrt(np.mean(acceleration_um_s2**2)))
    return (
        f"a mass shows in accelerations only, {typical:.2g} µm/s² RMS in the samples used: one below {least:.2g} kg "
        "leaves no trace in the force"
    )


def _confounded(prepared: Prepared, theta: Array, covariance: Array, sigma: Array) -> str:
    """On a ramp b·v is a constant force, and so is k1 times an error of the contact point: say how much it is."""
    known = prepared.contact.sigma_um if prepared.contact.seen != "tip" else float(sigma[CONTACT])
    both = sigma[CONTACT] * sigma[B_LOADING]
    correlated = both > 0.0 and abs(covariance[CONTACT, B_LOADING]) > _CONFOUNDED * both
    if prepared.contact.seen != "nothing" and not correlated:
        return ""
    loading = prepared.branches.loading
    first, last = loading.start, loading.stop - 1
    speed = float(prepared.deformation_um[last] - prepared.deformation_um[first]) / float(
        prepared.time_s[last] - prepared.time_s[first]
    )
    shift = abs(float(theta[K1])) * INTERVAL * known / abs(speed)
    unseen = prepared.contact.seen == "nothing"
    begins = "the record begins in contact, or noise hides the onset, and " if unseen else ""
    return (
        f"{begins}at constant speed b·v cannot be told from the contact point: known to ±{INTERVAL * known:.2g} µm, "
        f"that alone is ±{shift:.2g} µN·s/µm of b"
    )


def parameter_covariance(covariance: Array) -> Array:
    """Of (k1, k2, b_loading)."""
    return covariance[np.ix_(_SPRINGS_AND_DAMPER, _SPRINGS_AND_DAMPER)]
