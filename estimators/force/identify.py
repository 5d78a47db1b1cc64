"""A specimen identified from one indentation, Bilen et al., sections II.B and III.C."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from microdrivers.core.errors import IllConditioned
from microdrivers.estimators.force.branches import Branches
from microdrivers.estimators.force.fit_motion import motion_everywhere
from microdrivers.estimators.force.joint import BASE, Motion, force_of, motion_of, slopes_of
from microdrivers.estimators.force.model import Array
from microdrivers.estimators.force.notes import notes_on
from microdrivers.estimators.force.outliers import outliers
from microdrivers.estimators.force.prepared import LOADING, UNLOADING, Indices, Prepared, SeenBefore
from microdrivers.estimators.force.protocol_fit import (
    ProtocolFit,
    named_parameters,
    parameter_covariance,
    weak_parameters,
)
from microdrivers.estimators.force.protocols import Fit, ProtocolName
from microdrivers.estimators.force.record import IndentationRecord, Mask, check
from microdrivers.estimators.force.ridge import ridge_fit
from microdrivers.estimators.force.selection import all_protocols, settled
from microdrivers.estimators.force.structure import StructureTest, structure_test

_AS_LIKELY = 10.0
"""Difference of −2·log-likelihood between two explanations that a record cannot tell apart for sure."""

_APART = 3.0
"""Standard deviations of a difference that is none of noise."""

_SIMPLER = 1.1
"""Of the smallest error: what a protocol with fewer parameters may have and still be preferred."""

_CLEARLY = 0.5
"""Of the smallest error without a slip: what one leaves that is not well determined and is preferred all the same."""


class IdentificationSettings(NamedTuple):
    """How to identify.

    Attributes:
        around_reversal: samples left out on either side of contact, reversals and release.
        protocol: which one's model counts; None: the one that explains the record best, see `Identification.best`.
    """

    around_reversal: int = 2
    protocol: ProtocolName | None = None


class Contact(NamedTuple):
    """Where and when the tool met the specimen, as the best protocol has it.

    Attributes:
        contact_um: where the undeformed surface lies in the deformation's own coordinate; sigma_um: its standard
            deviation. contact_time_s, sigma_time_s: when it was touched; 0 s deviation if the record begins in contact.
        seen: what the deformation followed before: the surface, the tool's tip, or nothing.
    """

    contact_um: float
    contact_time_s: float
    sigma_um: float
    sigma_time_s: float
    seen: SeenBefore


class Slip(NamedTuple):
    """Eq. (26), `x* = x − offset·(1 − e^(−α t))`, as `slip_corrected` has it.

    Attributes:
        offset_um, rate_per_s: offset and α, each followed by its standard deviation.
        not_returned_um: deformation that was left when contact was lost; None if it was not lost.
        identifiable: the record determines offset and α, no other protocol explains it as well, and this one leaves
            nothing but noise. reason: why not; empty if it is.
    """

    offset_um: float
    sigma_offset_um: float
    rate_per_s: float
    sigma_rate_per_s: float
    not_returned_um: float | None
    identifiable: bool
    reason: str


@dataclass(frozen=True)
class Identification:
    """What one indentation says about a specimen.

    Attributes:
        protocols: by name; those that the record allows: without an unloading only `loading`.
        best: name of the one that explains both branches best: within noise and by likelihood, or else by the error,
            the simpler one where that makes no difference. `slip_corrected` never is where its slip cannot be one
            (`Slip.reason`); where that is only imprecise, if no other explains the record nearly as well.
        contact: where and when.
        slip: None without an unloading.
        branches: index ranges of the record, and instants of its reversals.
        excluded_samples: reason → indices of the samples that no fit uses.
        misfit: test of the best protocol's residual structure.
        contact_duration_s: from contact to its loss or the end of the record.
        deformation_sigma_um, force_sigma_uN: noise used: as stated or, if clearly more was observed, as observed.
        baseline_uN: the force out of contact, at every sample, as it was taken off; 0 where the record shows none.
        knots_s: spacing of the knots of the splines that the best protocol's trajectory follows; 0 for ramps.
        notes: what else should be known, in sentences.
    """

    protocols: Mapping[ProtocolName, ProtocolFit]
    best: ProtocolName
    contact: Contact
    slip: Slip | None
    branches: Branches
    excluded_samples: Mapping[str, Indices]
    misfit: StructureTest
    contact_duration_s: float
    deformation_sigma_um: float
    force_sigma_uN: float
    baseline_uN: Array
    knots_s: float
    notes: tuple[str, ...]


def identify(record: IndentationRecord, settings: IdentificationSettings | None = None) -> Identification:
    """Identify a specimen from one indentation, with all protocols that the record allows.

    Args:
        record: approach, loading, hold if any, unloading; may begin in contact or end there.
        settings: how; the usual if None.

    Raises:
        DataError: the record cannot be used; see `record.check`. NoContact: it shows no contact. IllConditioned: it
            does not allow the protocol that is asked for.
    """
    settings = settings or IdentificationSettings()
    check(record)
    prepared, on_ramps = settled(record, settings.around_reversal)
    fits = all_protocols(prepared, on_ramps)
    both_ways = "single" in fits
    protocols = {name: _protocol_fit(prepared, name, fit, both_ways=both_ways) for name, fit in fits.items()}
    protocols = _rivals_marked(protocols)
    best = _best(protocols)
    slip = _slip(prepared, protocols, best)
    notes = notes_on(record, prepared, both_ways=both_ways)
    if settings.protocol not in {None, best}:
        notes.append(f"{settings.protocol} was asked for; {best} would be preferred")
        best = _asked_for(settings.protocol, protocols)
    chosen = protocols[best]
    end_s = prepared.branches.released_s or float(prepared.time_s[-1])
    return Identification(
        protocols=protocols,
        best=best,
        contact=Contact(
            chosen.contact_um,
            chosen.contact_time_s,
            chosen.sigma_contact_um,
            chosen.sigma_contact_time_s,
            prepared.contact.seen,
        ),
        slip=slip,
        branches=prepared.branches,
        excluded_samples=prepared.excluded,
        misfit=chosen.misfit,
        contact_duration_s=end_s - chosen.contact_time_s,
        deformation_sigma_um=prepared.deformation_sigma_um,
        force_sigma_uN=prepared.force_sigma_uN,
        baseline_uN=prepared.baseline_uN,
        knots_s=fits[best].spacing_s,
        notes=tuple(notes),
    )


def _protocol_fit(prepared: Prepared, name: ProtocolName, fit: Fit, *, both_ways: bool) -> ProtocolFit:
    motion = motion_everywhere(prepared, fit)
    force, fitted = prepared.force_uN[prepared.used], force_of(fit.theta, motion)
    by_x, _ = slopes_of(fit.theta, motion)
    noise = np.hypot(by_x * prepared.deformation_sigma_um, prepared.force_sigma_uN)
    left = force - fitted
    loading = prepared.branch == LOADING
    judged = loading if name == "loading" else np.ones_like(loading)
    # `loading_only` predicts the unloading, too, but that says nothing of what it has from the loading.
    fitted_to = loading if name in ("loading", "loading_only") else judged
    slips = name == "slip_corrected"
    solution = fit.solution

    def test(mask: Mask) -> StructureTest:
        white = (solution.deformation_residual, solution.force_residual)
        return structure_test(white, prepared.used[fit.at], left[mask], noise[mask])

    misfit, structure = test(judged), test(fitted_to)
    ratio = _noise_ratio(left[fitted_to], noise[fitted_to])
    beyond = "its residual has structure" if fit.within_noise else f"{ratio:.3g} × noise"
    weak, imprecise = weak_parameters(
        prepared,
        fit.theta,
        fit.covariance,
        Motion(*(part[fitted_to] for part in motion)),
        slips=slips,
        structured_uN=structure.structured_uN if structure.found else 0.0,
        misfit=f"the model does not explain the record: {beyond}" if structure.found else "",
    )
    names = ["k1", "k2", "b", "m", *(["slip", "slip_rate"] if slips else [])]
    return ProtocolFit(
        name=name,
        m_kg=None,
        covariance=parameter_covariance(fit.covariance),
        error_percent=_percent(left[judged], force[judged]),
        error_percent_loading=_percent(left[loading], force[loading]),
        noise_residual_ratio=_noise_ratio(left[judged], noise[judged]),
        condition_number=_condition(motion, fit.at),
        identifiable={key: key not in weak for key in names},
        weak=weak,
        imprecise=imprecise,
        force_uN=_at_all_samples(prepared, fit, motion),
        residual_uN=float(np.hypot(prepared.force_sigma_uN, fit.discrepancy_uN)),
        within_noise=fit.within_noise,
        misfit=misfit,
        deepest_um=_deepest_um(prepared, motion),
        **_fastest(prepared, fit, motion, both_ways=both_ways),
        likelihood_cost=solution.cost + fit.parameters * float(np.log(2 * solution.samples)),
        **named_parameters(fit.theta, fit.covariance),
    )


def _deepest_um(prepared: Prepared, motion: Motion) -> float:
    """The reversals, which no fit uses, were pressed, too; single samples far off their neighbours were not."""
    counts = prepared.measured.copy()
    counts[outliers(prepared.deformation_um, prepared.deformation_sigma_um)] = False
    in_contact = slice(prepared.branches.loading.start, prepared.branches.lost.start)
    return float(np.max(_compression_um(prepared, motion)[in_contact][counts[in_contact]]))


def _fastest(prepared: Prepared, fit: Fit, motion: Motion, *, both_ways: bool) -> dict[str, float]:
    """Largest speed while loading and while unloading, of the contact point or, where that is faster, of x."""
    none = np.zeros(len(prepared.used))
    slipping_um_s = -motion_of(fit.theta, prepared.time_s[prepared.used], none, none, none).velocity_um_s
    speeds = np.stack([motion.velocity_um_s, motion.velocity_um_s + slipping_um_s])
    in_um_s = float(np.max(speeds[:, prepared.branch == LOADING]))
    out = -speeds[:, prepared.branch == UNLOADING]
    return {"fastest_um_s": in_um_s, "fastest_unloading_um_s": float(np.max(out)) if both_ways else in_um_s}


def _percent(left: Array, force: Array) -> float:
    return float(100.0 * np.sqrt(np.mean(left**2) / np.mean(force**2)))


def _noise_ratio(left: Array, noise: Array) -> float:
    return float(np.sqrt(np.mean(left**2) / np.mean(noise**2)))


def _condition(motion: Motion, at: Indices) -> float:
    """Of the regressor of eq. (22), columns scaled."""
    x, v = motion.compression_um[at], motion.velocity_um_s[at]
    return ridge_fit(np.column_stack([v, x, x**3]), np.zeros(len(x))).condition_number


def _compression_um(prepared: Prepared, motion: Motion) -> Array:
    """The compression x at every sample: zero and slip of the used ones next to it taken off where one was left out."""
    t, used = prepared.time_s, prepared.used
    taken_off = prepared.deformation_um[used] - motion.compression_um
    x: Array = prepared.deformation_um - np.interp(t, t[used], taken_off)
    return x


def _at_all_samples(prepared: Prepared, fit: Fit, motion: Motion) -> Array:
    """The model's force at every sample: speed and slip of the nearest used sample where a sample was left out."""
    used, x = prepared.used, _compression_um(prepared, motion)
    nearest = used.searchsorted(np.arange(len(x))).clip(max=len(used) - 1)
    for part in (prepared.branches.loading, prepared.branches.hold, prepared.branches.unloading):
        inside = np.flatnonzero((used >= part.start) & (used < part.stop))
        if len(inside):
            nearest[part.start : part.stop] = nearest[part.start : part.stop].clip(inside[0], inside[-1])
    force = force_of(fit.theta, Motion(x, motion.velocity_um_s[nearest], motion.acceleration_um_s2[nearest]))
    for part in (prepared.branches.approach, prepared.branches.lost):
        force[part.start : part.stop] = fit.theta[BASE]
    return force + prepared.baseline_uN


def _rivals_marked(protocols: Mapping[ProtocolName, ProtocolFit]) -> dict[ProtocolName, ProtocolFit]:
    """The protocols; what two that explain the record about as well do not agree on is not determined."""
    within = [fit for fit in protocols.values() if fit.within_noise and fit.name not in ("loading", "loading_only")]
    marked = dict(protocols)
    for one, other in itertools.permutations(within, 2):
        if abs(one.likelihood_cost - other.likelihood_cost) > _AS_LIKELY:
            continue
        weak = dict(marked[one.name].weak)
        for name, (mine, my_sigma) in one.springs_and_damper.items():
            its, its_sigma = other.springs_and_damper[name]
            if abs(mine - its) > _APART * math.hypot(my_sigma, its_sigma):
                why = f"{other.name} explains the record as well with {its:.3g}"
                weak[name] = f"{weak[name]}; {why}" if name in weak else why
        identifiable = {name: name not in weak for name in one.identifiable}
        marked[one.name] = dataclasses.replace(marked[one.name], weak=weak, identifiable=identifiable)
    return marked


def _best(protocols: Mapping[ProtocolName, ProtocolFit]) -> ProtocolName:
    if "single" not in protocols:
        return "loading"
    names: list[ProtocolName] = ["single", "unloading_springs", "loading_only"]
    if _slip_counts(protocols["slip_corrected"], [protocols[name] for name in names]):
        names.append("slip_corrected")
    # `loading_only` explains both branches no better than the protocols that look at both.
    within: list[ProtocolName] = [n for n in names if protocols[n].within_noise and n != "loading_only"]
    if within:
        return min(within, key=lambda name: protocols[name].likelihood_cost)
    least = min(protocols[name].error_percent for name in names)
    return next(name for name in names if protocols[name].error_percent <= _SIMPLER * least)


def _slip_counts(slipped: ProtocolFit, without: Sequence[ProtocolFit]) -> bool:
    """Whether a slip may explain a record: it is one, and determined or beyond doubt."""
    weak = {"slip", "slip_rate"} & set(slipped.weak)
    if not weak <= slipped.imprecise:
        return False
    clearly = slipped.error_percent <= _CLEARLY * min(fit.error_percent for fit in without)
    return not weak or clearly or (slipped.within_noise and not any(fit.within_noise for fit in without))


def _asked_for(name: ProtocolName | None, protocols: Mapping[ProtocolName, ProtocolFit]) -> ProtocolName:
    if name is None or name not in protocols:
        raise IllConditioned(
            f"the record does not allow the protocol {name}", remedy=f"ask for one of {', '.join(protocols)}"
        )
    return name


def _slip(prepared: Prepared, protocols: Mapping[ProtocolName, ProtocolFit], best: ProtocolName) -> Slip | None:
    fit = protocols.get("slip_corrected")
    if fit is None:
        return None
    last = prepared.branches.unloading.stop
    lost = prepared.branches.release_s is not None
    left = float(np.mean(prepared.deformation_um[max(last - 2, 0) : last])) - fit.contact_um
    why = _weakness_of_slip(fit)
    if fit.misfit.found:
        why.append("slip_corrected leaves more than noise")
    as_well = protocols[best].within_noise or protocols[best].error_percent <= _SIMPLER * fit.error_percent
    if best != "slip_corrected" and as_well:
        why.append(f"{best} explains the record without a slip, as well or better")
    return Slip(
        fit.slip_um,
        fit.sigma_slip_um,
        fit.slip_rate_per_s,
        fit.sigma_slip_rate_per_s,
        left if lost else None,
        not why,
        "; ".join(why),
    )


def _weakness_of_slip(fit: ProtocolFit) -> list[str]:
    """Why offset and α are not determined; what is true of both is said once, anything else with its name."""
    said: dict[str, list[str]] = {}
    for name, which in (("slip", "offset in µm"), ("slip_rate", "α in 1/s")):
        for reason in filter(None, fit.weak.get(name, "").split("; ")):
            said.setdefault(reason, []).append(which)
    return [reason if len(which) > 1 else f"{which[0]}: {reason}" for reason, which in said.items()]
