"""Locate one square in one image: detection, edge fit, and the reasons for which there is none."""

from __future__ import annotations

from typing import Any, Literal

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from microdrivers.core.errors import OutOfRange
from microdrivers.estimators.vision.edge_fit import EdgeFit, fit_edges
from microdrivers.estimators.vision.points import GreyImage, require_grey
from microdrivers.estimators.vision.quadrilateral import (
    BORDER_MARGIN_PX,
    ORDER,
    FloatArray,
    find_quadrilaterals,
    glance,
    is_inside,
    is_square_like,
    mean_side,
)

MissReason = Literal[
    "no_square", "partly_in_view", "poor_fit", "implausible_blur", "low_contrast", "saturated"
]  # fmt: skip

MIN_SIDE_PX = 20.0
"""Default for the smallest square that is looked for."""

_MAX_SATURATED = 0.1
_MAX_REJECTED = 0.25
_MIN_CONTRAST_SIGMAS = 5.0
_BLUR_RANGE = (0.25, 0.08)
"""Smallest blur in px, largest blur in sides."""
_MODEL_ERROR = 0.03
"""Residuals up to this share of the contrast are put down to an imperfect square, not to a wrong object."""
_NOISE_RATIO = 2.0
_MAX_FITS = 3


class SquareFit(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """A square located in one image.

    Attributes:
        corners_px: 4×2, (u, v) from the centre of the top-left pixel, clockwise as displayed. Row 0 is the corner
            nearest to the top-left pixel, or in a tracker's `last_fit` the tracked one.
        sigma_px: 4, standard deviation per axis of each corner as the fit predicts it.
        side_px: mean length of the four sides.
        blur_px: standard deviation of the Gaussian blur of the edges.
        contrast: grey level inside minus outside; negative for a dark square.
        residual_sigma: standard deviation of the residuals, grey levels.
        rejected: share of the edge pixels left out as dust, 0 … 1.
        rivals: number of other squares in view of at least half the area.
    """

    corners_px: FloatArray
    sigma_px: FloatArray
    side_px: float
    blur_px: float
    contrast: float
    residual_sigma: float
    rejected: float
    rivals: int

    @property
    def centre_px(self) -> tuple[float, float]:
        """Mean of the corners, (u, v) from the centre of the top-left pixel."""
        u, v = self.corners_px.sum(axis=0).tolist()
        return u / 4.0, v / 4.0

    def starting_at(self, row: int) -> SquareFit:
        """The same square with the corner of `row` first; the cyclic order stays."""
        return msgspec.structs.replace(
            self,
            corners_px=_read_only(self.corners_px[ORDER[row]]),
            sigma_px=_read_only(self.sigma_px[ORDER[row]]),
        )


class SquareNotFound(msgspec.Struct, frozen=True):
    """Why an image gives no square: `reason` for programs, `detail` for people."""

    reason: MissReason
    detail: str


def locate_square(
    image: npt.NDArray[Any],
    *,
    bit_depth: int | None = None,
    near_px: tuple[float, float] | None = None,
    min_side_px: float = MIN_SIDE_PX,
) -> SquareFit | SquareNotFound:
    """Locate the square in `image`, dark on bright or bright on dark, to a hundredth of a pixel.

    Of several squares the largest is taken; where others have at least half its area and `near_px` is given, the
    one nearest to that point. A square that comes within 4 px of the border counts as partly in view.

    Args:
        image: grey image, rows × columns, uint8 or uint16.
        bit_depth: significant bits per pixel; all bits of the type by default.
        near_px: (u, v) from the centre of the top-left pixel.
        min_side_px: smaller squares are ignored; 10 or more.

    Returns:
        The fitted square, or the reason why there is none. An image without a square is not an error.

    Raises:
        DataError: `image` is not a two-dimensional uint8 or uint16 array.
        OutOfRange: `min_side_px` is below 10.
    """
    grey = require_grey(image)
    if not min_side_px >= 10:
        raise OutOfRange(
            f"min_side_px = {min_side_px:g} px is below 10 px",
            remedy="edges shorter than that cannot be fitted; zoom in or choose a larger target",
        )
    full_scale = float(2 ** (bit_depth or 8 * grey.dtype.itemsize) - 1)
    seen = glance(grey, min_side_px=min_side_px)
    if seen is not None:
        outcome = _first_fit(grey, [seen], 0, full_scale, min_side_px)
        if isinstance(outcome, SquareFit):
            return outcome
    detection = find_quadrilaterals(grey, min_side_px=min_side_px)
    if not detection.quads:
        return _nothing_detected(grey, full_scale, partly_in_view=detection.partly_in_view)
    quads, rivals = _in_order_of_choice(detection.quads, near_px)
    return _first_fit(grey, quads[:_MAX_FITS], rivals, full_scale, min_side_px)


def _first_fit(
    image: GreyImage, quads: list[FloatArray], rivals: int, full_scale: float, min_side_px: float
) -> SquareFit | SquareNotFound:
    """The first of `quads` that is a square, or what is wrong with the first of all."""
    misses = []
    for quad in quads:
        fit = fit_edges(image, quad, full_scale=full_scale)
        miss = _fault(image, quad, fit, min_side_px)
        if fit is not None and miss is None:
            return _as_square(fit, rivals)
        misses.append(miss)
    return next(filter(None, misses), SquareNotFound("no_square", "no square in view"))


def _in_order_of_choice(quads: list[FloatArray], near_px: tuple[float, float] | None) -> tuple[list[FloatArray], int]:
    """Candidates in the order in which to try them, and the number of rivals of the largest."""
    areas = [mean_side(quad) ** 2 for quad in quads]
    rivals = [quad for quad, area in zip(quads, areas, strict=True) if area >= 0.5 * areas[0]]
    others = [quad for quad, area in zip(quads, areas, strict=True) if area < 0.5 * areas[0]]
    if near_px is not None:
        point = np.array(near_px)
        rivals.sort(key=lambda quad: float(np.hypot(*(quad.mean(axis=0) - point))))
    return rivals + others, len(rivals) - 1


def _nothing_detected(image: GreyImage, full_scale: float, *, partly_in_view: bool) -> SquareNotFound:
    if partly_in_view:
        return SquareNotFound("partly_in_view", "the square reaches the border of the image")
    at_end = np.count_nonzero(image >= full_scale) + np.count_nonzero(image == 0)
    if at_end > 0.5 * image.size:
        share = 100.0 * at_end / image.size
        return SquareNotFound("saturated", f"{share:.0f} % of the pixels are at an end of the grey scale")
    return SquareNotFound("no_square", "nothing in view has four straight sides of about equal length")


def _fault(image: GreyImage, quad: FloatArray, fit: EdgeFit | None, min_side_px: float) -> SquareNotFound | None:
    """What disqualifies a fit, or None."""
    if fit is None:
        return SquareNotFound("poor_fit", "the edge fit has no solution")
    side = mean_side(fit.corners)
    if fit.saturated > _MAX_SATURATED:
        share = f"{100 * fit.saturated:.0f} %"
        return SquareNotFound("saturated", f"{share} of the edge pixels are at an end of the grey scale")
    if abs(fit.contrast) < _MIN_CONTRAST_SIGMAS * fit.residual_sigma:
        levels = f"{abs(fit.contrast):.1f} grey levels against residuals of {fit.residual_sigma:.1f}"
        return SquareNotFound("low_contrast", f"the contrast is {levels}")
    if not fit.converged or np.abs(fit.corners - quad).max() > 3.0 + 0.05 * side:
        return SquareNotFound("poor_fit", "the edge fit does not settle near the detected square")
    if not is_square_like(fit.corners, min_side_px=0.9 * min_side_px):
        return SquareNotFound("poor_fit", "the fitted edges do not form a square")
    if not _BLUR_RANGE[0] <= fit.blur_px <= _BLUR_RANGE[1] * side:
        return SquareNotFound("implausible_blur", f"the edges are blurred by {fit.blur_px:.2f} px")
    if not is_inside(fit.corners, (image.shape[0], image.shape[1]), margin_px=BORDER_MARGIN_PX):
        return SquareNotFound("partly_in_view", "the square reaches the border of the image")
    if fit.rejected > _MAX_REJECTED:
        return SquareNotFound("poor_fit", f"{100 * fit.rejected:.0f} % of the edge pixels do not fit")
    if fit.residual_sigma > _MODEL_ERROR * abs(fit.contrast):
        noise = _noise_level(image, fit.corners)
        if fit.residual_sigma > _NOISE_RATIO * noise:
            levels = f"{fit.residual_sigma:.1f} grey levels against a noise of {noise:.1f}"
            return SquareNotFound("poor_fit", f"the residuals are {levels}")
    return None


def _noise_level(image: GreyImage, quad: FloatArray) -> float:
    """Standard deviation of white noise around the square, from second differences along both axes."""
    low = np.maximum(quad.min(axis=0).astype(int) - 8, 0)
    high = quad.max(axis=0).astype(int) + 9
    box = image[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
    return float(np.median(np.abs(cv2.filter2D(box, -1, kernel)))) * 1.4826 / 6.0


def _as_square(fit: EdgeFit, rivals: int) -> SquareFit:
    sigma = np.sqrt(0.5 * (fit.covariances[:, 0, 0] + fit.covariances[:, 1, 1]))
    square = SquareFit(
        corners_px=fit.corners,
        sigma_px=sigma,
        side_px=mean_side(fit.corners),
        blur_px=fit.blur_px,
        contrast=fit.contrast,
        residual_sigma=fit.residual_sigma,
        rejected=fit.rejected,
        rivals=rivals,
    )
    return square.starting_at(int(np.argmin(fit.corners.sum(axis=1))))


def _read_only(array: FloatArray) -> FloatArray:
    array.flags.writeable = False
    return array
