"""What an optical calibration says, as rows of text: the page and the terminal summary show the same."""

from __future__ import annotations

from itertools import pairwise
from statistics import median, quantiles
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.estimators.optics import student_factor, wrap_deg
from microdrivers.report.number_format import compact, fixed, significant, with_uncertainty
from microdrivers.results.optics import OpticsResult, View, iterations_to_settle

PAPER_SETTLING = "8 iterations (0.26 s)"
"""Bilen et al., section III.B; not said whether from the start or the end of the zoom's motion."""

_FLUSHED_FRAMES = 3
_VIEW_NAMES: dict[View, str] = {
    "along_plus_z": "along +Z",
    "along_minus_z_or_mirrored": "along −Z, or mirrored",
}

Array = npt.NDArray[np.float64]


class Quantity(NamedTuple):
    """One figure of the result, ready to be shown; text is empty where there is nothing to say.

    Attributes:
        plus_minus: half-width of the 95 % interval.
        error: estimate minus truth, in percent of it for scale and magnification.
        inside: whether the interval holds the truth; None without either.
    """

    name: str
    symbol: str
    value: str
    plus_minus: str = ""
    unit: str = ""
    truth: str = ""
    error: str = ""
    inside: bool | None = None

    def in_unit(self, number: str) -> str:
        """A number with the unit as it is set: a space before it, none before a degree sign."""
        return f"{number}{self.unit if self.unit == '°' else ' ' + self.unit}" if self.unit else number

    def text(self) -> str:
        """Value, half-width and unit in one line."""
        if not self.plus_minus:
            return self.in_unit(self.value)
        value = self.in_unit(self.value) if self.unit == "°" else self.value
        return f"{value} ± {self.in_unit(self.plus_minus)}"


class Settling(NamedTuple):
    """Iterations until the error stays within 0.1 px, counted from the start and the end of the zoom's motion."""

    name: str
    from_start: str
    from_end: str


class SettledError(NamedTuple):
    """A priori prediction error once it has settled, px."""

    median_px: float
    largest_of_95_percent_px: float
    frames: int


def key_quantities(result: OpticsResult) -> list[Quantity]:
    """Scale, magnification, angle, translation, tilt and view, in the order of the report."""
    truth = result.truth
    rows = [
        _quantity(
            result, "Scale", "M of eq. (5)", "px/µm", result.scale_px_per_um, result.scale_sigma_px_per_um,
            None if truth is None else truth.scale_px_per_um, relative=True,
        )
    ]  # fmt: skip
    if result.magnification is not None:
        sigma = result.scale_sigma_px_per_um * result.magnification / result.scale_px_per_um
        rows.append(
            _quantity(
                result, "Magnification", "scale × pixel pitch", "", result.magnification, sigma,
                None if truth is None else truth.magnification, relative=True,
            )
        )  # fmt: skip
    rows.append(
        _quantity(
            result, "In-plane angle", "of +X, from +u towards +v", "°", result.angle_deg,
            result.angle_sigma_deg,
            None if truth is None else result.angle_deg - wrap_deg(result.angle_deg - truth.angle_deg),
        )
    )  # fmt: skip
    sigmas_um = _translation_sigmas_um(result)
    for axis, letter, subscript in ((0, "u", "ᵤ"), (1, "v", "ᵥ")):
        true_um = None if truth is None else truth.translation_um[axis]
        rows.append(
            _quantity(
                result,
                f"Translation along {letter}",
                f"T{subscript}, eq. (20)",
                "µm",
                result.translation_um[axis],
                sigmas_um[axis],
                true_um,
            )
        )
    return [*rows, _tilt(result), _view(result)]


def projection_quantities(result: OpticsResult) -> list[list[Quantity]]:
    """The entries of P, two rows of three."""
    sigmas = np.sqrt(np.diag(np.array(result.covariance)).clip(min=0.0)).reshape(2, 3)
    return [
        [
            _quantity(
                result, f"p{row + 1}{column + 1}", "", "px" if column == 2 else "px/µm",
                result.projection[row][column], float(sigmas[row, column]),
                None if result.truth is None else result.truth.projection[row][column],
            )
            for column in range(3)
        ]
        for row in range(2)
    ]  # fmt: skip


def settling(result: OpticsResult) -> list[Settling]:
    """How fast the error settled after the zoom change, a priori and a posteriori; empty without a change."""
    change = result.zoom_change
    if change is None:
        return []
    start, end = change.first_frame, change.last_moving_frame + 1
    return [
        Settling(
            "a priori",
            _iterations(result, start, change.iterations_to_0p1_px),
            _iterations(result, end, change.iterations_to_0p1_px_from_end),
        ),
        Settling(
            "a posteriori",
            _iterations(result, start, change.posterior_iterations_to_0p1_px),
            _iterations(result, end, change.posterior_iterations_to_0p1_px_from_end),
        ),
    ]


def frame_period_s(result: OpticsResult) -> float | None:
    """Median time between frames; None with fewer than two."""
    times_s = result.traces.time_s
    steps = [later - earlier for earlier, later in pairwise(times_s)]
    return median(steps) if steps else None


def settled_index(result: OpticsResult) -> int | None:
    """Position in the traces from which on the a priori error has settled; None if it never does."""
    change = result.zoom_change
    first = 0 if change is None else change.first_frame
    iterations = (
        iterations_to_settle(result.prediction_error_px, first_frame=0)
        if change is None
        else change.iterations_to_0p1_px
    )
    return None if iterations is None else first + iterations - 1


def settled_error(result: OpticsResult) -> SettledError | None:
    """The error of the frames that have settled, or of those at rest after the zoom change if none did."""
    start = settled_index(result)
    if start is None:
        change = result.zoom_change
        start = 0 if change is None else change.last_moving_frame + 1 + _FLUSHED_FRAMES
    errors = [error for error in result.prediction_error_px[start:] if error is not None]
    if len(errors) < 2:
        return None
    return SettledError(median(errors), quantiles(errors, n=20, method="inclusive")[-1], len(errors))


def zoom_name(zoom: float) -> str:
    """A reading of the zoom body, such as `zoom 1.2`."""
    return f"zoom {compact(zoom)}"


def _quantity(
    result: OpticsResult,
    name: str,
    symbol: str,
    unit: str,
    value: float,
    sigma: float,
    truth: float | None,
    *,
    relative: bool = False,
) -> Quantity:
    half_width = sigma * student_factor(result.degrees_of_freedom) if sigma > 0.0 else None
    text = with_uncertainty(value, half_width)
    if truth is None:
        return Quantity(name, symbol, text.value, text.plus_minus, unit)
    difference = value - truth
    row = Quantity(name, symbol, text.value, text.plus_minus, unit)
    return row._replace(
        truth=row.in_unit(fixed(truth, text.decimals)),
        error=(
            f"{significant(100.0 * difference / truth, 2, signed=True)} %"
            if relative and truth
            else row.in_unit(fixed(difference, text.decimals, signed=True))
        ),
        inside=abs(difference) <= half_width if half_width is not None and text.plus_minus else None,
    )


def _translation_sigmas_um(result: OpticsResult) -> tuple[float, float]:
    """Standard deviations of T = (p13, p23) / M, to first order in the covariance of P."""
    (a11, a12, p13), (a21, a22, p23) = result.projection
    scale = result.scale_px_per_um
    # M is the length of the similarity's part of P, which the handedness selects; see eq. (20).
    sign = 1.0 if result.view == "along_plus_z" else -1.0
    along, across = a11 + sign * a22, a21 - sign * a12
    of_scale = np.array([along, -sign * across, 0.0, across, sign * along, 0.0]) / (4.0 * scale)
    covariance = np.array(result.covariance)
    sigmas = []
    for offset_px, index in ((p13, 2), (p23, 5)):
        gradient: Array = -offset_px / scale**2 * of_scale
        gradient[index] += 1.0 / scale
        sigmas.append(float(np.sqrt(max(gradient @ covariance @ gradient, 0.0))))
    return sigmas[0], sigmas[1]


def _tilt(result: OpticsResult) -> Quantity:
    low, high = result.tilt.interval_deg
    if high >= 90.0:
        value = "not determined"
    elif low <= 0.0:
        value = f"≤ {significant(high, 2)}"
    else:
        value = f"{significant(low, 2)}° to {significant(high, 2)}"
    symbol = result.tilt.label + (", either sign" if result.tilt.sign_ambiguous else "")
    unit = "" if high >= 90.0 else "°"
    if result.truth is None:
        return Quantity("Tilt", symbol, value, unit=unit)
    tilt_deg = result.truth.tilt_deg
    return Quantity(
        "Tilt", symbol, value, unit=unit, truth=f"{significant(tilt_deg, 2)}°",
        inside=low <= tilt_deg <= high if unit else None,
    )  # fmt: skip


def _view(result: OpticsResult) -> Quantity:
    truth = result.truth
    return Quantity(
        "View", "from the sign of det A", _VIEW_NAMES[result.view],
        truth=_VIEW_NAMES[truth.view] if truth else "", inside=truth.view == result.view if truth else None,
    )  # fmt: skip


def _iterations(result: OpticsResult, first: int, count: int | None) -> str:
    """So many, and how long they took; a frame that was lost meanwhile takes its time all the same."""
    if count is None:
        return "not reached"
    text = f"{count} iteration" if count == 1 else f"{count} iterations"
    times_s, period_s = result.traces.time_s, frame_period_s(result)
    if period_s is None:
        return text
    return f"{text} ({fixed(times_s[first + count - 1] - times_s[first] + period_s, 2)} s)"
