"""Track natural texture against one fixed template."""

from __future__ import annotations

import numpy as np

from microdrivers.core.samples import Frame, TrackedPoint
from microdrivers.core.units import Range, check_range
from microdrivers.estimators.vision.points import PointReporter, require_grey
from microdrivers.estimators.vision.template import (
    MARGIN_PX,
    MIN_HALF_PX,
    Float32Array,
    FloatArray,
    Match,
    Template,
    take_template,
)

_MAX_DEFORMATION = 0.005
"""Largest change of length or angle across the window: 0.5 % or 0.3°."""


class TextureTracker:
    """Tracks a point by the natural texture around it, to about a hundredth of a pixel.

    The first frame supplies the template, which is never updated: matching each frame to the one before would
    let the errors add up to a random walk. Each frame is searched as a whole by correlation, then the shift, a
    gain and a bias are fitted by least squares. The texture must not repeat itself in view.

    A template fits only at the scale, angle and focus at which it was taken. When these change the target is
    reported lost with the flag `appearance_changed`, never with a wrong number; `reset()` takes a new template.
    The other flags of a lost frame are `no_texture` (the first frame shows too little), `partly_in_view` (the
    window crosses the border of the image) and `out_of_view` (it went on leaving).

    Args:
        point_px: (u, v) of the point to track in the first frame, from the principal point, v down.
        window: size of the template as a share of the image along each axis, 0.05 … 0.9. A larger one is more
            precise, a smaller one leaves more room: the point may move by (1 − window)/2 of the image.
        min_correlation: below this correlation coefficient the target is lost.
        device: name under which the points are published.

    Attributes:
        last_reason: why the newest frame gave no point, in words; empty when it did.
        last_match: how the newest frame fits; None when lost.

    Raises:
        OutOfRange: a parameter is outside its range.
    """

    def __init__(
        self,
        *,
        point_px: tuple[float, float] = (0.0, 0.0),
        window: float = 0.4,
        min_correlation: float = 0.7,
        device: str = "texture_tracker",
    ) -> None:
        check_range(window, Range(0.05, 0.9), what="window", unit="of the image")
        check_range(min_correlation, Range(0.0, 1.0), what="min_correlation", unit="(1 is a perfect match)")
        self._point_px = point_px
        self._window = window
        self._min_correlation = min_correlation
        self._reporter = PointReporter(device)
        self.last_reason = ""
        self.last_match: Match | None = None
        self._template: Template | None = None
        self._start_px = np.zeros(2)
        self._leaving = False

    def reset(self) -> None:
        """Forget the template; the next frame supplies a new one around `point_px`."""
        self.last_reason = ""
        self.last_match = None
        self._template = None
        self._leaving = False

    def update(self, frame: Frame) -> TrackedPoint:
        """Locate the point in `frame`; the first frame with enough texture becomes the template.

        Returns:
            The point, px from the frame's principal point; `found` is False and the coordinates NaN when lost.

        Raises:
            DataError: the image is not a two-dimensional uint8 or uint16 array.
        """
        image = require_grey(frame.image).astype(np.float32)
        self.last_match = None
        template = self._template
        if template is None:
            start_px = np.array(frame.principal_point_px) + self._point_px
            template = _take_template(image, start_px, self._window)
            if template is None:
                detail = "the view around the point shows too little texture, or the point is at its border"
                return self._lose(frame, "no_texture", detail)
            self._template, self._start_px = template, start_px
        shift, peak = template.search(image)
        if not template.fits_in(image.shape, shift):
            if peak >= self._min_correlation:
                self._leaving = True
                return self._lose(frame, "partly_in_view", "the window crosses the border of the image")
            return self._lose_sight(frame, peak)
        match = template.refine(image, shift)
        if match is None or match.correlation < self._min_correlation:
            return self._lose_sight(frame, peak if match is None else match.correlation)
        if match.deformation > max(_MAX_DEFORMATION, 5.0 * match.deformation_sigma):
            change = f"lengths or angles changed by {100 * match.deformation:.2g} % since the template was taken"
            return self._lose(frame, "appearance_changed", change)
        self._leaving = False
        self.last_reason = ""
        self.last_match = match
        u, v = (self._start_px + match.shift).tolist()
        return self._reporter.found(frame, position_px=(u, v), sigma_px=match.sigma_px)

    def _lose_sight(self, frame: Frame, correlation: float) -> TrackedPoint:
        best = f"the best correlation with the template is {correlation:.2f}"
        detail = f"{best}: the texture left the view, or zoom, focus or angle changed; reset() takes a new template"
        return self._lose(frame, "out_of_view" if self._leaving else "appearance_changed", detail)

    def _lose(self, frame: Frame, flag: str, detail: str) -> TrackedPoint:
        self.last_reason = f"{flag}: {detail}"
        return self._reporter.lost(frame, flag)


def _take_template(image: Float32Array, start_px: FloatArray, share: float) -> Template | None:
    """Template of `share` of the image around the pixel nearest to `start_px`, smaller at the border; or None."""
    size = np.array([image.shape[1], image.shape[0]])
    centre = np.rint(start_px).astype(int)
    room = np.minimum(centre, size - 1 - centre) - MARGIN_PX
    half = np.minimum((0.5 * share * size).astype(int), room)
    if half.min() < MIN_HALF_PX:
        return None
    (u, v), (a, b) = centre.tolist(), half.tolist()
    return take_template(image, centre=(u, v), half=(a, b))
