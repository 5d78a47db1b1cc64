"""Track one corner of a square: located anew in every frame, its identity kept by continuity."""

from __future__ import annotations

import cmath
import math

import numpy as np
import numpy.typing as npt

from microdrivers.core.errors import OutOfRange
from microdrivers.core.samples import Frame, TrackedPoint
from microdrivers.core.units import Range, check_range
from microdrivers.estimators.vision.locate import MIN_SIDE_PX, SquareFit, SquareNotFound, locate_square
from microdrivers.estimators.vision.points import PointReporter
from microdrivers.estimators.vision.quadrilateral import ORDER, FloatArray

_SEVERAL = frozenset({"several_squares"})


def least_turn(previous: FloatArray, current: FloatArray) -> tuple[int, float]:
    """Match the corners of two squares by the smallest rotation, whatever the translation and scale.

    Args:
        previous: 4×2 corners, clockwise as displayed.
        current: 4×2 corners, clockwise as displayed.

    Returns:
        The row of `current` that corresponds to row 0 of `previous`, and the turn in degrees between the two,
        positive clockwise as displayed (u right, v down). The turn never exceeds 45° by much: a square does not
        tell more.
    """
    before, after = (_from_centre(corners) for corners in (previous, current))
    turns = [cmath.phase(product) for product in (after[ORDER] @ before.conj()).tolist()]
    row = min(range(4), key=lambda k: abs(turns[k]))
    return row, math.degrees(turns[row])


def _from_centre(corners: FloatArray) -> npt.NDArray[np.complex128]:
    """The corners as complex numbers u + i·v from their mean."""
    places = corners @ (1.0, 1.0j)
    return np.asarray(places - places.sum() / 4.0)


class SquareTracker:
    """Tracks one corner of a square through shifts, turns and zooms, dark on bright or bright on dark.

    The square is detected and fitted in every frame, so nothing drifts. Only the *name* of the corner is carried
    from frame to frame: of the four possible matches to the last square, the one with the least turn. Where that
    would be a guess — after more than `max_unseen_frames` frames without the square, or a turn of more than
    `max_turn_deg` — the target stays lost, with the flag `identity_ambiguous`, until `reset()`.

    A lost frame carries one flag: `no_square`, `partly_in_view`, `poor_fit`, `implausible_blur`, `low_contrast`,
    `saturated` or `identity_ambiguous`. A found one carries `several_squares` while others of at least half the
    area are in view: then the one nearest to the last position is taken, at the start the largest.

    Args:
        corner: the corner to track, 0 … 3 clockwise as displayed from the one nearest to the top-left pixel of
            the first frame in which the square is found. None chooses by `near_px`.
        near_px: (u, v) from the principal point, v down: the corner nearest to it in that frame is tracked. Used
            when `corner` is None.
        max_unseen_frames: longest gap over which the identity is kept, frames (missed ones included).
        max_turn_deg: largest turn from one located square to the next, below 45°.
        min_side_px: smaller squares are ignored.
        device: name under which the points are published.

    Attributes:
        last_reason: why the newest frame gave no point, in words; empty when it did.
        last_fit: the newest frame's square, the tracked corner in row 0; None when lost.

    Raises:
        OutOfRange: a parameter is outside its range.
    """

    def __init__(
        self,
        *,
        corner: int | None = None,
        near_px: tuple[float, float] = (0.0, 0.0),
        max_unseen_frames: int = 10,
        max_turn_deg: float = 35.0,
        min_side_px: float = MIN_SIDE_PX,
        device: str = "square_tracker",
    ) -> None:
        if corner is not None and corner not in range(4):
            raise OutOfRange(f"corner = {corner} is not one of 0, 1, 2, 3", remedy="count clockwise from top left")
        check_range(max_turn_deg, Range(0.0, 44.0), what="max_turn_deg", unit="degrees")
        self._corner = corner
        self._near_px = near_px
        self._max_unseen = max_unseen_frames
        self._max_turn_deg = max_turn_deg
        self._min_side_px = min_side_px
        self._reporter = PointReporter(device)
        self.last_reason = ""
        self.last_fit: SquareFit | None = None
        self._known: SquareFit | None = None
        self._newest_seq: int | None = None
        self._unseen = 0
        self._ambiguity = ""

    def reset(self) -> None:
        """Forget the square; the next frame that shows one chooses the corner anew."""
        self.last_reason = ""
        self.last_fit = None
        self._known = None
        self._newest_seq = None
        self._unseen = 0
        self._ambiguity = ""

    def update(self, frame: Frame) -> TrackedPoint:
        """Locate the corner in `frame`.

        Returns:
            The corner, px from the frame's principal point; `found` is False and the coordinates NaN when lost.

        Raises:
            DataError: the image is not a two-dimensional uint8 or uint16 array.
        """
        self._count_missed(frame)
        outcome = locate_square(
            frame.image,
            bit_depth=frame.bit_depth,
            near_px=self._known.centre_px if self._known else None,
            min_side_px=self._min_side_px,
        )
        if isinstance(outcome, SquareNotFound):
            self._unseen += 1
            return self._lose(frame, outcome.reason, outcome.detail)
        row = self._identify(frame, outcome)
        if row is None:
            return self._lose(frame, "identity_ambiguous", self._ambiguity)
        square = outcome.starting_at(row)
        self._known = self.last_fit = square
        self._unseen = 0
        self.last_reason = ""
        return self._reporter.found(
            frame,
            position_px=(float(square.corners_px[0, 0]), float(square.corners_px[0, 1])),
            sigma_px=float(square.sigma_px[0]),
            flags=_SEVERAL if square.rivals else frozenset(),
        )

    def _count_missed(self, frame: Frame) -> None:
        missed = 0 if self._newest_seq is None else frame.seq - self._newest_seq - 1
        self._unseen += max(missed, frame.dropped_before, 0)
        self._newest_seq = frame.seq

    def _identify(self, frame: Frame, square: SquareFit) -> int | None:
        """Row of the tracked corner, or None if that would be a guess."""
        if self._known is None:
            return self._choose(frame, square)
        if self._ambiguity:
            return None
        row, turn_deg = least_turn(self._known.corners_px, square.corners_px)
        if self._unseen > self._max_unseen:
            self._ambiguity = f"the square was out of sight for {self._unseen} frames: its corners may be confused"
            return None
        if abs(turn_deg) > self._max_turn_deg:
            self._ambiguity = f"the square turned by {turn_deg:.0f}° at once: its corners may be confused"
            return None
        return row

    def _choose(self, frame: Frame, square: SquareFit) -> int:
        if self._corner is not None:
            return self._corner
        target = np.array(frame.principal_point_px) + self._near_px
        return int(np.argmin(np.hypot(*(square.corners_px - target).T)))

    def _lose(self, frame: Frame, flag: str, detail: str) -> TrackedPoint:
        self.last_fit = None
        self.last_reason = f"{flag}: {detail}"
        return self._reporter.lost(frame, flag)
