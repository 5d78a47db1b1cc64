"""Every frame of an indentation, also those without a deformation or a force, as samples and as a record."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import msgspec
import numpy as np

from microdrivers.core.contact_samples import DeformationSample, IndentationSample
from microdrivers.core.samples import ForceSample
from microdrivers.core.units import NS_PER_S
from microdrivers.devices.force_sensor import SATURATED
from microdrivers.estimators.force.matcher import GivenUp
from microdrivers.estimators.force.record import IndentationRecord
from microdrivers.estimators.vision.image_drift import ImageDrift, image_drift
from microdrivers.routines.force.source import Rests

TOUCHES_UN = 1.0
"""A change of the force by which a tool must touch: its own spring is bent then."""

_FELT_SIGMAS = 8.0
"""Standard deviations that are no noise."""


def all_frames(
    matched: Sequence[IndentationSample], deformations: Iterable[DeformationSample], given_up: Iterable[GivenUp]
) -> list[IndentationSample]:
    """The matched samples, and between them one for each frame that was given up, its reason among the flags.

    What is not known of such a frame is NaN; a saturated sensor tells where it stood. Frames before the first and after
    the last that say anything of a force are left out.

    Args:
        matched: deformation and force.
        deformations: one a frame.
        given_up: frames without a force or a deformation.
    """
    seen = {sample.t_ns: sample for sample in deformations}
    frames = [_without(gone, seen.get(gone.t_ns)) for gone in given_up]
    rows = sorted([*matched, *frames], key=lambda sample: sample.t_ns)
    known = [index for index, row in enumerate(rows) if math.isfinite(row.force_uN)]
    return rows[known[0] : known[-1] + 1] if known else []


def _without(gone: GivenUp, seen: DeformationSample | None) -> IndentationSample:
    return IndentationSample(
        t_ns=gone.t_ns,
        device="" if seen is None else seen.device,
        flags=frozenset({gone.reason}),
        deformation_um=math.nan if seen is None else seen.deformation_um,
        deformation_sigma_um=math.nan if seen is None else seen.sigma_um,
        force_uN=gone.force_uN,
        force_sigma_uN=math.nan,
        readings=0,
        frame_seq=-1 if seen is None else seen.frame_seq,
    )


def drift_of(
    deformations: Sequence[DeformationSample], matched: Sequence[IndentationSample], rests: Rests | None
) -> ImageDrift | None:
    """How the picture drifted during an indentation; None if the tool's rests do not tell, or it touched in one."""
    if rests is None:
        return None
    before, after = (
        [sample.force_uN for sample in matched if sample.t_ns <= rests.until_ns],
        [sample.force_uN for sample in matched if sample.t_ns >= rests.since_ns],
    )
    if not before or not after or abs(float(np.mean(after) - np.mean(before))) > TOUCHES_UN:
        return None
    return image_drift(
        [sample for sample in deformations if sample.t_ns <= rests.until_ns],
        [sample for sample in deformations if sample.t_ns >= rests.since_ns],
        travel_um=rests.travel_um,
        travel_sigma_um=rests.travel_sigma_um,
    )


def in_contact_uN(samples: Iterable[IndentationSample | ForceSample]) -> list[float]:
    """How far the force is off its usual value in those samples where it clearly is; most are of a free tool."""
    known = np.array([sample.force_uN for sample in samples if math.isfinite(sample.force_uN)])
    if not len(known):
        return []
    off = np.abs(known - np.median(known))
    found: list[float] = off[off > max(TOUCHES_UN, _FELT_SIGMAS * float(np.median(off)) / 0.6745)].tolist()
    return found


def without_drift(frames: Sequence[IndentationSample], drift: ImageDrift | None) -> list[IndentationSample]:
    """The frames with what the picture drifted taken off their deformations."""
    if drift is None:
        return list(frames)
    return [
        msgspec.structs.replace(frame, deformation_um=frame.deformation_um - drift.um_at(frame.t_ns))
        for frame in frames
    ]


def record_of(frames: Sequence[IndentationSample]) -> IndentationRecord:
    """Frames as arrays; their noise is the median of what they state, NaN where they state none."""
    start_ns = frames[0].t_ns if frames else 0
    deformation = np.array([frame.deformation_um for frame in frames])
    force = np.array([frame.force_uN for frame in frames])
    lost = ~np.isfinite(deformation + force)
    saturated = np.array([SATURATED in frame.flags for frame in frames], dtype=bool) & ~lost
    return IndentationRecord(
        time_s=np.array([(frame.t_ns - start_ns) / NS_PER_S for frame in frames]),
        deformation_um=deformation,
        force_uN=force,
        deformation_sigma_um=_median([frame.deformation_sigma_um for frame in frames]),
        force_sigma_uN=_median([frame.force_sigma_uN for frame in frames]),
        lost=lost if lost.any() else None,
        saturated=saturated if saturated.any() else None,
    )


def _median(values: Sequence[float]) -> float:
    known = [value for value in values if value > 0.0]
    return float(np.median(known)) if known else float("nan")
