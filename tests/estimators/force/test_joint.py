import numpy as np
import pytest

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
    Prior,
    Problem,
    by_parameters,
    force_columns,
    force_of,
    free_covariance,
    motion_of,
    solve,
    ties_of,
)
from microdrivers.estimators.force.trajectory import RAMP, trajectory

THETA = np.array([4.5, 1e-4, 27.0, 5.0, 0.3, 1.0, 20.0, 0.15, 0.2])
GROUPS = (K1, K2, B_LOADING, B_UNLOADING, CONTACT, CONTACT_S, SLIP, RATE, BASE)


def problem_of(spacing_s: float, *, noise: float = 0.0, groups=GROUPS, seed: int = 0) -> Problem:
    """Ramps of an ideal stage, without the estimator's own detection of anything."""
    rng = np.random.default_rng(seed)
    t = np.concatenate([np.arange(1.2, 15.0, 1.0 / 30.0), np.arange(15.2, 24.0, 1.0 / 30.0)])
    branch = (t > 15.0).astype(np.int64)
    way = np.where(branch == 0, 0.3 + 5.0 * (t - 1.0), 70.3 - 5.0 * (t - 15.0))
    speed = np.where(branch == 0, 5.0, -5.0)
    force = force_of(THETA, motion_of(THETA, t, way, speed, np.zeros_like(t)))
    row = np.eye(PARAMETERS)
    return Problem(
        time_s=t,
        deformation_um=way + 0.06 * noise * rng.standard_normal(len(t)),
        force_uN=force + 0.05 * noise * rng.standard_normal(len(t)),
        deformation_sigma_um=0.06,
        force_sigma_uN=0.05,
        trajectory=trajectory(t, force, branch, spacing_s=spacing_s, depth_um=70.0, force_sigma_uN=0.05),
        ties=ties_of(*groups),
        fixed=np.zeros(PARAMETERS),
        priors=[
            Prior(row[CONTACT], 0.3 + 0.006 * noise * rng.standard_normal(), 0.006),
            Prior(row[BASE], 0.2 + 0.005 * noise * rng.standard_normal(), 0.005),
        ],
        kink_um=0.01,
    )


@pytest.mark.parametrize("index", range(PARAMETERS))
def test_derivatives_by_the_parameters_are_those_of_the_force(index):
    t = np.linspace(1.1, 20.0, 50)
    way, speed = 5.0 * (t - 1.0), np.where(t < 12.0, 5.0, -4.0)

    def force(theta):
        return force_of(theta, motion_of(theta, t, way, speed, np.zeros_like(t)))

    step = 1e-6 * max(abs(THETA[index]), 1.0) * np.eye(PARAMETERS)[index]
    numeric = (force(THETA + step) - force(THETA - step)) / (2.0 * step[index])
    analytic = by_parameters(THETA, t, motion_of(THETA, t, way, speed, np.zeros_like(t)))[:, index]
    assert np.allclose(analytic, numeric, rtol=1e-5, atol=1e-5 * np.abs(numeric).max() + 1e-9)


@pytest.mark.parametrize(("spacing_s", "share"), [(RAMP, 1.0), (0.6, 0.1)])
def test_without_noise_the_truth_is_found_from_far_off(spacing_s, share):
    problem = problem_of(spacing_s)
    found = solve(problem, THETA * (1.0 + share * np.array([0.3, -0.4, -0.3, 1.0, 0.0, 0.0, -0.2, 0.5, 0.0])))
    sigma = np.sqrt(np.diag(free_covariance(problem, found))[:PARAMETERS])
    assert np.all(np.abs(found.theta - THETA) < 0.5 * sigma)
    assert found.cost < 1.0


def test_the_gradient_vanishes_at_the_solution():
    problem = problem_of(RAMP, noise=1.0)
    found = solve(problem, THETA)
    columns = force_columns(problem, found)
    p = problem.ties.shape[1]
    eta = columns[:, p:].T @ found.force_residual
    eta += problem.trajectory.value.T @ found.deformation_residual / problem.deformation_sigma_um
    # The first line's coefficients also have the kink; the second branch's only have the samples.
    assert np.allclose(eta[2:4], 0.0, atol=1e-2 * np.linalg.norm(columns[:, p + 2 : p + 4]))


def test_the_covariance_is_that_of_repeated_noise():
    groups = (K1, K2, (B_LOADING, B_UNLOADING), CONTACT, BASE)
    base = problem_of(RAMP, groups=groups)
    theta = THETA.copy()
    theta[B_UNLOADING], theta[SLIP], theta[RATE] = theta[B_LOADING], 0.0, 0.0
    base = base._replace(fixed=np.where(np.arange(PARAMETERS) == CONTACT_S, 1.0, 0.0))
    speed = np.where(base.time_s < 15.0, 5.0, -5.0)
    clean = force_of(theta, motion_of(theta, base.time_s, base.deformation_um, speed, 0.0 * speed))
    rng, found, sigmas = np.random.default_rng(1), [], []
    for _ in range(60):
        noisy = base._replace(
            deformation_um=base.deformation_um + 0.06 * rng.standard_normal(len(clean)),
            force_uN=clean + 0.05 * rng.standard_normal(len(clean)),
            priors=[p._replace(value=p.value + p.sigma * rng.standard_normal()) for p in base.priors],
        )
        solution = solve(noisy, theta)
        found.append(base.ties.T @ solution.theta / base.ties.sum(axis=0))
        sigmas.append(np.sqrt(np.diag(free_covariance(noisy, solution))[: len(groups)]))
    ratio = np.std(found, axis=0) / np.mean(sigmas, axis=0)
    assert np.all((ratio > 0.75) & (ratio < 1.3)), ratio


def test_what_nothing_determines_comes_out_infinitely_wide():
    problem = problem_of(RAMP, groups=(K1, K2, B_LOADING, B_UNLOADING, SLIP, RATE))
    still = THETA.copy()
    still[[SLIP, RATE]] = 0.0, 0.0
    covariance = free_covariance(problem, solve(problem, still, iterations=0))
    assert np.isinf(covariance[5, 5])


def test_correlated_residuals_widen_the_sandwich():
    problem = problem_of(RAMP, noise=1.0)
    slow = 1.0 * np.sin(problem.time_s / 2.0)
    off = problem._replace(force_uN=problem.force_uN + slow, force_sigma_uN=0.7)
    found = solve(off, THETA)
    plain, robust = free_covariance(off, found), free_covariance(off, found, lags=25)
    assert robust[0, 0] > 2.0 * plain[0, 0]
