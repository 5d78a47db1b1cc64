"""Find the tip of a probe by what moved in the image while the probe did, and the image's scale with it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from microdrivers.core.errors import DataError, OutOfRange
from microdrivers.core.samples import Frame
from microdrivers.estimators.vision.motion_segments import changed_region, displacement_into, even_light
from microdrivers.estimators.vision.patch import MIN_PIXELS, BoolArray, Patch, PatchMatch, take_patch
from microdrivers.estimators.vision.points import require_grey
from microdrivers.estimators.vision.template import MARGIN_PX, Float32Array, FloatArray, interpolated, interpolator
from microdrivers.estimators.vision.tip_front import FLANK_PX, TipFront, find_front

MissReason = Literal["nothing_moved", "not_the_probe", "too_little_shape", "at_border", "does_not_follow"]

MIN_FRAMES = 3
"""Frames that a line through the tip's places takes, its scatter included."""

MIN_DISPLACEMENT_PX = 6.0
"""Of the tip between the first and the last frame."""

_MIN_CORRELATION = 0.6
"""Of what changed, and of the tip in each frame, with itself in the last."""

_KEPT_BEHIND_PX, _AHEAD_PX = 60.0, 5.0
"""Length of the tip's end that is tracked, behind its front and ahead of it."""

_BEHIND_PX = 4.0
"""Behind the front begins what the front does not show in."""

_SUFFICIENT_PX = 0.04
"""Standard deviation of the shift in one frame, with which marks behind the front do."""

_BESIDE_PX, _SLACK_PX = 3, 2
"""Beside the tip: what is taken for its edges; and what is left besides at the image's border."""

_MAX_RESIDUAL_PX = 0.3
"""RMS by which a tip that follows its travel may scatter about it, both axes together."""

_RESTLESS_SIGMAS = 3.0
"""Standard deviations of the noise: what scatters more from frame to frame does not move along with the tip."""

_REMEDIES: dict[str, str] = {
    "nothing_moved": "move the probe farther between the first and the last frame, and look whether its tip is in view",
    "not_the_probe": "let nothing but the probe move, and check the scale hint (zoom, objective) and the camera's view",
    "too_little_shape": "focus on the tip, raise the contrast of the light, or zoom in",
    "at_border": "begin with the tip farther within the view",
    "does_not_follow": "let the stage settle before each frame, and check that the travel belongs to the frames",
}


class NoMovingTip(DataError):
    """The frames show no probe that moves as its encoder says; `reason` is one of `MissReason`."""

    def __init__(self, reason: MissReason, what: str) -> None:
        super().__init__(what, remedy=_REMEDIES[reason])
        self.reason = reason


class TipView(NamedTuple):
    """A probe's tip in the image of one camera, and how the image moves with the probe.

    Attributes:
        patch: the tip's end; a shift of zero is where it was in the last of the frames. A tip with marks of its own
            is tracked by these; of a plain one the front is needed, at which a dark membrane cannot be told from a
            dark tip: it then reads up to half a pixel short, the same as long as they touch.
        front_px: the middle of the tip's front there, (u, v) from the centre of the top-left pixel.
        direction: of the approach in the image, a unit vector (u, v).
        width_px: of the tip near its front.
        scale_px_per_um: displacement in the image per µm of the encoder's travel.
        scale_sigma_px_per_um: its standard deviation.
        travel_um: the encoder's travel at which the patch's shift is zero.
        frames: how many frames took part.
    """

    patch: Patch
    front_px: FloatArray
    direction: FloatArray
    width_px: float
    scale_px_per_um: float
    scale_sigma_px_per_um: float
    travel_um: float
    frames: int


def find_moving_tip(
    frames: Sequence[Frame],
    travel_um: Sequence[float],
    *,
    scale_hint_px_per_um: float,
    travel_sigma_um: float = 0.01,
) -> TipView:
    """Find the probe by its motion in a few frames of its approach through free space.

    The region that changed between the first and the last frame is what the tip has covered. Its content is found
    again in every frame, and the images are laid on each other there: the mean is the tip's patch, with less noise
    than one frame and with what rests behind it faded. A line through the displacements against the encoder's travel
    gives direction and scale, each frame weighted by its own uncertainty.

    Args:
        frames: at least three, at different places of the probe, the specimen untouched and nothing else moving.
        travel_um: the probe's travel towards the specimen at each frame, rising; 6 px in the image at least.
        scale_hint_px_per_um: rough scale of the image, right within a factor of 1.5.
        travel_sigma_um: standard deviation of each travel.

    Raises:
        OutOfRange: too few frames, or the travel does not rise by enough.
        DataError: an image is not a grey one.
        NoMovingTip: nothing moved, or not as the encoder says.
    """
    travel = np.asarray(travel_um, dtype=np.float64)
    length_px = _check(frames, travel, scale_hint_px_per_um)
    images, noise = even_light([require_grey(frame.image) for frame in frames])
    region = changed_region(images[0], images[-1], noise)
    if region is None:
        raise NoMovingTip("nothing_moved", "the first and the last frame of the approach look the same")
    vector, correlation = displacement_into(region, images[0], images[-1], length_px=length_px)
    if correlation < _MIN_CORRELATION:
        raise NoMovingTip(
            "not_the_probe",
            f"what changed in the image did not move by about {length_px:.0f} px (best correlation {correlation:.2f})",
        )
    share = (travel - travel[-1]) / (travel[-1] - travel[0])
    direction = vector / np.hypot(*vector)
    region = _seen_throughout(region, vector)
    mask = _mask(region, find_front(images[-1], region, direction), direction)
    first = _require_patch(take_patch(images[-1], mask, noise_levels=noise, noise_share=1.0))
    shifts = _follow(first, images, share[:, None] * vector, radius_px=4.0 + 0.1 * length_px)
    mean, noise_share, restless = _mean_image(images, shifts, mask, noise)
    front = find_front(mean, region, direction)
    mask = _mask(region, front, direction) & ~restless
    whole = _require_patch(take_patch(mean, mask, noise_levels=noise, noise_share=noise_share))
    matches = _follow(whole, images, share[:, None] * vector, radius_px=4.0 + 0.1 * length_px)
    patch = _choose_patch(mean, mask, front, direction, noise_share=noise_share, noise_levels=noise)
    return _fit(patch, front, matches, travel, travel_sigma_um)


def _choose_patch(
    image: Float32Array,
    mask: BoolArray,
    front: TipFront,
    direction: FloatArray,
    *,
    noise_share: float,
    noise_levels: float,
) -> Patch:
    """The tip without its front, if its own marks or shape suffice; else with it, whatever comes to lie ahead."""
    behind = mask & (front.along(direction, mask.shape) < -_BEHIND_PX)
    plain = take_patch(image, behind, noise_levels=noise_levels, noise_share=noise_share)
    if plain is not None and plain.sigma_px(noise_levels, direction) < _SUFFICIENT_PX:
        return plain
    return _require_patch(
        take_patch(
            image, mask, noise_levels=noise_levels, noise_share=noise_share, nuisance=front.ahead(direction, mask.shape)
        )
    )


def _check(frames: Sequence[Frame], travel: FloatArray, scale_hint: float) -> float:
    """The displacement to expect between the first and the last frame, px."""
    if len(frames) < MIN_FRAMES or len(frames) != len(travel):
        raise OutOfRange(
            f"{len(frames)} frames with {len(travel)} travels; at least {MIN_FRAMES} of each are needed",
            remedy="take frames at several places of the approach, and the encoder's travel with each",
        )
    if not np.all(np.isfinite(travel)) or not np.all(np.diff(travel) >= 0.0):
        raise OutOfRange("the travel must rise from frame to frame", remedy="count travel towards the specimen")
    length_px = scale_hint * float(travel[-1] - travel[0])
    if not length_px >= MIN_DISPLACEMENT_PX:
        raise OutOfRange(
            f"a travel of {travel[-1] - travel[0]:.3g} µm moves the image by {length_px:.1f} px only",
            remedy=f"let the probe approach by {MIN_DISPLACEMENT_PX / scale_hint:.0f} µm or more, or zoom in",
        )
    return length_px


def _require_patch(patch: Patch | None) -> Patch:
    if patch is None:
        raise NoMovingTip("too_little_shape", "the tip is too small or too faint in the image to be tracked")
    return patch


def _mask(region: BoolArray, front: TipFront, direction: FloatArray) -> BoolArray:
    """The pixels of the tip's end, its edges included."""
    side = 2 * _BESIDE_PX + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    mask = cv2.dilate(region.astype(np.uint8), kernel).astype(bool)
    along = front.along(direction, mask.shape)
    mask &= (along > -_KEPT_BEHIND_PX) & (along < _AHEAD_PX)
    return np.asarray(mask)


def _seen_throughout(region: BoolArray, vector: FloatArray) -> BoolArray:
    """The part of the region that was in view already before it moved by `vector`, its surroundings too."""
    margin = MARGIN_PX + _BESIDE_PX + _SLACK_PX
    v, u = np.mgrid[0 : region.shape[0], 0 : region.shape[1]]
    seen = np.ones_like(region)
    for places, part, size in ((u, vector[0], region.shape[1]), (v, vector[1], region.shape[0])):
        seen &= (places - max(0.0, part) >= margin) & (places - min(0.0, part) < size - margin)
    if int((region & seen).sum()) < MIN_PIXELS:
        raise NoMovingTip("at_border", "the tip had hardly come into view in the first frames")
    return np.asarray(region & seen)


def _follow(
    patch: Patch, images: Sequence[npt.NDArray[Any]], expected: FloatArray, *, radius_px: float
) -> list[PatchMatch | None]:
    matches: list[PatchMatch | None] = []
    for image, shift in zip(images, expected, strict=True):
        place = patch.search(image, shift, radius_px)
        match = None if place is None else patch.refine(image, place.astype(np.float64))
        matches.append(match if match is not None and match.correlation >= _MIN_CORRELATION else None)
    if sum(match is not None for match in matches) < MIN_FRAMES:
        raise NoMovingTip("does_not_follow", "the tip is not where its travel should have taken it in most frames")
    return matches


def _mean_image(
    images: Sequence[Float32Array], matches: Sequence[PatchMatch | None], mask: BoolArray, noise_levels: float
) -> tuple[Float32Array, float, BoolArray]:
    """The images laid on each other where the tip is, the share of their noise left, and what does not move along."""
    v, u = np.nonzero(mask)
    shape = np.array(mask.shape[::-1])
    border = FLANK_PX[1] + 2
    low = np.maximum(np.array([u.min(), v.min()]) - border, MARGIN_PX)
    high = np.minimum(np.array([u.max(), v.max()]) + 1 + border, shape - MARGIN_PX)
    size = (int(high[0] - low[0]), int(high[1] - low[1]))
    layers, smoothing = [], 0.0
    for image, match in zip(images, matches, strict=True):
        if match is None:
            continue
        corner = low + match.shift
        if corner.min() < MARGIN_PX or np.any(corner + size > shape - MARGIN_PX):
            continue
        layers.append(interpolated(image, corner, size))
        smoothing += math.prod(float((interpolator(x) ** 2).sum()) for x in (corner % 1.0).tolist())
    mean, restless = images[-1].copy(), np.zeros(mask.shape, dtype=bool)
    if len(layers) < MIN_FRAMES:
        return mean, 1.0, restless
    window = (slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0])))
    mean[window] = np.mean(layers, axis=0)
    spread = cv2.blur(np.var(layers, axis=0, ddof=1), (3, 3))
    uneven = (spread > (_RESTLESS_SIGMAS * noise_levels) ** 2).astype(np.uint8)
    restless[window] = cv2.dilate(uneven, np.ones((5, 5), np.uint8)) > 0
    return mean, smoothing / len(layers) ** 2, restless


def _fit(
    patch: Patch,
    front: TipFront,
    matches: Sequence[PatchMatch | None],
    travel: FloatArray,
    travel_sigma_um: float,
) -> TipView:
    """Weighted line through the displacements against the travel."""
    found = [(match, float(x)) for match, x in zip(matches, travel, strict=True) if match is not None]
    slope = (found[-1][0].shift - found[0][0].shift) / (found[-1][1] - found[0][1])
    normal, right = np.zeros((4, 4)), np.zeros(4)
    weights = [np.linalg.inv(m.covariance + travel_sigma_um**2 * np.outer(slope, slope)) for m, _ in found]
    designs = [np.hstack([np.eye(2), x * np.eye(2)]) for _, x in found]
    for (match, _), weight, design in zip(found, weights, designs, strict=True):
        normal += design.T @ weight @ design
        right += design.T @ weight @ match.shift
    covariance = np.linalg.inv(normal)
    line = covariance @ right
    residuals = [match.shift - design @ line for (match, _), design in zip(found, designs, strict=True)]
    squares = sum(float(r @ weight @ r) for r, weight in zip(residuals, weights, strict=True))
    covariance = covariance * max(1.0, squares / (2 * len(found) - 4))
    rms = math.sqrt(float(np.mean([r @ r for r in residuals])))
    if rms > _MAX_RESIDUAL_PX:
        raise NoMovingTip("does_not_follow", f"the tip's displacements scatter by {rms:.2f} px about its travel")
    scale = float(np.hypot(line[2], line[3]))
    direction = line[2:] / scale
    return TipView(
        patch=patch,
        front_px=front.point,
        direction=direction,
        width_px=front.width_px,
        scale_px_per_um=scale,
        scale_sigma_px_per_um=math.sqrt(float(direction @ covariance[2:, 2:] @ direction)),
        travel_um=-float(direction @ line[:2]) / scale,
        frames=len(found),
    )
