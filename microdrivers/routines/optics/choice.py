"""Which of a run's estimates becomes its result: the last one of the last zoom that was measured well enough."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from microdrivers.core.errors import IllConditioned
from microdrivers.core.samples import OpticsEstimate
from microdrivers.estimators.optics import OpticalParameters, optical_parameters, student_factor

ZOOM_STILL = 1e-3
"""Relative change of zoom from frame to frame that counts as a zoom change."""
LARGEST_SCALE_UNCERTAINTY = 0.05
"""A calibration whose scale is known no better than this (95 %, relative) is refused."""
FEWEST_FRAMES = 9
"""Frames at one resting zoom that a calibration needs: what remains, once the zoom has come to rest, of the twelve that
an experiment takes at least after it commands the zoom change."""
NARROWEST_PATH = 0.05
"""Spread of the poses across their path over the spread along it; on a circle, 0.05 is an arc of 22°."""


class Choice(NamedTuple):
    """What becomes the result.

    Attributes:
        frames_since_change: frames after its zoom was left; 0 if the zoom is still the same.
        why_not_newer: what the frames since then lack; empty if there are none.
    """

    estimate: OpticsEstimate
    parameters: OpticalParameters
    frames_since_change: int
    why_not_newer: str


def begins_change(before: OpticsEstimate, now: OpticsEstimate) -> bool:
    """Whether the zoom began to move, or has moved unseen, between two frames."""
    if now.zoom_moving:
        return not before.zoom_moving
    return not before.zoom_moving and abs(now.zoom - before.zoom) > ZOOM_STILL * before.zoom


def choose_estimate(
    estimates: Sequence[OpticsEstimate],
    *,
    pixel_pitch_um: float | None,
    lost_frames: int = 0,
    unmatched_frames: int = 0,
) -> Choice:
    """The last estimate of the last zoom for which frames and arc suffice.

    Args:
        estimates: one a matched frame, in order.
        pixel_pitch_um: distance of the camera's pixels, µm, after binning; None if not known.
        lost_frames: frames without the target, for the error's message.
        unmatched_frames: frames without a pose, for the error's message.

    Raises:
        IllConditioned: they suffice for no zoom; the message says what the longest measured one lacks.
    """
    stretches = _stretches(estimates)
    failures: list[tuple[int, str]] = []
    for first, end in reversed(stretches):
        try:
            estimate, parameters = _sound_estimate(estimates[first:end], pixel_pitch_um)
        except IllConditioned as error:
            failures.append((end - first, error.what))
            continue
        since = len(estimates) - end
        newest = _too_few(0) if estimates[-1].zoom_moving else failures[0][1] if since else ""
        return Choice(estimate, parameters, since, newest)
    why = max(failures)[1] if failures else _too_few(0)
    raise IllConditioned(
        f"{len(estimates)} frames with a pose do not determine a calibration: {why} "
        f"({lost_frames} frames without the target, {unmatched_frames} without a pose)",
        remedy="take more frames while the zoom rests, with the target in view, and move further and along both axes: "
        "a circle that fills the view is best",
    )


def _stretches(estimates: Sequence[OpticsEstimate]) -> list[tuple[int, int]]:
    """First index and end of each run of frames at one resting zoom."""
    found: list[tuple[int, int]] = []
    for index, estimate in enumerate(estimates):
        if estimate.zoom_moving:
            continue
        if found and found[-1][1] == index and not begins_change(estimates[index - 1], estimate):
            found[-1] = (found[-1][0], index + 1)
        else:
            found.append((index, index + 1))
    return found


def _sound_estimate(
    estimates: Sequence[OpticsEstimate], pixel_pitch_um: float | None
) -> tuple[OpticsEstimate, OpticalParameters]:
    """The last estimate of one zoom with what it says.

    Raises:
        IllConditioned: the frames of this zoom do not suffice; the message completes a sentence.
    """
    if len(estimates) < FEWEST_FRAMES:
        raise IllConditioned(_too_few(len(estimates)))
    poses_um = np.array([(estimate.x_um, estimate.y_um) for estimate in estimates])
    extent = "{:.3g} × {:.3g} µm".format(*np.ptp(poses_um, axis=0))
    along, across = np.linalg.svd(poses_um - poses_um.mean(axis=0), compute_uv=False)
    if across <= NARROWEST_PATH * along:
        raise IllConditioned(f"the stage moved over {extent} on too straight a path or too short an arc")
    determined = [estimate for estimate in estimates if estimate.valid and estimate.covariance]
    if not determined:
        raise IllConditioned(f"the stage moved over {extent}, which leaves the scale open")
    final = determined[-1]
    parameters = optical_parameters(
        final.projection,
        np.array(final.covariance).reshape(6, 6),
        degrees_of_freedom=final.degrees_of_freedom,
        pixel_pitch_um=pixel_pitch_um,
    )
    sigma = parameters.sigma_scale_px_per_um
    factor = student_factor(final.degrees_of_freedom)
    if sigma is None or not np.isfinite(factor):
        raise IllConditioned("the residuals do not tell how uncertain the scale is")
    relative = factor * sigma / parameters.scale_px_per_um
    if not relative <= LARGEST_SCALE_UNCERTAINTY:
        raise IllConditioned(f"the scale is uncertain by {100 * relative:.0f} %: the stage moved over {extent}")
    return final, parameters


def _too_few(frames: int) -> str:
    return f"{frames} frame{'' if frames == 1 else 's'} with the zoom at rest, and {FEWEST_FRAMES} are needed"
