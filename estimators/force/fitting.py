"""Fits of the protocols by maximum likelihood, with as much noise of the force as the model leaves unexplained."""

from __future__ import annotations

import numpy as np

from microdrivers.estimators.force.fit_motion import family_of, noise_limit
from microdrivers.estimators.force.joint import (
    B_LOADING,
    B_UNLOADING,
    BASE,
    CONTACT,
    CONTACT_S,
    K1,
    K2,
    PARAMETERS,
    RATE,
    SLIP,
    Problem,
    Solution,
    by_parameters,
    force_columns,
    free_covariance,
    motion_of,
    slopes_of,
    solve,
    ties_of,
)
from microdrivers.estimators.force.model import Array
from microdrivers.estimators.force.prepared import LOADING, Indices, Prepared
from microdrivers.estimators.force.protocols import (
    DAMPED_SLIP,
    DAMPER_OF_LOADING,
    SPRINGS_OF_UNLOADING,
    Fit,
    Protocol,
)
from microdrivers.estimators.force.ridge import ridge_fit
from microdrivers.estimators.force.trajectory import Trajectory

_KINK_UM = 0.01
"""How well a straight way of the tip is met right at the contact: the stage's servo follows no better."""

_WITHIN_NOISE = 0.2
"""Excess of a ridge regression's residual over the noise's that needs no extra noise to begin with."""

_ROUNDS = 8
_FEW = 15
_SETTLES = 0.8
_SLIP_RATES_PER_S = (0.03, 0.06, 0.1, 0.2, 0.4)
_SLIP_SHARES = (0.05, 0.15, 0.3)
"""Offsets to begin with where the record ends in contact, relative to the depth."""


def fit_protocol(
    prepared: Prepared, protocol: Protocol, spacing_s: float, *, only_noise_from: Array | None = None
) -> Fit:
    """Fit one protocol by maximum likelihood; what the model cannot explain counts as noise of the force.

    The extra noise begins with what the ridge regression of eq. (25) leaves, and shrinks to what the joint fit leaves:
    a model that fits ends without any.

    Args:
        prepared: the samples.
        protocol: what to fit, to what.
        spacing_s: of the knots of the trajectory, see `trajectory`.
        only_noise_from: if given, only see, from these parameters on, whether noise explains everything.
    """
    at = np.flatnonzero(np.isin(prepared.branch, protocol.fitted_to))
    problem = _problem(prepared, protocol, at, family_of(prepared, at, spacing_s))
    if only_noise_from is not None:
        solution, extra = solve(problem, only_noise_from, iterations=_FEW), 0.0
        within = _within_noise(solution)
    else:
        problem, solution, extra = _with_discrepancy(problem, prepared, protocol)
        within = extra == 0.0
    covariance = _covariance(solution, problem, within) + _by_drift(prepared, solution, problem)
    return _fit(problem, solution, covariance, extra, within, at, spacing_s)


def _with_discrepancy(problem: Problem, prepared: Prepared, protocol: Protocol) -> tuple[Problem, Solution, float]:
    """Solve, with as much extra noise of the force as the solution leaves."""
    theta, extra = _start(prepared, protocol, problem)
    solution = solve(_with_extra(problem, prepared, extra), theta)
    for _ in range(_ROUNDS):
        if extra == 0.0:
            break
        left = _left_over(problem, prepared, solution)
        if left > _SETTLES * extra:
            extra = left
            break
        extra = left if left > prepared.force_sigma_uN else 0.0
        solution = solve(_with_extra(problem, prepared, extra), solution.theta)
    if extra == 0.0 and _within_noise(solution):
        return problem, solution, 0.0
    # Residuals that noise does not explain, yet none in the force: a trajectory that bends to please the force.
    extra = extra or max(_left_over(problem, prepared, solution), prepared.force_sigma_uN)
    problem = _with_extra(problem, prepared, extra)
    return problem, solve(problem, solution.theta), extra


def fit_unloading_springs(prepared: Prepared, pooled: Fit, spacing_s: float) -> Fit:
    """Springs from the unloading, damping from what is left of the loading, none on the way back.

    Args:
        prepared: the samples.
        pooled: springs from both branches. Where the two agree within the noise, this is the result.
        spacing_s: of the knots of the trajectory.
    """
    if pooled.within_noise:
        return pooled
    springs = fit_protocol(prepared, SPRINGS_OF_UNLOADING, spacing_s)
    at = np.flatnonzero(prepared.branch == LOADING)
    problem = _problem(prepared, DAMPER_OF_LOADING, at, family_of(prepared, at, spacing_s))
    problem = problem._replace(ties=ties_of(B_LOADING), fixed=springs.theta, priors=(), kink_um=None)
    extra = springs.discrepancy_uN
    for _ in range(3):
        problem = _with_extra(problem, prepared, extra)
        solution = solve(problem, springs.theta)
        extra = _left_over(problem, prepared, solution)
    covariance = _with_damping(springs, solution, problem)
    discrepancy = float(np.hypot(extra, springs.discrepancy_uN))
    return _fit(problem, solution, covariance, discrepancy, False, at, spacing_s)


def damping_on_the_way_back(prepared: Prepared, slipped: Fit, *, far_likelier: float) -> float:
    """The damper of the unloading with which noise explains a slip by so much better than without; 0 if with none.

    Args:
        prepared: the samples.
        slipped: `slip_corrected`, which has none.
        far_likelier: difference of −2·log-likelihood, beyond the price of the parameter.
    """
    if not slipped.within_noise:
        return 0.0
    damped = fit_protocol(prepared, DAMPED_SLIP, slipped.spacing_s, only_noise_from=slipped.theta)
    gain = slipped.solution.cost - damped.solution.cost - np.log(2 * damped.solution.samples)
    return float(damped.theta[B_UNLOADING]) if damped.within_noise and gain > far_likelier else 0.0


def _fit(
    problem: Problem,
    solution: Solution,
    covariance: Array,
    extra_uN: float,
    within_noise: bool,
    at: Indices,
    spacing_s: float,
) -> Fit:
    place, parameters = problem.trajectory.compliance, problem.ties.shape[1]
    compliance = sigma = 0.0
    if place is not None:
        compliance = float(solution.eta[place])
        sigma = float(np.sqrt(free_covariance(problem, solution)[parameters + place, parameters + place]))
    return Fit(
        theta=solution.theta,
        covariance=covariance,
        discrepancy_uN=extra_uN,
        within_noise=within_noise,
        solution=solution,
        at=at,
        compliance_um_per_uN=compliance,
        sigma_compliance_um_per_uN=sigma,
        parameters=parameters,
        spacing_s=spacing_s,
    )


def _left_over(problem: Problem, prepared: Prepared, solution: Solution) -> float:
    """RMS of the force that model and noise leave."""
    square = float(np.mean((problem.force_uN - solution.fitted_uN) ** 2))
    return float(np.sqrt(max(square - prepared.force_sigma_uN**2, 0.0)))


def _problem(prepared: Prepared, protocol: Protocol, at: Indices, family: Trajectory) -> Problem:
    used = prepared.used[at]
    groups = [*protocol.groups, CONTACT]
    seen = prepared.contact.seen != "nothing"
    if seen:
        groups.append(CONTACT_S)
    if prepared.baseline is not None:
        groups.append(BASE)
    fixed = np.zeros(PARAMETERS)
    if not seen:
        fixed[CONTACT_S] = prepared.contact.contact_s
    return Problem(
        time_s=prepared.time_s[used],
        deformation_um=prepared.deformation_um[used],
        force_uN=prepared.force_uN[used],
        deformation_sigma_um=prepared.deformation_sigma_um,
        force_sigma_uN=prepared.force_sigma_uN,
        trajectory=family,
        ties=ties_of(*groups),
        fixed=fixed,
        priors=prepared.priors(),
        kink_um=_KINK_UM if seen and LOADING in protocol.fitted_to else None,
    )


def _with_extra(problem: Problem, prepared: Prepared, extra_uN: float) -> Problem:
    return problem._replace(force_sigma_uN=float(np.hypot(prepared.force_sigma_uN, extra_uN)))


def _start(prepared: Prepared, protocol: Protocol, problem: Problem) -> tuple[Array, float]:
    """Ridge regression, eq. (25), at the contact as observed; the best of a grid of slips. Second: extra noise, µN."""
    eta = np.linalg.lstsq(problem.trajectory.value, problem.deformation_um, rcond=None)[0]
    rate = problem.trajectory.rate @ eta
    best: tuple[float, Array] | None = None
    for offset, alpha in _slips(prepared, protocol):
        theta = np.zeros(PARAMETERS)
        theta[[CONTACT, CONTACT_S]] = prepared.contact.contact_um, prepared.contact.contact_s
        theta[[SLIP, RATE]] = offset, alpha
        x, v, _ = motion_of(theta, problem.time_s, problem.deformation_um, rate, np.zeros_like(rate))
        columns = {K1: x, K2: x**3, B_LOADING: np.maximum(v, 0.0), (B_LOADING, B_UNLOADING): v}
        groups = [group for group in protocol.groups if group in columns]
        fit = ridge_fit(np.column_stack([columns[group] for group in groups]), problem.force_uN)
        for group, value in zip(groups, fit.theta, strict=True):
            theta[[group] if isinstance(group, int) else list(group)] = value
        left = float(np.mean(fit.residual_uN**2))
        if best is None or left < best[0]:
            best = left, theta
    assert best is not None
    theta = best[1]
    motion = motion_of(theta, problem.time_s, problem.deformation_um, rate, np.zeros_like(rate))
    by_x, _ = slopes_of(theta, motion)
    noise = np.mean(by_x**2) * prepared.deformation_sigma_um**2 + prepared.force_sigma_uN**2
    return theta, float(np.sqrt(best[0])) if best[0] > (1.0 + _WITHIN_NOISE) ** 2 * noise else 0.0


def _slips(prepared: Prepared, protocol: Protocol) -> list[tuple[float, float]]:
    if not protocol.slips:
        return [(0.0, 0.0)]
    release = prepared.branches.released_s
    if release is None:
        offsets = [share * prepared.depth_um for share in _SLIP_SHARES]
        return [(offset, alpha) for offset in offsets for alpha in _SLIP_RATES_PER_S]
    # What the specimen did not come back when contact was lost has slipped until then.
    last = prepared.branches.unloading.stop
    gone = float(np.mean(prepared.deformation_um[max(last - 2, 0) : last])) - prepared.contact.contact_um
    pressed_s = release - prepared.contact.contact_s
    return [(gone / -np.expm1(-alpha * pressed_s), alpha) for alpha in _SLIP_RATES_PER_S]


def _within_noise(solution: Solution) -> bool:
    squares = (np.mean(solution.deformation_residual**2), np.mean(solution.force_residual**2))
    return bool(max(squares) < noise_limit(solution.samples))


def _covariance(solution: Solution, problem: Problem, within_noise: bool) -> Array:
    p = problem.ties.shape[1]
    if within_noise:
        spread = solution.cost / max(2 * solution.samples - p - len(solution.eta), 1)
        free = free_covariance(problem, solution) * max(1.0, spread)
    else:
        free = free_covariance(problem, solution, lags=round(np.sqrt(solution.samples)))
    covariance: Array = problem.ties @ free[:p, :p] @ problem.ties.T
    return covariance


def _by_drift(prepared: Prepared, solution: Solution, problem: Problem) -> Array:
    """Covariance that follows from the slope of the baseline, which was taken off as if it were known for sure."""
    baseline = prepared.baseline
    if baseline is None or baseline.sigma_slope_uN_s == 0.0:
        return np.zeros((PARAMETERS, PARAMETERS))
    off = (problem.time_s - baseline.middle_s) * baseline.sigma_slope_uN_s / problem.force_sigma_uN
    answer = free_covariance(problem, solution) @ (force_columns(problem, solution).T @ off)
    moved = problem.ties @ answer[: problem.ties.shape[1]]
    return np.outer(moved, moved)


def _with_damping(springs: Fit, solution: Solution, problem: Problem) -> Array:
    """Covariance of the springs, and of the damping that follows from them and from the loading."""
    free = free_covariance(problem, solution, lags=round(np.sqrt(solution.samples)))
    # How the damping answers to what it was given: from the normal equations with those columns added.
    given = by_parameters(solution.theta, problem.time_s, solution.motion) / problem.force_sigma_uN
    given[:, B_LOADING] = 0.0
    answer = -(free_covariance(problem, solution)[0] @ (force_columns(problem, solution).T @ given))
    covariance = springs.covariance.copy()
    covariance[B_LOADING] = covariance[:, B_LOADING] = answer @ springs.covariance
    covariance[B_LOADING, B_LOADING] = free[0, 0] + answer @ springs.covariance @ answer
    return covariance
