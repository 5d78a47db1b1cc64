"""Which samples and which family of trajectories the protocols are fitted with."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from microdrivers.estimators.force.fit_motion import deformation_alone_fits, motion_of_branch, unseen_force_uN
from microdrivers.estimators.force.fitting import fit_protocol, fit_unloading_springs
from microdrivers.estimators.force.joint import B_LOADING, B_UNLOADING, force_of
from microdrivers.estimators.force.model import Array
from microdrivers.estimators.force.prepared import LOADING, UNLOADING, Margins, Prepared, prepare
from microdrivers.estimators.force.protocols import PROTOCOLS, Fit, Protocol, ProtocolName
from microdrivers.estimators.force.record import IndentationRecord
from microdrivers.estimators.force.trajectory import KNOT_SPACINGS_S, RAMP

_FEWEST_OF_UNLOADING = 3
"""Samples of the way back: with fewer its two springs are no fit."""

_FIRST_MARGIN_S = 0.5
_ROUNDS = 3
_SETTLED = 10.0
"""Time constants after which a new speed has come about: 5e-5 of it are missing."""

_STILL_SETTLING = 5.0
"""Time constants between where the noise begins to hide that a speed settles, and where it has settled."""

_BEYOND_NOISE = 4.0
_UNSEEN = 3.0
"""Times what motion that the camera does not see can do to the force: more than that is not the trajectory's fault."""

Fits = dict[ProtocolName, Fit]


def settled(record: IndentationRecord, around_reversal: int) -> tuple[Prepared, Fits]:
    """The samples at which the motion has settled, and the fits on ramps to them.

    A first look leaves out half a second, if need be more, at the ends of each branch. If noise explains the rest, it
    tells how long the motion takes to settle. Otherwise what is off is the model's, and nothing is left out for it.

    Args:
        record: a checked one.
        around_reversal: samples left out in any case on either side of contact, reversals and release.
    """
    margins = Margins.same(_FIRST_MARGIN_S)
    for _ in range(_ROUNDS):
        wide = prepare(record, around_reversal=around_reversal, margins=margins)
        at_first = _over_both(wide)
        best = min(at_first.values(), key=lambda fit: fit.discrepancy_uN)
        if best.within_noise:
            break
        margins = _margins(wide, best, by_force=True)
    prepared = prepare(
        record, around_reversal=around_reversal, margins=_margins(wide, best, by_force=best.within_noise)
    )
    fits = _over_both(prepared)
    return (wide, at_first) if best.within_noise and not _any_fits(fits) else (prepared, fits)


def all_protocols(prepared: Prepared, on_ramps: Mapping[ProtocolName, Fit]) -> Fits:
    """All protocols, each on the stiffest family of trajectories on which it leaves nothing but noise.

    One that does not on any is fitted on the stiffest family that the deformation alone follows.

    Args:
        prepared: the samples.
        on_ramps: of protocols for all branches, on ramps.
    """
    fits = dict(on_ramps)
    spacing_s, found = RAMP, None
    if not _any_fits(fits):
        name = min(fits, key=lambda name: fits[name].discrepancy_uN)
        followed = (spacing_s for spacing_s in KNOT_SPACINGS_S if deformation_alone_fits(prepared, spacing_s))
        spacing_s = next(followed, KNOT_SPACINGS_S[-1])
        found = _on_splines(prepared, PROTOCOLS[name], fits[name], straight=spacing_s == RAMP)
        if found is not None or spacing_s != RAMP:
            fits = {key: _refitted(prepared, PROTOCOLS[key], fit, found, spacing_s) for key, fit in fits.items()}
    if "single" in fits:
        fits["unloading_springs"] = fit_unloading_springs(prepared, fits["unloading_springs"], spacing_s)
        loading = fit_protocol(prepared, PROTOCOLS["loading"], spacing_s)
        if found is not None and not loading.within_noise:
            loading = _refitted(prepared, PROTOCOLS["loading"], loading, found, spacing_s)
        fits["loading_only"] = fits["loading"] = loading
    return fits


def _any_fits(fits: Mapping[ProtocolName, Fit]) -> bool:
    return any(fit.within_noise for fit in fits.values())


def _over_both(prepared: Prepared) -> Fits:
    """The protocols that mean to explain everything that was recorded, on ramps."""
    whole: tuple[ProtocolName, ...] = ("single", "unloading_springs", "slip_corrected")
    enough = np.count_nonzero(prepared.branch == UNLOADING) >= _FEWEST_OF_UNLOADING
    names: tuple[ProtocolName, ...] = whole if enough else ("loading",)
    return {name: fit_protocol(prepared, PROTOCOLS[name], RAMP) for name in names}


def _margins(prepared: Prepared, fit: Fit, *, by_force: bool) -> Margins:
    """How long the motion takes to settle at the ends of the branches.

    The sensor is a spring and the specimen a damper, so that a new speed comes about gradually, with the time constant
    b·c; and a stage takes its time to speed up and slow down, which the force shows (`by_force`) where its noise does
    not hide it.
    """
    yields = max(fit.compliance_um_per_uN, 0.0) + 2.0 * fit.sigma_compliance_um_per_uN
    loading_s, unloading_s = (yields * max(float(fit.theta[place]), 0.0) for place in (B_LOADING, B_UNLOADING))
    begin, end = [], []
    for number in range(UNLOADING + 1):
        constant_s = loading_s if number == LOADING else max(loading_s, unloading_s)
        first_s, last_s = _off_at_the_ends_s(prepared, fit, number) if by_force else (0.0, 0.0)
        begin.append(max(_SETTLED * constant_s, first_s + _STILL_SETTLING * constant_s if first_s else 0.0))
        end.append(last_s)
    return Margins(tuple(begin), tuple(end))


def _off_at_the_ends_s(prepared: Prepared, fit: Fit, number: int) -> tuple[float, float]:
    """How long the force is off the fit, extrapolated, at the beginning and at the end of a branch."""
    part = (prepared.branches.loading, prepared.branches.hold, prepared.branches.unloading)[number]
    fitted = fit.at[prepared.branch[fit.at] == number]
    if len(part) < 1 or not len(fitted):
        return 0.0, 0.0
    motion, noise = motion_of_branch(prepared, fit, np.arange(part.start, part.stop), number)
    off = np.abs(prepared.force_uN[part.start : part.stop] - force_of(fit.theta, motion))
    fine = np.flatnonzero(_middle_of_three(off / np.hypot(noise, fit.discrepancy_uN)) < _BEYOND_NOISE)
    if not len(fine):
        return 0.0, 0.0
    return float(fine[0]) * prepared.frame_s, float(len(off) - 1 - fine[-1]) * prepared.frame_s


def _middle_of_three(values: Array) -> Array:
    padded = np.concatenate([values[:1], values, values[-1:]])
    middle: Array = np.median(np.lib.stride_tricks.sliding_window_view(padded, 3), axis=1)
    return middle


def _on_splines(prepared: Prepared, protocol: Protocol, on_ramps: Fit, *, straight: bool) -> Fit | None:
    """On the stiffest splines on which a protocol leaves only noise; None if on none.

    Not even tried if the deformation follows ramps and the force is off by more than motion unseen could make it.
    """
    if straight and on_ramps.discrepancy_uN > _UNSEEN * unseen_force_uN(prepared, on_ramps):
        return None
    tried = (
        fit_protocol(prepared, protocol, spacing_s, only_noise_from=on_ramps.theta) for spacing_s in KNOT_SPACINGS_S[1:]
    )
    return next((fit for fit in tried if fit.within_noise), None)


def _refitted(prepared: Prepared, protocol: Protocol, on_ramps: Fit, found: Fit | None, spacing_s: float) -> Fit:
    """As `found` if that leaves only noise here too, else on the family that the deformation alone follows."""
    if found is not None:
        fit = fit_protocol(prepared, protocol, found.spacing_s, only_noise_from=on_ramps.theta)
        if fit.within_noise:
            return fit
    return fit_protocol(prepared, protocol, spacing_s)
