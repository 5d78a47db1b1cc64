"""A protocol's fit judged by the record: what it leaves, what it does not determine, and where it holds."""

from __future__ import annotations

import numpy as np

from microdrivers.estimators.force.fit_motion import motion_everywhere
from microdrivers.estimators.force.joint import BASE, Motion, force_of, motion_of, slopes_of
from microdrivers.estimators.force.model import Array
from microdrivers.estimators.force.outliers import outliers
from microdrivers.estimators.force.prepared import LOADING, UNLOADING, Indices, Prepared
from microdrivers.estimators.force.protocol_fit import (
    ProtocolFit,
    named_parameters,
    parameter_covariance,
    weak_parameters,
)
from microdrivers.estimators.force.protocols import PROTOCOLS, Fit, ProtocolName
from microdrivers.estimators.force.record import Mask
from microdrivers.estimators.force.ridge import ridge_fit
from microdrivers.estimators.force.structure import StructureTest, structure_test


def judge(prepared: Prepared, name: ProtocolName, fit: Fit) -> ProtocolFit:
    """What a fit says of the specimen, and how well it explains the samples.

    Args:
        prepared: the samples.
        name: of the protocol.
        fit: of it.
    """
    motion = motion_everywhere(prepared, fit)
    force, fitted = prepared.force_uN[prepared.used], force_of(fit.theta, motion)
    by_x, _ = slopes_of(fit.theta, motion)
    noise = np.hypot(by_x * prepared.deformation_sigma_um, prepared.force_sigma_uN)
    left = force - fitted
    protocol, solution = PROTOCOLS[name], fit.solution
    judged, fitted_to = (np.isin(prepared.branch, part) for part in (protocol.judged_by, protocol.fitted_to))

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
        slips=protocol.slips,
        structured_uN=structure.structured_uN if structure.found else 0.0,
        misfit=f"the model does not explain the samples that it is fitted to: {beyond}" if structure.found else "",
    )
    names = ["k1", "k2", "b", "m", *(["slip", "slip_rate"] if protocol.slips else [])]
    return ProtocolFit(
        name=name,
        m_kg=None,
        covariance=parameter_covariance(fit.covariance),
        error_percent=_percent(left[judged], force[judged]),
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
        **_fastest(prepared, fit, motion, both_ways=protocol.explains_both_ways),
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
    """Largest speed while loading and while unloading, of the contact point or, where that is faster, of x.

    A fit of the loading alone tells no damper for the way back, at any speed.
    """
    none = np.zeros(len(prepared.used))
    slipping_um_s = -motion_of(fit.theta, prepared.time_s[prepared.used], none, none, none).velocity_um_s
    speeds = np.stack([motion.velocity_um_s, motion.velocity_um_s + slipping_um_s])
    in_um_s = float(np.max(speeds[:, prepared.branch == LOADING]))
    out = -speeds[:, prepared.branch == UNLOADING]
    return {"fastest_um_s": in_um_s, "fastest_unloading_um_s": float(np.max(out)) if both_ways else 0.0}


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
