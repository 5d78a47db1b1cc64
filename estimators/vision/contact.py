"""How far a specimen's contact point and the tool's tip have moved, frame by frame, in µm."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.core.contact_samples import DeformationSample
from microdrivers.core.errors import IllConditioned
from microdrivers.core.samples import Frame
from microdrivers.core.units import NS_PER_S, Range, check_range
from microdrivers.estimators.vision.contact_patch import ContactPatch
from microdrivers.estimators.vision.moving_tip import TipView
from microdrivers.estimators.vision.patch import Patch, PatchMatch
from microdrivers.estimators.vision.patch_location import MIN_CORRELATION, locate, locate_along
from microdrivers.estimators.vision.points import require_grey
from microdrivers.estimators.vision.template import FloatArray
from microdrivers.estimators.vision.visual_contact import VisualContact

_NAN = float("nan")
_SLACK_PX = 4.0
_PREDICTION_S = 0.5
_WAY_PX = 60.0
_UNRIGID_SHARE = 0.01
_UNRIGID_SIGMAS = 4.0


class ImageScale(NamedTuple):
    """What a displacement in the image means along the direction of probing.

    Attributes:
        um_per_px: row vector r: a displacement (u, v) px is r·(u, v) µm along the direction of probing.
        relative_sigma: relative standard deviation of the scale; it is common to all samples, whose sigma leaves it
            out.
    """

    um_per_px: tuple[float, float]
    relative_sigma: float

    @classmethod
    def from_travel(cls, tip: TipView) -> ImageScale:
        """From the probe's own travel: what moves across its direction does not count."""
        u, v = (tip.direction / tip.scale_px_per_um).tolist()
        return cls((u, v), tip.scale_sigma_px_per_um / tip.scale_px_per_um)

    @classmethod
    def from_projection(
        cls, jacobian_px_per_um: npt.ArrayLike, direction: npt.ArrayLike, *, relative_sigma: float = 0.0
    ) -> ImageScale:
        """From an optical calibration.

        Args:
            jacobian_px_per_um: A, the 2×2 block of the projection, ∂(u, v)/∂(X, Y).
            direction: of probing in the stage's plane, (X, Y); of any length.
            relative_sigma: relative standard deviation of A's scale.

        Raises:
            IllConditioned: A cannot be inverted, or the direction is zero.
        """
        matrix, along = np.asarray(jacobian_px_per_um, dtype=np.float64), np.asarray(direction, dtype=np.float64)[:2]
        length = float(np.hypot(*along))
        if not abs(float(np.linalg.det(matrix))) > 1e-12 or not length > 0.0:
            raise IllConditioned(
                "the projection does not tell lengths along the direction of probing",
                remedy="calibrate the optics at this zoom, and probe within the stage's plane",
            )
        u, v = (along / length @ np.linalg.inv(matrix)).tolist()
        return cls((u, v), relative_sigma)

    @property
    def px_per_um(self) -> float:
        """Displacement in the image for 1 µm, across the lines on which that direction's coordinate is the same."""
        return 1.0 / math.hypot(*self.um_per_px)


class DeformationTracker:
    """Tracks a specimen's contact point and the tool's tip against patches that never change.

    Each patch is fitted from where its last two places let expect it, with a gain and a bias of its own; if it is not
    there, it is searched for as far as it can have come since it was last seen. Matching against one patch, not
    against the frame before, keeps errors from adding up.

    Deformation and tip count from the undeformed surface along the direction of probing. Before the touch the tip's
    zero is where the surface was seen to begin, within some px (flag ZERO_BY_SIGHT); at the touch, which `contact`
    detects, or `set_contact()` states, both become exact.

    Flags: OUT_OF_VIEW, MISMATCH (nothing like the patch where it can be: covered, unsharp, other light or zoom)
    tell why the contact point was lost; TIP_LOST; ZERO_BY_SIGHT; NOT_RIGID (the patch stretches or turns, by which
    the contact point may be off by more than 1 %: take one with a smaller `rigid_um`).

    Args:
        camera: name under which the samples are published.
        tip: the tip as it was found.
        patch: the contact point's surroundings.
        scale: of the image; from the probe's own travel if None.
        max_speed_um_s: no faster do tip and contact point move; what is found farther away is something else.
        min_correlation: below this correlation coefficient, 0 … 1, a patch is lost.

    Attributes:
        contact: what detects the touch; its `event` is None before.
        last_reason: why the newest frame gave no deformation, in words; empty when it did.

    Raises:
        OutOfRange: a parameter is outside its range.
    """

    def __init__(
        self,
        camera: str,
        *,
        tip: TipView,
        patch: ContactPatch,
        scale: ImageScale | None = None,
        max_speed_um_s: float = 1000.0,
        min_correlation: float = MIN_CORRELATION,
    ) -> None:
        check_range(max_speed_um_s, Range(1.0, 1e6), what="max_speed_um_s", unit="µm/s")
        check_range(min_correlation, Range(0.1, 1.0), what="min_correlation", unit="(1 is a perfect match)")
        self._camera = camera
        self._scale = ImageScale.from_travel(tip) if scale is None else scale
        self._row = np.array(self._scale.um_per_px)
        limits = _Limits(max_speed_um_s * self._scale.px_per_um, min_correlation)
        self._tip = _Target(tip.patch, patch.tip_shift, limits, way=tip.direction)
        self._point = _Target(patch.patch, np.zeros(2), limits)
        self._contact_px = patch.contact_px
        self._zero_um = 0.0
        self._tip_zero_um = float(self._row @ patch.tip_shift) + patch.gap_px / self._scale.px_per_um
        self._by_sight = True
        self._seq = 0
        self.contact = VisualContact()
        self.last_reason = ""

    @property
    def scale(self) -> ImageScale:
        """The image's scale in use."""
        return self._scale

    def set_contact(self, *, tip_um: float, deformation_um: float = 0.0) -> None:
        """Set the zero where the touch was: what the samples so far called tip and deformation there."""
        self._tip_zero_um += tip_um
        self._zero_um += deformation_um
        self._by_sight = False

    def update(self, frame: Frame) -> DeformationSample:
        """Locate tip and contact point in `frame`.

        Returns:
            Deformation and tip, µm from the undeformed surface; NaN for what is lost.

        Raises:
            DataError: the image is not a two-dimensional uint8 or uint16 array.
        """
        image = require_grey(frame.image)
        tip, point = self._tip.follow(image, frame.t_ns), self._point.follow(image, frame.t_ns)
        sample = self._sample(frame, tip, point)
        if self._by_sight:
            event = self.contact.update(sample)
            if event is not None:
                self.set_contact(tip_um=event.tip_um, deformation_um=event.deformation_um)
                sample = self._sample(frame, tip, point)
        self._seq += 1
        return sample

    def _sample(self, frame: Frame, tip: PatchMatch | None, point: PatchMatch | None) -> DeformationSample:
        flags = set()
        if self._by_sight:
            flags.add("ZERO_BY_SIGHT")
        if tip is None:
            flags.add("TIP_LOST")
        tip_um, tip_sigma_um = self._along(tip, self._tip_zero_um)
        deformation_um, sigma_um = self._along(point, self._zero_um)
        u, v = _NAN, _NAN
        if point is None:
            flags.add(self._point.reason)
        else:
            u, v = (self._contact_px + point.shift - frame.principal_point_px).tolist()
            if self._yields(point):
                flags.add("NOT_RIGID")
        self.last_reason = "" if point is not None else _REASONS[self._point.reason]
        return DeformationSample(
            t_ns=frame.t_ns,
            dt_ns=frame.dt_ns,
            t_source="computed",
            device=self._camera,
            seq=self._seq,
            flags=frozenset(flags),
            deformation_um=deformation_um,
            sigma_um=sigma_um,
            tip_um=tip_um,
            tip_sigma_um=tip_sigma_um,
            u_px=u,
            v_px=v,
            found=point is not None,
            frame_seq=frame.seq,
            exposure_ms=frame.exposure_ms,
        )

    def _along(self, match: PatchMatch | None, zero_um: float) -> tuple[float, float]:
        if match is None:
            return _NAN, _NAN
        return float(self._row @ match.shift) - zero_um, math.sqrt(float(self._row @ match.covariance @ self._row))

    def _yields(self, match: PatchMatch) -> bool:
        """Whether the contact point moves otherwise than the patch as a whole."""
        difference = abs(float(self._row @ match.unrigid))
        sigma = math.sqrt(max(0.0, float(self._row @ match.unrigid_covariance @ self._row)))
        return difference > _UNRIGID_SHARE * abs(float(self._row @ match.shift)) + _UNRIGID_SIGMAS * sigma


_REASONS = {
    "OUT_OF_VIEW": "the contact point has left the image",
    "MISMATCH": "nothing like the contact point's surroundings where they can be: covered, unsharp, or other light",
}


class _Limits(NamedTuple):
    max_speed_px_s: float
    min_correlation: float


class _Target:
    """One patch on its way through the frames; along `way`, a unit vector, if it moves on a line."""

    def __init__(self, patch: Patch, shift: FloatArray, limits: _Limits, *, way: FloatArray | None = None) -> None:
        self._patch = patch
        self._way = way
        self._shift = shift
        self._t_ns: int | None = None
        self._speed = np.zeros(2)
        self._limits = limits
        self.reason = ""

    def follow(self, image: npt.NDArray[Any], t_ns: int) -> PatchMatch | None:
        """The patch in the next image, or None and a `reason`."""
        elapsed_s = 0.0 if self._t_ns is None else max(0.0, (t_ns - self._t_ns) / NS_PER_S)
        # Before the first frame it may have come any way.
        radius_px = float(max(image.shape))
        if self._t_ns is not None:
            radius_px = min(radius_px, _SLACK_PX + self._limits.max_speed_px_s * elapsed_s)
        expected = self._shift + self._speed * elapsed_s if elapsed_s < _PREDICTION_S else self._shift
        match = self._locate(image, expected, radius_px)
        if match is None or np.abs(match.shift - self._shift).max() > radius_px:
            self.reason = "MISMATCH" if self._patch.fits_in(image.shape, expected) else "OUT_OF_VIEW"
            return None
        known = self._t_ns is not None and 0.0 < elapsed_s < _PREDICTION_S
        self._speed = (match.shift - self._shift) / elapsed_s if known else np.zeros(2)
        self._shift, self._t_ns = match.shift, t_ns
        self.reason = ""
        return match

    def _locate(self, image: npt.NDArray[Any], expected: FloatArray, radius_px: float) -> PatchMatch | None:
        """Where it is expected, else about where it was last seen."""
        least = self._limits.min_correlation
        match = self._patch.refine(image, expected)
        if match is not None and match.correlation >= least:
            return match
        if self._way is not None:
            # A search by brightness alone would take what lies ahead of the tip for a part of it.
            reach_px = min(radius_px, _WAY_PX)
            match = locate_along(
                self._patch,
                image,
                self._way,
                start=self._shift,
                back_px=reach_px,
                ahead_px=reach_px,
                min_correlation=least,
            )
        if match is None or match.correlation < least:
            match = locate(self._patch, image, self._shift, radius_px=radius_px, min_correlation=least)
        return match
