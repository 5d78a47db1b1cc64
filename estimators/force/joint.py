"""Specimen and trajectory estimated together: maximum likelihood with noise in deformation and force.

With s(t) the true deformation, a member of a family of trajectories, and F after Bilen et al., eqs. (21) and (26),
`Σ (x_i − s(t_i))²/σx² + Σ (F_i − F(s, ṡ; θ))²/σF²` is least. Noise in x thus neither biases the springs (as it does in
a plain regression on x) nor is it differentiated to get at the damper.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from microdrivers.estimators.force.model import Array
from microdrivers.estimators.force.trajectory import Trajectory

PARAMETERS = 9
"""How many there are in θ."""

K1, K2, B_LOADING, B_UNLOADING, CONTACT, CONTACT_S, SLIP, RATE, BASE = range(PARAMETERS)
"""Their places: µN/µm, µN/µm³, µN·s/µm twice, µm, s, µm, 1/s, µN (baseline of the force)."""

_ITERATIONS = 30
"""Steps of Levenberg and Marquardt at most."""

_CONVERGED = 1e-4
"""Decrease of the cost, in squares of standard deviations, that is none."""

_LEAST_DAMPING, _FIRST_DAMPING, _MOST_DAMPING = 1e-13, 1e-6, 1e8
"""Of the steps, relative to the diagonal of the normal equations; with the most, no step is left."""

_RATE_LIMITS = (1e-3, 5.0)
"""Of α in eq. (26), 1/s: below them a slip looks like a linear creep, above them like a step at the contact."""


class Prior(NamedTuple):
    """Something known of the parameters, independent of the samples: `row @ θ` is `value` ± `sigma`."""

    row: Array
    value: float
    sigma: float


class Problem(NamedTuple):
    """Samples, noise, and what is to be estimated from them.

    Attributes:
        time_s, deformation_um, force_uN: samples in contact.
        deformation_sigma_um, force_sigma_uN: noise; the force's includes what the model cannot explain.
        trajectory: family for these samples.
        ties: PARAMETERS × free parameters; `θ = fixed + ties @ free`.
        fixed: values of what is not free, 0 elsewhere.
        priors: on θ.
        kink_um: how well the line that the trajectory starts on passes through (contact time, contact); None: not used.
    """

    time_s: Array
    deformation_um: Array
    force_uN: Array
    deformation_sigma_um: float
    force_sigma_uN: float
    trajectory: Trajectory
    ties: Array
    fixed: Array
    priors: Sequence[Prior]
    kink_um: float | None


class Motion(NamedTuple):
    """Compression and its derivatives as the parameters and the trajectory have them."""

    compression_um: Array
    velocity_um_s: Array
    acceleration_um_s2: Array


class Solution(NamedTuple):
    """A point in the space of parameters and trajectories, and how well it explains the samples.

    Attributes:
        theta: all parameters. eta: coefficients of the trajectory.
        deformation_residual, force_residual: in standard deviations, one a sample.
        prior_residual: in standard deviations, one a prior.
        motion: of the samples. fitted_uN: the model's force.
        cost: sum of all squared residuals.
    """

    theta: Array
    eta: Array
    deformation_residual: Array
    force_residual: Array
    prior_residual: Array
    motion: Motion
    fitted_uN: Array
    cost: float

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(self.fitted_uN)


def ties_of(*groups: int | Sequence[int]) -> Array:
    """Ties for free parameters; a group of several shares one value."""
    ties = np.zeros((PARAMETERS, len(groups)))
    for column, group in enumerate(groups):
        ties[[group] if isinstance(group, int) else list(group), column] = 1.0
    return ties


def motion_of(theta: Array, time_s: Array, value: Array, rate: Array, acceleration: Array) -> Motion:
    """Compression, slip of eq. (26) taken off, from the deformation and its derivatives."""
    decay = np.exp(-theta[RATE] * (time_s - theta[CONTACT_S]))
    slip, speed = theta[SLIP] * (1.0 - decay), theta[SLIP] * theta[RATE] * decay
    return Motion(value - theta[CONTACT] - slip, rate - speed, acceleration + theta[RATE] * speed)


def force_of(theta: Array, motion: Motion) -> Array:
    """Eq. (21) without mass and without regard to contact, plus the baseline."""
    x, v, _ = motion
    damper = theta[B_LOADING] * np.maximum(v, 0.0) + theta[B_UNLOADING] * np.minimum(v, 0.0)
    force: Array = theta[BASE] + damper + (theta[K1] + theta[K2] * x * x) * x
    return force


def slopes_of(theta: Array, motion: Motion) -> tuple[Array, Array]:
    """Derivatives of the force by compression and by velocity."""
    x, v, _ = motion
    return theta[K1] + 3.0 * theta[K2] * x * x, np.where(v > 0.0, theta[B_LOADING], theta[B_UNLOADING])


def solve(problem: Problem, theta: Array, *, iterations: int = _ITERATIONS) -> Solution:
    """Levenberg–Marquardt from `theta`, the trajectory starting at its fit to the deformation alone."""
    ties = problem.ties
    free = ties.T @ theta / ties.sum(axis=0)
    p = len(free)
    at = _evaluated(problem, problem.fixed + ties @ free, _initial_eta(problem))
    damping = _FIRST_DAMPING
    for _ in range(iterations):
        normal, gradient = _normal_equations(problem, at)
        scale = np.sqrt(np.diag(normal))
        scale[scale == 0.0] = 1.0
        normal, gradient = normal / np.outer(scale, scale), gradient / scale
        before = at.cost
        while damping < _MOST_DAMPING:
            step = np.linalg.solve(normal + damping * np.eye(len(scale)), gradient) / scale
            new_theta = problem.fixed + ties @ (free + step[:p])
            if _sensible(new_theta):
                trial = _evaluated(problem, new_theta, at.eta + step[p:])
                if trial.cost <= at.cost:
                    free, at = free + step[:p], trial
                    damping = max(damping * 0.1, _LEAST_DAMPING)
                    break
            damping *= 10.0
        if before - at.cost <= _CONVERGED:
            break
        damping = min(damping, 1.0)
    return at


def _sensible(theta: Array) -> bool:
    return bool(np.isfinite(theta).all() and (theta[SLIP] == 0.0 or _RATE_LIMITS[0] < theta[RATE] < _RATE_LIMITS[1]))


def _initial_eta(problem: Problem) -> Array:
    family = problem.trajectory
    weight = problem.deformation_sigma_um / family.prior
    rows = np.vstack([family.value, np.diag(weight)])
    eta: Array = np.linalg.lstsq(rows, np.concatenate([problem.deformation_um, np.zeros(len(weight))]), rcond=None)[0]
    return eta


def _evaluated(problem: Problem, theta: Array, eta: Array) -> Solution:
    family = problem.trajectory
    value = family.value @ eta
    motion = motion_of(theta, problem.time_s, value, family.rate @ eta, family.acceleration @ eta)
    fitted = force_of(theta, motion)
    of_deformation = (problem.deformation_um - value) / problem.deformation_sigma_um
    of_force = (problem.force_uN - fitted) / problem.force_sigma_uN
    _, of_priors = _prior_rows(problem, theta, eta)
    cost = float(of_deformation @ of_deformation + of_force @ of_force + of_priors @ of_priors)
    return Solution(theta, eta, of_deformation, of_force, of_priors, motion, fitted, cost)


def force_columns(problem: Problem, at: Solution) -> Array:
    """Derivatives of the scaled forces by (free parameters, η), samples × both."""
    by_theta, by_x, by_v = _force_slopes(problem, at)
    return np.hstack([by_theta, _by_eta(problem, by_x, by_v, slice(None), slice(None))])


def _force_slopes(problem: Problem, at: Solution) -> tuple[Array, Array, Array]:
    """Derivatives of the scaled forces by the free parameters, by place and by speed."""
    by_x, by_v = slopes_of(at.theta, at.motion)
    by_theta = by_parameters(at.theta, problem.time_s, at.motion) @ problem.ties
    return by_theta / problem.force_sigma_uN, by_x / problem.force_sigma_uN, by_v / problem.force_sigma_uN


def _by_eta(problem: Problem, by_x: Array, by_v: Array, rows: slice, columns: slice) -> Array:
    family = problem.trajectory
    by_eta: Array = by_x[rows, None] * family.value[rows, columns] + by_v[rows, None] * family.rate[rows, columns]
    return by_eta


def _normal_equations(problem: Problem, at: Solution) -> tuple[Array, Array]:
    """Fisher information of (free parameters, η), and the gradient that it answers to."""
    p, sigma = problem.ties.shape[1], problem.deformation_sigma_um
    by_theta, by_x, by_v = _force_slopes(problem, at)
    priors, _ = _prior_rows(problem, at.theta, at.eta)
    normal = priors.T @ priors
    gradient = priors.T @ at.prior_residual
    normal[:p, :p] += by_theta.T @ by_theta
    gradient[:p] += by_theta.T @ at.force_residual
    for rows, columns in problem.trajectory.blocks:
        by_eta = _by_eta(problem, by_x, by_v, rows, columns)
        value = problem.trajectory.value[rows, columns] / sigma
        here = slice(p + columns.start, p + columns.stop)
        normal[here, here] += by_eta.T @ by_eta + value.T @ value
        across = by_theta[rows].T @ by_eta
        normal[:p, here] += across
        normal[here, :p] += across.T
        gradient[here] += by_eta.T @ at.force_residual[rows] + value.T @ at.deformation_residual[rows]
    return normal, gradient


def by_parameters(theta: Array, time_s: Array, motion: Motion) -> Array:
    """Derivatives of the force by θ, samples × PARAMETERS."""
    x, v, _ = motion
    by_x, by_v = slopes_of(theta, motion)
    offset, alpha = theta[SLIP], theta[RATE]
    since = time_s - theta[CONTACT_S]
    decay = np.exp(-alpha * since)
    columns = np.zeros((len(x), PARAMETERS))
    columns[:, K1], columns[:, K2] = x, x**3
    columns[:, B_LOADING], columns[:, B_UNLOADING] = np.maximum(v, 0.0), np.minimum(v, 0.0)
    columns[:, CONTACT] = -by_x
    columns[:, CONTACT_S] = by_x * offset * alpha * decay - by_v * offset * alpha**2 * decay
    columns[:, SLIP] = -by_x * (1.0 - decay) - by_v * alpha * decay
    columns[:, RATE] = -by_x * offset * since * decay - by_v * offset * decay * (1.0 - alpha * since)
    columns[:, BASE] = 1.0
    return columns


def _prior_rows(problem: Problem, theta: Array, eta: Array) -> tuple[Array, Array]:
    """What is known beside the samples: derivatives by (free parameters, η), and residuals, both scaled."""
    family, p = problem.trajectory, problem.ties.shape[1]
    rows, residuals = [], []
    for known, value, sigma in problem.priors:
        rows.append(np.concatenate([known @ problem.ties / sigma, np.zeros(len(eta))]))
        residuals.append((value - float(known @ theta)) / sigma)
    for index in np.flatnonzero(np.isfinite(family.prior)):
        row = np.zeros(p + len(eta))
        row[p + index] = 1.0 / family.prior[index]
        rows.append(row)
        residuals.append(-eta[index] / family.prior[index])
    if problem.kink_um is not None and family.start is not None:
        # Extrapolated to the contact, where no force has bent it yet, the first line is at the undeformed surface.
        at, speed = family.start
        line = at + (theta[CONTACT_S] - family.start_s) * speed
        by_theta = problem.ties[CONTACT] - float(speed @ eta) * problem.ties[CONTACT_S]
        rows.append(np.concatenate([by_theta, -line]) / problem.kink_um)
        residuals.append((float(line @ eta) - theta[CONTACT]) / problem.kink_um)
    return np.array(rows).reshape(len(rows), p + len(eta)), np.array(residuals)


def free_covariance(problem: Problem, at: Solution, *, lags: int | None = None) -> Array:
    """Covariance of (free parameters, η), the inverse of the Fisher information.

    Args:
        problem: what was solved.
        at: its solution.
        lags: if given, the sandwich for residuals that are correlated over this many samples (Newey and West, 1987).

    Returns:
        Infinite variances where nothing determines a parameter.
    """
    normal, _ = _normal_equations(problem, at)
    scale = np.sqrt(np.diag(normal))
    blind = scale == 0.0
    scale[blind] = 1.0
    inverse = np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-14, hermitian=True)
    if lags is not None:
        half = _correlated_scores(problem, at, scale, lags) @ inverse
        inverse = half.T @ half
    covariance: Array = inverse / np.outer(scale, scale)
    covariance[blind, blind] = np.inf
    return covariance


def _correlated_scores(problem: Problem, at: Solution, scale: Array, lags: int) -> Array:
    """Rows whose products add up to Bartlett's sum over lags of the products of scores, and those of the priors.

    Bartlett's weights 1 − lag/(lags + 1) are the overlap of windows of lags + 1 samples: sums over windows do it.
    """
    p = problem.ties.shape[1]
    scores = force_columns(problem, at) * at.force_residual[:, None]
    weight = at.deformation_residual / problem.deformation_sigma_um
    scores[:, p:] += problem.trajectory.value * weight[:, None]
    window = lags + 1
    padded = np.zeros((len(scores) + 2 * window - 1, scores.shape[1]))
    padded[window : window + len(scores)] = scores
    total = np.cumsum(padded, axis=0)
    sums = (total[window:] - total[:-window]) / np.sqrt(window)
    rows: Array = np.vstack([sums, _prior_rows(problem, at.theta, at.eta)[0]]) / scale
    return rows
