"""Choose the piece of a specimen by which its contact point is tracked, before the probe touches it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from microdrivers.core.errors import DataError, OutOfRange
from microdrivers.core.samples import Frame
from microdrivers.core.units import Range, check_range
from microdrivers.estimators.vision.motion_segments import even_light
from microdrivers.estimators.vision.moving_tip import TipView
from microdrivers.estimators.vision.patch import MIN_PIXELS, BoolArray, Patch, PatchMatch, take_patch
from microdrivers.estimators.vision.patch_location import locate, locate_along
from microdrivers.estimators.vision.points import require_grey
from microdrivers.estimators.vision.template import MARGIN_PX, Float32Array, FloatArray

MissReason = Literal["no_tip", "no_specimen", "no_texture", "too_small", "at_border", "saturated", "unsteady"]

_SEARCH_UM = 500.0
"""How far ahead of the tip the specimen is looked for, and the tip about its last place."""

_MAX_SIGMA_PX = 0.03
"""Largest standard deviation of the displacement in one frame."""

_SMOOTHING_PX = 1.0
"""Standard deviation of the blur before slopes are taken."""

_TEXTURE_SIGMAS = 3.0
"""Standard deviations of the noise's slope beyond which a slope is texture."""

_TEXTURED_SHARE = 0.5
"""Of the corridor's width: where more is texture, there is specimen."""

_TIP_EDGE_PX, _CLEAR_PX = 4, 4
"""Ahead of the front: what still shows the tip's own edge, and what must be clear beyond it to look straight ahead."""

_LEAST_GAP_PX = 3
"""Texture may be interrupted by that, or by a fifth of the length that it must have."""

_RIM_PX, _RIM_SHARE = 4.0, 0.12
"""Behind the surface, also as a share of the disc's radius: what is left out for the tip and what shows beside it."""

_MIN_REACH_PX = 10.0
"""Radius of the smallest disc."""

_MIN_KEPT = 0.5
"""Of the disc's area: what must be in view, and of that, what must not be saturated."""

_SATURATED_LEVELS = 2
"""Grey levels below the top one from which on a mean of frames is taken for saturated."""

_MUCH_WHITE = 0.02
"""Of the image: where more is white, light is why no specimen is seen."""

_UNSTEADY_PX = 0.1
"""What a specimen at rest may seem to move by, besides five standard deviations."""

_REMEDIES: dict[str, str] = {
    "no_tip": "find the tip anew: zoom, focus or light changed, or the probe left the view",
    "no_specimen": "aim the probe at the specimen, bring it nearer, or focus on the specimen",
    "no_texture": "focus on the specimen, or raise the light or its angle until grains show",
    "too_small": "zoom in, until the region that moves with the contact point spans more pixels",
    "at_border": "move the sample stage, so that the contact point stays in view as it is pressed in",
    "saturated": "lower the light or the exposure time",
    "unsteady": "let the specimen come to rest, and keep the probe off it until the patch is taken",
}


class NoContactPatch(DataError):
    """No piece of the specimen ahead of the tip can be tracked; `reason` is one of `MissReason`."""

    def __init__(self, reason: MissReason, what: str) -> None:
        super().__init__(what, remedy=_REMEDIES[reason])
        self.reason = reason


class ContactPatch(NamedTuple):
    """The piece of a specimen by which its contact point is tracked.

    Attributes:
        patch: the pixels; a shift of zero is the undeformed specimen.
        contact_px: where the tip will touch the surface, (u, v) from the centre of the top-left pixel; right within
            2 px.
        gap_px: from the tip's front to the surface in the last of the frames; by sight right within 2 px from ten
            frames of a sharp surface.
        tip_shift: shift of the tip's patch in the last of the frames, px.
        reach_px: radius about the contact point in which the patch lies.
        noise_levels: standard deviation of a frame's noise, grey levels.
        sigma_px: standard deviation of the displacement along the direction of probing, predicted from these.
    """

    patch: Patch
    contact_px: FloatArray
    gap_px: float
    tip_shift: FloatArray
    reach_px: float
    noise_levels: float
    sigma_px: float


def contact_patch(
    frames: Sequence[Frame],
    tip: TipView,
    *,
    gap_um: float | None = None,
    rigid_um: float = 100.0,
    depth_um: float = 150.0,
) -> ContactPatch:
    """Take the patch that will tell the contact point's displacement, from frames of the specimen at rest.

    The surface is where texture begins ahead of the tip. The patch is the part of a disc about that point which lies
    behind the surface by 12 % of its radius, 4 px at least: the tip stays at the surface and moves with it, so that
    it never comes into the patch, nor does what shows beside it. Saturated pixels are left out.

    The patch is tracked as a rigid piece. Where the specimen yields unevenly within `rigid_um` of the contact point,
    the displacement found is a mean over the patch. If it falls off from the contact point over a length L, as
    exp(−(r/L)²), the bias is about −0.5·(rigid_um/L)²: 1 % for L = 7 rigid_um. A smaller disc has less bias and
    more noise, in inverse proportion to its radius.

    Args:
        frames: the undeformed specimen, the tip not touching it; their mean is the patch, so that ten frames bring
            its own noise down to a tenth of the variance of a tracked frame. The tip may move.
        tip: the probe's tip; it must be in view.
        gap_um: how far ahead of the tip the surface is in the last frame, if a force sensor has told; otherwise it is
            looked for.
        rigid_um: what lies nearer to the contact point than this moves with it as one piece.
        depth_um: how far the contact point will be pressed in; so long the patch must stay in view.

    Raises:
        OutOfRange: no frames, or a length is not positive.
        DataError: an image is not a grey one.
        NoContactPatch: there is no good patch; says why and what helps.
    """
    if not frames:
        raise OutOfRange("no frames", remedy="give one frame of the undeformed specimen at least, better ten")
    for name, value in (("rigid_um", rigid_um), ("depth_um", depth_um)):
        check_range(value, Range(1.0, 1e4), what=name, unit="µm")
    raw = [require_grey(frame.image) for frame in frames]
    found = _find_tip(tip, raw[-1])
    if found is None:
        raise NoContactPatch("no_tip", "the probe's tip is not seen in the frames of the undeformed specimen")
    images, noise = even_light(raw)
    mean = np.asarray(np.mean(images, axis=0), dtype=np.float32)
    front = tip.front_px + found.shift
    white = _white(mean, 2 ** frames[-1].bit_depth - 1)
    if gap_um is None:
        gap = _require_gap_px(mean, front, tip, noise=noise / math.sqrt(len(raw)), white=white)
    else:
        gap = gap_um * tip.scale_px_per_um
    contact = front + gap * tip.direction
    reach = rigid_um * tip.scale_px_per_um
    if reach < _MIN_REACH_PX:
        raise NoContactPatch("too_small", f"{rigid_um:.0f} µm about the contact point are {reach:.1f} px only")
    mask = _mask(white, contact, tip.direction, reach)
    patch = take_patch(mean, mask, noise_levels=noise, noise_share=1.0 / len(raw), pivot_px=contact)
    patch, sigma = _require_texture(patch, noise, tip.direction)
    if not patch.fits_in(mean.shape, depth_um * tip.scale_px_per_um * tip.direction):
        raise NoContactPatch("at_border", f"pressed in by {depth_um:.0f} µm, the contact point leaves the view")
    _require_rest(patch, raw)
    return ContactPatch(patch, contact, gap, found.shift, reach, noise, sigma)


def _find_tip(tip: TipView, image: npt.NDArray[Any]) -> PatchMatch | None:
    """On its way first: there it is found even if the specimen lies at its front."""
    reach_px = _SEARCH_UM * tip.scale_px_per_um
    on_way = locate_along(tip.patch, image, tip.direction, start=np.zeros(2), back_px=0.5 * reach_px, ahead_px=reach_px)
    return on_way or locate(tip.patch, image, np.zeros(2), radius_px=float(max(image.shape)))


def _require_gap_px(image: Float32Array, front: FloatArray, tip: TipView, *, noise: float, white: BoolArray) -> float:
    gap = _gap_px(image, front, tip, noise=noise)
    if gap is None and white.mean() > _MUCH_WHITE:
        raise NoContactPatch("saturated", "no texture ahead of the tip, and much of the image is white")
    if gap is None:
        raise NoContactPatch("no_specimen", f"no texture within {_SEARCH_UM:.0f} µm ahead of the tip")
    return gap


def _gap_px(image: Float32Array, front: FloatArray, tip: TipView, *, noise: float) -> float | None:
    """From the tip's front to the specimen's surface; None if there is none.

    Straight ahead if a clear stretch lies before the surface, otherwise from what shows on either side of the tip.
    """
    slope = _slope(image)
    limit = _TEXTURE_SIGMAS * max(noise, 0.3) / (2.0 * math.sqrt(2.0 * math.pi) * _SMOOTHING_PX**2)
    half, search_px = max(3.0, 0.35 * tip.width_px), _SEARCH_UM * tip.scale_px_per_um
    ahead = _onset(slope, limit, front, tip, middle=0.0, half=half, start=float(_TIP_EDGE_PX), end=search_px)
    if ahead is None or ahead > _TIP_EDGE_PX + _CLEAR_PX:
        return ahead
    aside = 0.5 * tip.width_px + _TIP_EDGE_PX + half
    sides = [
        _onset(slope, limit, front, tip, middle=middle, half=half, start=-2.0 * aside, end=_TIP_EDGE_PX + 2.0 * aside)
        for middle in (-aside, aside)
    ]
    seen = [side for side in sides if side is not None]
    return max(0.0, sum(seen) / len(seen)) if seen else None


def _slope(image: Float32Array) -> Float32Array:
    """How steep the image is, grey levels per px."""
    smooth = cv2.GaussianBlur(image, (0, 0), _SMOOTHING_PX)
    by_u, by_v = (cv2.Scharr(smooth, cv2.CV_32F, *order) / 32.0 for order in ((1, 0), (0, 1)))
    return np.asarray(np.hypot(by_u, by_v), dtype=np.float32)


def _onset(
    slope: Float32Array,
    limit: float,
    front: FloatArray,
    tip: TipView,
    *,
    middle: float,
    half: float,
    start: float,
    end: float,
) -> float | None:
    """Where texture that goes on begins in a corridor ahead: its steepest place, px from the tip's front; or None."""
    across_axis = np.array([-tip.direction[1], tip.direction[0]])
    steps, across = np.arange(start, end), middle + np.arange(-half, half + 1.0)
    places = front + steps[:, None, None] * tip.direction + across[None, :, None] * across_axis
    maps = (places[..., 0].astype(np.float32), places[..., 1].astype(np.float32))
    steep = cv2.remap(slope, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0)
    busy = (steep > limit).mean(axis=1) > _TEXTURED_SHARE
    level = steep.mean(axis=1)
    length = max(6, int(tip.width_px))
    for first in np.flatnonzero(busy).tolist():
        following = busy[first : first + length]
        if len(following) == length and _longest_gap(following) <= max(_LEAST_GAP_PX, length // 5):
            while first + 1 < len(level) and level[first + 1] >= level[first]:
                first += 1
            return start + first
    return None


def _longest_gap(busy: BoolArray) -> int:
    """The longest run of False."""
    ends = np.flatnonzero(np.concatenate([[True], busy, [True]]))
    return int(np.diff(ends).max()) - 1


def _white(image: Float32Array, top_level: int) -> BoolArray:
    """What is saturated, or so near to it that interpolation meets it."""
    bright = (image >= top_level - _SATURATED_LEVELS).astype(np.uint8)
    return np.asarray(cv2.dilate(bright, np.ones((5, 5), np.uint8)) > 0)


def _mask(white: BoolArray, contact: FloatArray, direction: FloatArray, reach_px: float) -> BoolArray:
    v, u = np.mgrid[0 : white.shape[0], 0 : white.shape[1]].astype(np.float64)
    du, dv = u - contact[0], v - contact[1]
    disc = (du * du + dv * dv <= reach_px**2) & (
        du * direction[0] + dv * direction[1] >= max(_RIM_PX, _RIM_SHARE * reach_px)
    )
    area = 0.5 * math.pi * reach_px**2 - 2.0 * reach_px * max(_RIM_PX, _RIM_SHARE * reach_px)
    inside = np.zeros_like(disc)
    inside[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX] = True
    if (disc & inside).sum() < _MIN_KEPT * area:
        raise NoContactPatch("at_border", "most of the specimen about the contact point is out of view")
    kept = disc & inside & ~white
    if kept.sum() < _MIN_KEPT * (disc & inside).sum():
        raise NoContactPatch("saturated", "most of the specimen about the contact point is white")
    if kept.sum() < MIN_PIXELS:
        raise NoContactPatch("too_small", f"the patch behind the contact point has {kept.sum()} pixels only")
    return np.asarray(kept)


def _require_texture(patch: Patch | None, noise_levels: float, direction: FloatArray) -> tuple[Patch, float]:
    """The patch, and the standard deviation of the displacement that it gives."""
    sigma = math.inf if patch is None else patch.sigma_px(noise_levels, direction)
    if patch is None or sigma > _MAX_SIGMA_PX:
        what = f"the displacement would be uncertain by {sigma:.2g} px a frame, more than {_MAX_SIGMA_PX:g} px"
        raise NoContactPatch("no_texture", f"too little texture behind the contact point: {what}")
    return patch, sigma


def _require_rest(patch: Patch, images: Sequence[npt.NDArray[Any]]) -> None:
    for image in images:
        match = patch.refine(image, np.zeros(2))
        if match is None or np.abs(match.shift).max() > _UNSTEADY_PX + 5.0 * math.sqrt(float(match.covariance.max())):
            raise NoContactPatch("unsteady", "the specimen moves while its patch is taken")
