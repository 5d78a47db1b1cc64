"""What should be known of a record besides what follows from it, in sentences."""

from __future__ import annotations

import numpy as np

from microdrivers.estimators.force.drift import Baseline
from microdrivers.estimators.force.model import Array
from microdrivers.estimators.force.outliers import named_outliers
from microdrivers.estimators.force.plausibility import doubts
from microdrivers.estimators.force.prepared import Prepared
from microdrivers.estimators.force.record import CLEAR, IndentationRecord

_SHARE_OF_FORCE = 0.01
"""What a force out of contact must be of the largest to be worth a word."""

_FEWEST_PULLED = 3
"""Samples of a clearly negative force that are no outliers."""

_LOADING_ALONE = "only the loading is fitted, which does not show whether the specimen slips"

_SHORT_S, _FEW = 2.5, 10
"""Duration and samples of a branch below which a fifth of it, the most that is left out of it where the speed changes,
is less than the usual half second, or two samples, next to a reversal."""


def notes_on(record: IndentationRecord, prepared: Prepared, *, both_ways: bool) -> list[str]:
    """What should be known of a record.

    Args:
        record: as recorded.
        prepared: as used.
        both_ways: the way back was fitted, too.
    """
    notes = [*doubts(prepared), *named_outliers(prepared)]
    for what, stated, used, unit in (
        ("deformation", record.deformation_sigma_um, prepared.deformation_sigma_um, "µm"),
        ("force", record.force_sigma_uN, prepared.force_sigma_uN, "µN"),
    ):
        if stated > 0.0 and used > stated:
            notes.append(f"the noise of the {what} is {used:.3g} {unit} as observed, {stated:.3g} {unit} as stated")
    least_uN = max(CLEAR * prepared.force_sigma_uN, _SHARE_OF_FORCE * float(np.max(prepared.force_uN)))
    notes += _zero(prepared.baseline, prepared.time_s, least_uN)
    pulled = prepared.force_uN[prepared.used]
    if np.sum(pulled < -CLEAR * prepared.force_sigma_uN) >= _FEWEST_PULLED:
        notes.append(f"adhesion: the specimen pulls with up to {-pulled.min():.3g} µN, which the model does not have")
    if prepared.contact.seen == "nothing":
        notes.append(
            "the record begins in contact, or noise or too few samples before it hide the onset; "
            "the record's own zero is taken as the contact point"
        )
    full = len(prepared.excluded.get("saturated", ()))
    if full:
        notes.append(f"the sensor was at the end of its range in {full} samples, which are left out")
    parts = prepared.branches
    if parts.release_s is not None and parts.turns_s and parts.release_s[1] < parts.turns_s[0]:
        notes.append(f"contact was lost at {parts.released_s:.2f} s, while the deformation still grew")
    if not len(parts.unloading):
        why = "the record has no unloading"
        if parts.release_s is not None:
            why = "no force above its noise was left once the tip had turned"
        notes.append(f"{why}: {_LOADING_ALONE}")
    elif not both_ways:
        notes.append(f"the tip left the specimen soon after it turned back: {_LOADING_ALONE}")
    elif parts.release_s is None:
        notes.append("the record ends in contact")
    return notes


def _zero(baseline: Baseline | None, time_s: Array, least_uN: float) -> list[str]:
    """What was taken off the force, if it ever was that much."""
    if baseline is None:
        return []
    if baseline.stepped_uN:
        return [
            f"the force out of contact is {baseline.level_uN:.3g} µN before the press and "
            f"{baseline.level_uN + baseline.stepped_uN:.3g} µN after it, each steady: the sensor's zero has stepped, "
            "or something sticks to the tip. The former is taken off; do not use the way back"
        ]
    first_uN, last_uN = baseline.at(time_s[[0, -1]])
    if max(abs(first_uN), abs(last_uN)) < least_uN:
        return []
    if baseline.slope_uN_s == 0.0:
        return [f"the force is {first_uN:.3g} µN out of contact: the sensor's zero, which is taken off everywhere"]
    return [
        f"the force out of contact drifts by {baseline.slope_uN_s:+.3g} µN/s, from {first_uN:.3g} µN at the beginning "
        f"of the record to {last_uN:.3g} µN at its end: this straight line is taken off everywhere"
    ]


def on_a_misfit(prepared: Prepared) -> list[str]:
    """Whether the reason that the model does not explain a record may be how short its branches are, in a sentence."""
    parts = (("loading", prepared.branches.loading), ("unloading", prepared.branches.unloading))
    lasts = [(name, len(part), len(part) * prepared.frame_s) for name, part in parts if len(part)]
    short = [f"the {name} {n} samples in {s:.2g} s" for name, n, s in lasts if s < _SHORT_S or n < _FEW]
    if not short:
        return []
    return [
        f"too short to leave out all samples in which the speed changes: {' and '.join(short)}; what the model does "
        "not explain may be those: press deeper or more slowly"
    ]
