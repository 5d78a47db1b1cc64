"""A specimen identified from one indentation, Bilen et al., sections II.B and III.C."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import NamedTuple

import numpy as np

from microdrivers.core.errors import IllConditioned, OutOfRange
from microdrivers.core.protocol_names import MOST_AROUND_REVERSAL
from microdrivers.estimators.force.branches import Branches
from microdrivers.estimators.force.fitting import damping_on_the_way_back
from microdrivers.estimators.force.judgement import judge
from microdrivers.estimators.force.model import Array
from microdrivers.estimators.force.notes import notes_on, on_a_misfit
from microdrivers.estimators.force.prepared import Indices, Prepared, SeenBefore
from microdrivers.estimators.force.protocol_fit import ProtocolFit
from microdrivers.estimators.force.protocols import PROTOCOLS, Fit, ProtocolName
from microdrivers.estimators.force.record import IndentationRecord, check
from microdrivers.estimators.force.selection import all_protocols, settled
from microdrivers.estimators.force.structure import StructureTest

_AS_LIKELY = 10.0
"""Difference of −2·log-likelihood between two explanations that a record cannot tell apart for sure."""

_APART = 3.0
"""Standard deviations of a difference that is none of noise."""

_SIMPLER = 1.1
"""Of the smallest error: what a protocol with fewer parameters may have and still be preferred."""

_NEARLY = 0.75
"""Of the tool's speed: what a slip that was faster has slowed down to at most until a force is noticed."""

_CLEARLY = 0.5
"""Of the smallest error without a slip: what one leaves that is not well determined and is preferred all the same."""


class IdentificationSettings(NamedTuple):
    """How to identify.

    Attributes:
        around_reversal: samples left out on either side of contact, reversals and release; 0 to 20.
        protocol: which one's model counts; None: the one that explains the record best, see `Identification.best`.
    """

    around_reversal: int = 2
    protocol: ProtocolName | None = None

    def check(self) -> None:
        """Refuse a number of samples that nobody can leave out.

        Raises:
            OutOfRange: `around_reversal` is not a whole number from 0 to `MOST_AROUND_REVERSAL`.
        """
        given: object = self.around_reversal  # callers from notebooks have no type checker
        if not isinstance(given, Integral) or not 0 <= self.around_reversal <= MOST_AROUND_REVERSAL:
            raise OutOfRange(
                f"{given} samples cannot be left out around a reversal",
                remedy=f"give a whole number from 0 to {MOST_AROUND_REVERSAL}",
            )


class Contact(NamedTuple):
    """Where and when the tool met the specimen, as the best protocol has it.

    Attributes:
        contact_um: where the undeformed surface lies in the deformation's own coordinate.
        contact_time_s: when it was touched.
        seen: what the deformation followed before: the surface, the tool's tip, or nothing.
    """

    contact_um: float
    contact_time_s: float
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
        protocols: by name; those that the record allows: without an unloading only `loading`. A number is not
            `identifiable` either where one of the likeliest protocols, or the best, says otherwise.
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
    notes: tuple[str, ...]


def identify(record: IndentationRecord, settings: IdentificationSettings | None = None) -> Identification:
    """Identify a specimen from one indentation, with all protocols that the record allows.

    Args:
        record: approach, loading, hold if any, unloading; may begin in contact or end there.
        settings: how; the usual if None.

    Raises:
        DataError: the record cannot be used; see `record.check`. Of these, NoContact: it shows no contact;
            SaturatedData: the sensor was at the end of its range in most of it, or of the loading; TargetLost: the
            contact point was lost in most of it.
        OutOfRange: `settings` are; see `IdentificationSettings.check`.
        IllConditioned: the record does not allow the protocol that is asked for.
    """
    settings = settings or IdentificationSettings()
    settings.check()
    record = check(record)
    prepared, on_ramps = settled(record, settings.around_reversal)
    fits = all_protocols(prepared, on_ramps)
    both_ways = "single" in fits
    protocols = {name: judge(prepared, name, fit) for name, fit in fits.items()}
    best = _best(protocols)
    protocols = _contradicted_by(protocols[best], _rivals_marked(protocols, best))
    if best == "slip_corrected":
        protocols[best] = protocols[best].with_weak(_hidden_by_slip(prepared, fits[best], protocols[best]))
    slip = _slip(prepared, protocols, best)
    if slip is not None:
        protocols["slip_corrected"] = _marked_without_slip(protocols["slip_corrected"], slip)
    notes = notes_on(record, prepared, both_ways=both_ways)
    if settings.protocol not in {None, best}:
        notes.append(f"{settings.protocol} was asked for; {best} would be preferred")
        best = _asked_for(settings.protocol, protocols)
    chosen = protocols[best]
    if chosen.misfit.found:
        notes += on_a_misfit(prepared)
    end_s = prepared.branches.released_s or float(prepared.time_s[-1])
    return Identification(
        protocols=protocols,
        best=best,
        contact=Contact(chosen.contact_um, chosen.contact_time_s, prepared.contact.seen),
        slip=slip,
        branches=prepared.branches,
        excluded_samples=prepared.excluded,
        misfit=chosen.misfit,
        contact_duration_s=end_s - chosen.contact_time_s,
        deformation_sigma_um=prepared.deformation_sigma_um,
        force_sigma_uN=prepared.force_sigma_uN,
        baseline_uN=prepared.baseline_uN,
        notes=tuple(notes),
    )


def _rivals_marked(
    protocols: Mapping[ProtocolName, ProtocolFit], best: ProtocolName
) -> dict[ProtocolName, ProtocolFit]:
    """The protocols; a number that is another for one that explains the record as well or better is not determined."""
    marked = dict(protocols)
    least = min((fit.likelihood_cost for fit in protocols.values() if _explains(fit)), default=math.inf)
    for one, other in itertools.permutations(protocols.values(), 2):
        if not _may_be_slip(other):
            continue
        likely = _explains(other) and other.likelihood_cost <= least + _AS_LIKELY
        if not (likely if _explains(one) else other.name == best and _explains(other)):
            continue
        better = one.likelihood_cost - other.likelihood_cost > _AS_LIKELY
        how = "both branches" if not _explains(one) else "the record better" if better else "the record as well"
        weak = {}
        for name, (mine, my_sigma) in one.springs_and_damper.items():
            its, its_sigma = other.springs_and_damper[name]
            if _is_ruled_out(one, other) or abs(mine - its) > _APART * math.hypot(my_sigma, its_sigma):
                weak[name] = f"{other.name} explains {how} with {its:.3g}"
        marked[one.name] = marked[one.name].with_weak(weak)
    return marked


def _contradicted_by(
    best: ProtocolFit, protocols: Mapping[ProtocolName, ProtocolFit]
) -> dict[ProtocolName, ProtocolFit]:
    """Where nothing explains both branches, neither is what the loading says by itself the specimen's own."""
    if not PROTOCOLS[best.name].explains_both_ways or not best.misfit.found:
        return dict(protocols)
    marked = dict(protocols)
    for one in protocols.values():
        if PROTOCOLS[one.name].explains_both_ways:
            continue
        both = best.springs_and_damper
        apart = [
            f"{name} of {both[name][0]:.3g}"
            for name, (mine, my_sigma) in one.springs_and_damper.items()
            if abs(mine - both[name][0]) > _APART * math.hypot(my_sigma, both[name][1])
        ]
        if apart:  # one of them takes the others along
            why = f"no protocol explains both branches, and {best.name} fits them with {', '.join(apart)}"
            marked[one.name] = one.with_weak(dict.fromkeys(both, why))
    return marked


def _may_be_slip(fit: ProtocolFit) -> bool:
    """Whether the slip that a protocol has found can be one, however imprecise; true of one without a slip."""
    return {"slip", "slip_rate"} & set(fit.weak) <= fit.imprecise


def _marked_without_slip(fit: ProtocolFit, slip: Slip) -> ProtocolFit:
    """`slip_corrected`; what rests on a slip that is none is not determined."""
    if _may_be_slip(fit):
        return fit
    return fit.with_weak(dict.fromkeys(fit.springs_and_damper, f"what it takes for slip is none: {slip.reason}"))


def _hidden_by_slip(prepared: Prepared, fit: Fit, slipped: ProtocolFit) -> dict[str, str]:
    """Why none of its parameters is determined where a slip is preferred, but may hide something else; empty if not."""
    b_unloading = damping_on_the_way_back(prepared, fit, far_likelier=_AS_LIKELY)
    at_first_um_s = slipped.slip_um * slipped.slip_rate_per_s
    if b_unloading:
        why = f"a damper of {b_unloading:.2g} µN·s/µm on the way back, too, explains the record better"
    elif at_first_um_s > _NEARLY * slipped.fastest_um_s:
        why = (
            f"at first it slips by {at_first_um_s:.2g} µm/s, hardly slower than the tool ({slipped.fastest_um_s:.2g} "
            "µm/s), and before it may have outrun the tool, without a force: press faster"
        )
    else:
        return {}
    return dict.fromkeys(("slip", "slip_rate", *slipped.springs_and_damper), why)


def _is_ruled_out(one: ProtocolFit, other: ProtocolFit) -> bool:
    """Whether noise explains what one leaves, but is far less likely to do so, the price of parameters aside."""
    more = len(PROTOCOLS[one.name].groups) - len(PROTOCOLS[other.name].groups)
    price = max(more, 0) * math.log(2 * len(one.force_uN))
    return _explains(one) and one.likelihood_cost - other.likelihood_cost > _AS_LIKELY + price


def _explains(fit: ProtocolFit) -> bool:
    """Both branches, within noise."""
    return fit.within_noise and PROTOCOLS[fit.name].explains_both_ways


def _best(protocols: Mapping[ProtocolName, ProtocolFit]) -> ProtocolName:
    if "single" not in protocols:
        return "loading"
    names: list[ProtocolName] = ["single", "unloading_springs", "loading_only"]
    if _slip_counts(protocols["slip_corrected"], [protocols[name] for name in names]):
        names.append("slip_corrected")
    within = [name for name in names if _explains(protocols[name])]
    if within:
        return min(within, key=lambda name: protocols[name].likelihood_cost)
    least = min(protocols[name].error_percent for name in names)
    return next(name for name in names if protocols[name].error_percent <= _SIMPLER * least)


def _slip_counts(slipped: ProtocolFit, without: Sequence[ProtocolFit]) -> bool:
    """Whether a slip may explain a record: it is one, and determined or beyond doubt."""
    if not _may_be_slip(slipped):
        return False
    weak = {"slip", "slip_rate"} & set(slipped.weak)
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
    as_well = as_well and not (_explains(fit) and _is_ruled_out(protocols[best], fit))
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
