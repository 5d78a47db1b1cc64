"""The motion that belongs to a fit, and what the noise of the deformation allows it to be."""

from __future__ import annotations

import numpy as np

from microdrivers.estimators.force.joint import Motion, motion_of, slopes_of
from microdrivers.estimators.force.model import Array
from microdrivers.estimators.force.prepared import Indices, Prepared
from microdrivers.estimators.force.protocols import Fit
from microdrivers.estimators.force.trajectory import Trajectory, trajectory

_WITHIN_NOISE = 0.35
"""Excess of a residual's variance over the noise's that is none."""

_CHANCE_SIGMAS = 5.0
"""By how many of its own standard deviations noise's mean square may come out too large, where that is more."""

_UNSEEN_SPACING_S = 0.5
"""Of the knots of a motion that hides in the noise of the deformation."""


def family_of(prepared: Prepared, at: Indices, spacing_s: float) -> Trajectory:
    """Family of trajectories for places among the used samples."""
    used = prepared.used[at]
    return trajectory(
        prepared.time_s[used],
        prepared.force_uN[used],
        prepared.branch[at],
        spacing_s=spacing_s,
        depth_um=prepared.depth_um,
        force_sigma_uN=prepared.force_sigma_uN,
    )


def noise_limit(samples: int) -> float:
    """Mean square of residuals in standard deviations that noise alone does not exceed."""
    return 1.0 + max(_WITHIN_NOISE, _CHANCE_SIGMAS * float(np.sqrt(2.0 / samples)))


def deformation_alone_fits(prepared: Prepared, spacing_s: float) -> bool:
    """The deformation follows a trajectory of this family within its noise."""
    family = family_of(prepared, np.arange(len(prepared.used)), spacing_s)
    x = prepared.deformation_um[prepared.used]
    left = x - family.value @ np.linalg.lstsq(family.value, x, rcond=None)[0]
    return float(np.mean(left**2)) < noise_limit(len(x)) * prepared.deformation_sigma_um**2


def unseen_force_uN(prepared: Prepared, fit: Fit) -> float:
    """Force, RMS, of motion on splines that hides in the noise of the deformation."""
    family = family_of(prepared, fit.at, _UNSEEN_SPACING_S)
    spread = np.linalg.pinv(family.value.T @ family.value, hermitian=True) * prepared.deformation_sigma_um**2
    by_x, by_v = slopes_of(fit.theta, fit.solution.motion)
    of_place = np.einsum("ij,ij->i", family.value @ spread, family.value)
    of_speed = np.einsum("ij,ij->i", family.rate @ spread, family.rate)
    return float(np.sqrt(np.mean(by_x**2 * of_place + by_v**2 * of_speed)))


def motion_everywhere(prepared: Prepared, fit: Fit) -> Motion:
    """Compression from the measured deformation, speed from the trajectory, at all used samples.

    Branches that the protocol does not fit take their trajectory from the deformation alone.
    """
    t, x = prepared.time_s[prepared.used], prepared.deformation_um[prepared.used]
    family = family_of(prepared, np.arange(len(t)), fit.spacing_s)
    eta = np.linalg.lstsq(family.value, x, rcond=None)[0]
    whole = motion_of(fit.theta, t, x, family.rate @ eta, family.acceleration @ eta)
    speed, acceleration = whole.velocity_um_s.copy(), whole.acceleration_um_s2.copy()
    speed[fit.at] = fit.solution.motion.velocity_um_s
    acceleration[fit.at] = fit.solution.motion.acceleration_um_s2
    return Motion(whole.compression_um, speed, acceleration)


def motion_of_branch(prepared: Prepared, fit: Fit, samples: Indices, number: int) -> tuple[Motion, Array]:
    """Motion at any samples of a branch, its usual speed assumed; and the noise of the force that follows from it."""
    of_branch = prepared.branch[fit.at] == number
    speed = float(np.median(fit.solution.motion.velocity_um_s[of_branch]))
    t = prepared.time_s[samples]
    slipping = motion_of(fit.theta, t, np.zeros_like(t), np.zeros_like(t), np.zeros_like(t)).velocity_um_s
    usual = float(np.median(slipping[np.isin(samples, prepared.used[fit.at][of_branch])]))
    motion = motion_of(fit.theta, t, prepared.deformation_um[samples], np.full_like(t, speed - usual), np.zeros_like(t))
    by_x, _ = slopes_of(fit.theta, motion)
    return motion, np.hypot(by_x * prepared.deformation_sigma_um, prepared.force_sigma_uN)
