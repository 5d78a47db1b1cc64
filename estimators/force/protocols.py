"""The ways of fitting an indentation, Bilen et al., section III.C: which parameters, from which branches."""

from __future__ import annotations

from typing import Literal, NamedTuple

from microdrivers.estimators.force.joint import B_LOADING, B_UNLOADING, K1, K2, RATE, SLIP, Solution
from microdrivers.estimators.force.model import Array
from microdrivers.estimators.force.prepared import HOLD, LOADING, UNLOADING, Indices

ProtocolName = Literal["single", "unloading_springs", "loading_only", "slip_corrected", "loading"]


class Protocol(NamedTuple):
    """One way of fitting.

    Attributes:
        groups: parameters to estimate besides contact and baseline; a group shares one value.
        branches: numbers of the branches whose samples are fitted.
    """

    groups: tuple[int | tuple[int, ...], ...]
    branches: tuple[int, ...]


_ALL = (LOADING, HOLD, UNLOADING)
SINGLE = Protocol((K1, K2, (B_LOADING, B_UNLOADING)), _ALL)
UNDAMPED_RETURN = Protocol((K1, K2, B_LOADING), _ALL)
SPRINGS_OF_UNLOADING = Protocol((K1, K2), (UNLOADING,))
LOADING_ALONE = Protocol((K1, K2, B_LOADING), (LOADING,))
SLIP_CORRECTED = Protocol((K1, K2, B_LOADING, SLIP, RATE), _ALL)


class Fit(NamedTuple):
    """A protocol fitted.

    Attributes:
        theta: all parameters; covariance: of them, 0 where fixed.
        discrepancy_uN: RMS of what the model cannot explain, taken as white noise of the force in the fit.
        within_noise: noise alone explains the residuals.
        solution: of the samples at `at`, places among `Prepared.used`. parameters: how many were free.
        compliance_um_per_uN: of the sensor, as ramps tell it; 0 otherwise. sigma_compliance_um_per_uN: its deviation.
        spacing_s: of the trajectory's knots; 0 for ramps.
    """

    theta: Array
    covariance: Array
    discrepancy_uN: float
    within_noise: bool
    solution: Solution
    at: Indices
    compliance_um_per_uN: float
    sigma_compliance_um_per_uN: float
    parameters: int
    spacing_s: float
