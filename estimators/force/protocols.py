"""The ways of fitting an indentation, Bilen et al., section III.C: which parameters, from which branches."""

from __future__ import annotations

from typing import NamedTuple

from microdrivers.core.protocol_names import ProtocolName as ProtocolName
from microdrivers.estimators.force.joint import B_LOADING, B_UNLOADING, K1, K2, RATE, SLIP, Solution
from microdrivers.estimators.force.model import Array
from microdrivers.estimators.force.prepared import HOLD, LOADING, UNLOADING, Indices


class Protocol(NamedTuple):
    """One way of fitting.

    Attributes:
        groups: parameters to estimate besides contact and baseline; a group shares one value.
        fitted_to: numbers of the branches whose samples its parameters come from.
        judged_by: numbers of the branches whose samples its error and misfit are of.
    """

    groups: tuple[int | tuple[int, ...], ...]
    fitted_to: tuple[int, ...]
    judged_by: tuple[int, ...]

    @property
    def explains_both_ways(self) -> bool:
        """Whether it is fitted to both branches; `loading_only` merely predicts the unloading."""
        return {LOADING, UNLOADING} <= {*self.fitted_to}

    @property
    def slips(self) -> bool:
        """Whether it estimates the offset and α of eq. (26)."""
        return SLIP in self.groups


_ALL = (LOADING, HOLD, UNLOADING)
PROTOCOLS: dict[ProtocolName, Protocol] = {
    "single": Protocol((K1, K2, (B_LOADING, B_UNLOADING)), _ALL, _ALL),
    "unloading_springs": Protocol((K1, K2, B_LOADING), _ALL, _ALL),
    "slip_corrected": Protocol((K1, K2, B_LOADING, SLIP, RATE), _ALL, _ALL),
    "loading_only": Protocol((K1, K2, B_LOADING), (LOADING,), _ALL),
    "loading": Protocol((K1, K2, B_LOADING), (LOADING,), (LOADING,)),
}
"""Of `unloading_springs`, see `fit_unloading_springs` besides."""

SPRINGS_OF_UNLOADING = Protocol((K1, K2), (UNLOADING,), (UNLOADING,))
DAMPER_OF_LOADING = Protocol((B_LOADING,), (LOADING,), (LOADING,))

DAMPED_SLIP = Protocol((K1, K2, B_LOADING, B_UNLOADING, SLIP, RATE), _ALL, _ALL)
"""What `slip_corrected` leaves out: a damper on the way back. It is only asked whether it explains a record better."""


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
