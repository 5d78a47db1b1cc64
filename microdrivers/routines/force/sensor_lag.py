"""What a slow sensor does to the parameters: its force is that of some time ago."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from microdrivers.estimators.force.protocol_fit import INTERVAL, ProtocolFit
from microdrivers.estimators.force.protocols import PROTOCOLS

Array = npt.NDArray[np.float64]

_SAMPLES = 200


def lag_s(bandwidth_hz: float) -> float:
    """How late a first-order sensor follows a force that changes steadily: 1/(2π·bandwidth)."""
    return 1.0 / (2.0 * math.pi * bandwidth_hz)


def lag_biases(fit: ProtocolFit, late_s: float, *, speed_um_s: float) -> dict[str, float]:
    """By how much k1, k2 and b come out too large, in their units, where the force is late by so much.

    A ramp to the deepest point and, if the protocol is fitted to it, back: what the lag takes off the force there,
    late·dF/dt, projected on the columns of the model. The jump of a damper's force at the contact is left out.

    Args:
        fit: of the record, to a depth above 0.
        late_s: the lag.
        speed_um_s: of the ramp, > 0.
    """
    protocol = PROTOCOLS[fit.name]
    x = np.linspace(0.0, fit.deepest_um, _SAMPLES)
    v = np.full(_SAMPLES, speed_um_s)
    damped = v
    if protocol.explains_both_ways:
        x, v = np.concatenate([x, x]), np.concatenate([v, -v])
        damped = v if fit.b_unloading_uN_s_per_um else np.where(v > 0.0, v, 0.0)
    taken_off = late_s * (fit.k1_uN_per_um + 3.0 * fit.k2_uN_per_um3 * x**2) * v
    # x³ over the square of the depth, or it would outweigh the others by decades.
    depth = fit.deepest_um
    columns = np.column_stack([x, x**3 / depth**2, damped])
    k1, k2, b = (-np.linalg.lstsq(columns, taken_off, rcond=None)[0]).tolist()
    return {"k1": k1, "k2": k2 / depth**2, "b": b}


def beyond_intervals(biases: Mapping[str, float], covariance: Array) -> dict[str, float]:
    """Those of the biases of k1, k2 and b that are larger than half a 95 % interval; `covariance` is of the three."""
    half_widths = INTERVAL * np.sqrt(np.diag(covariance).clip(min=0.0))
    return {
        name: bias
        for (name, bias), half_width in zip(biases.items(), half_widths.tolist(), strict=True)
        if abs(bias) > half_width  # False for NaN
    }
