"""What was measured, taken as arrays of real numbers, or refused."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from microdrivers.core.errors import DataError
from microdrivers.estimators.force.model import Array


def real_array(values: npt.ArrayLike, *, what: str) -> Array:
    """Values as an array of floats; NaN where a masked array masks them.

    Args:
        values: an array or nested sequences of real numbers.
        what: its name, for the error.

    Raises:
        DataError: they are one number, complex, text or other objects, or their rows differ in length.
    """
    try:
        # Other subclasses of arrays, as a matrix, multiply in other ways.
        given = np.ma.asarray(values) if np.ma.isMaskedArray(values) else np.asarray(values)
    except ValueError as error:
        raise DataError(f"{what} is not an array: {error}", remedy="give rows of the same length") from error
    if given.ndim == 0:
        raise DataError(f"{what} is {given!s:.60}, not an array", remedy="give an array or a list of real numbers")
    if given.dtype.kind not in "fiu":
        raise DataError(f"{what} holds {given.dtype.name}, not real numbers", remedy="give an array of real numbers")
    array: Array = np.ma.filled(given.astype(np.float64, copy=False), np.nan)
    return array
