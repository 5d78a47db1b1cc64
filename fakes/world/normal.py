"""The cumulative normal distribution, which is what a blurred edge looks like."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_TABLE_STEPS_PER_UNIT = 512
_TABLE_REACH = 6.0
_TABLE = np.array(
    [
        0.5 * (1.0 + math.erf((i / _TABLE_STEPS_PER_UNIT - _TABLE_REACH) / math.sqrt(2.0)))
        for i in range(int(2 * _TABLE_REACH * _TABLE_STEPS_PER_UNIT) + 2)
    ]
)


def normal_cdf(x: Array) -> Array:
    """Cumulative normal distribution, linear between the entries of a table (error below 5e-7)."""
    value: Array = np.where(x > 0.0, _TABLE[-2], _TABLE[0])
    # Beyond the table, which is nearly everywhere in an image of an edge, it is constant.
    near = np.abs(x) < _TABLE_REACH
    place = (x[near] + _TABLE_REACH) * _TABLE_STEPS_PER_UNIT
    index = place.astype(np.intp)
    low = _TABLE[index]
    value[near] = low + (place - index) * (_TABLE[index + 1] - low)
    return value
