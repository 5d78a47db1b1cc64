"""What should be known of a record besides what follows from it, in sentences."""

from __future__ import annotations

import numpy as np

from microdrivers.estimators.force.outliers import named_outliers
from microdrivers.estimators.force.plausibility import doubts
from microdrivers.estimators.force.prepared import Prepared
from microdrivers.estimators.force.record import CLEAR, IndentationRecord

_SHARE_OF_FORCE = 0.01
"""What a force out of contact must be of the largest to be worth a word."""

_FEWEST_PULLED = 3
"""Samples of a clearly negative force that are no outliers."""


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
    zero_uN = float(np.mean(prepared.baseline_uN))
    least_uN = max(CLEAR * prepared.force_sigma_uN, _SHARE_OF_FORCE * float(np.max(prepared.force_uN)))
    if abs(zero_uN) > least_uN:
        notes.append(f"the force is {zero_uN:.3g} µN out of contact: the sensor's zero, which is taken off everywhere")
    pulled = prepared.force_uN[prepared.used]
    if np.sum(pulled < -CLEAR * prepared.force_sigma_uN) >= _FEWEST_PULLED:
        notes.append(f"adhesion: the specimen pulls with up to {-pulled.min():.3g} µN, which the model does not have")
    if prepared.contact.seen == "nothing":
        notes.append(
            "the record begins in contact, or noise hides the onset; "
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
        notes.append(f"{why}: only the loading is fitted")
    elif not both_ways:
        notes.append("the tip left the specimen soon after it turned back: only the loading is fitted")
    elif parts.release_s is None:
        notes.append("the record ends in contact")
    return notes
