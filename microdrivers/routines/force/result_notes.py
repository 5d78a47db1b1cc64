"""What a reader of a characterisation's result must know besides its numbers."""

from __future__ import annotations

import numpy as np

from microdrivers.estimators.force.protocol_fit import ProtocolFit
from microdrivers.results.force import VisionCheck
from microdrivers.routines.force.characterisation import ForceRun
from microdrivers.routines.force.touch_checks import surface_ahead_um

TARED_IN_CONTACT = "the probe still pressed when it had gone back, and the sensor's zero was taken there"

_SURFACE_UM = 3.0
"""Farther than this from where the approach felt a contact, the surface lies elsewhere."""

_SHORT_SHARE = 0.1
"""Of the depth asked for: if more is missing, it is said."""


def began_in_contact(run: ForceRun) -> bool:
    """Whether the probe of a rig still pressed when it had gone back from the touch."""
    return run.setup.touch_uN is not None and run.identification.contact.seen == "nothing"


def notes_of(run: ForceRun, check: VisionCheck | None) -> list[str]:
    """One or two sentences each.

    Args:
        run: a whole one, or what there is of it.
        check: what the camera's force was worth in the fresh indentation; None if there was none, or it told nothing.
    """
    notes = [f"{note[0].upper()}{note[1:]}." for note in run.identification.notes]
    protocols = run.identification.protocols
    best = protocols[run.identification.best]
    beyond = [
        f"{name} ({fit.noise_residual_ratio:.3g} × noise)"
        for name, fit in protocols.items()
        if fit.misfit.found and not all(fit.identifiable[key] for key in ("k1", "k2", "b"))
    ]
    if beyond:
        notes.append(
            f"The model does not explain the record as fitted by {', '.join(beyond)}: do not quote its numbers."
        )
    ahead_um = surface_ahead_um(run.first.deformations) if run.setup.touch_uN is not None else None
    if began_in_contact(run):
        notes.append(
            f"Nothing is determined: {TARED_IN_CONTACT}. A faster approach, or a sensor with less noise, feels the "
            "specimen earlier."
        )
    elif ahead_um is not None and abs(ahead_um) > _SURFACE_UM:
        notes.append(
            f"The camera shows the surface {abs(ahead_um):.3g} µm {'beyond' if ahead_um > 0.0 else 'before'} where the "
            "approach felt a contact: the specimen was pressed less or more deeply than asked for by as much."
        )
    notes += _short_of_depth(run, best)
    if run.setup.camera is not None and run.first.drift is None and not run.first.ended:
        notes.append(
            "How far the picture drifted is not known, as the record ends before the probe was away again: it was not "
            "taken off, and the intervals do not contain it."
        )
    if not run.setup.guarded:
        notes.append("No force guard watched over the indentation: the rig file's safety section states none.")
    if not run.complete:
        notes.append(f"The run ended early: {run.ended_by}. The result holds what had been measured until then.")
    notes += run.past_run.notes()
    lost = run.first.unmatched.get("LOST", 0)
    if lost:
        notes.append(f"The contact point was not seen in {lost} frames.")
    if check is not None and check.outside_range:
        notes.append(
            f"{check.outside_range} of {check.samples} frames of the fresh indentation lie outside the range in which "
            f"the model was identified{_within_range(check)}."
        )
    if check is None and run.check is not None:
        began = run.check.began
        notes.append(
            f"The check indentation {'ended before the probe had pressed noticeably' if began else 'had not begun'}; "
            "camera-based force could not be assessed."
        )
    if check is not None and check.left_over_uN is not None:
        notes.append(
            f"The camera still indicated up to {check.left_over_uN:.3g} µN after contact was lost in the check "
            "indentation; the surface now lies deeper than the model assumes. Such frames are flagged MAY_BE_RELEASED."
        )
    if best.misfit.found:
        notes.append(
            "The model does not explain this specimen within the noise: use its parameters with care, and its force "
            "from the camera only near the conditions of this record."
        )
    return notes


def _short_of_depth(run: ForceRun, best: ProtocolFit) -> list[str]:
    """Why the specimen was not pressed as deeply as asked for."""
    asked_um, limit_uN = run.setup.depth_um, run.first.turned_at_uN
    pressed_um = float(np.nanmax(run.record.deformation_um)) - best.contact_um
    if asked_um is None or not run.first.ended:
        return []
    if limit_uN is not None:
        return [
            f"The probe turned back at {limit_uN:.4g} µN, the largest force that it may press with, after "
            f"{pressed_um:.3g} of {asked_um:g} µm."
        ]
    if pressed_um < asked_um - max(_SURFACE_UM, _SHORT_SHARE * asked_um):
        return [
            f"The probe went on by {asked_um:g} µm beyond the contact that it had felt, and the specimen was pressed "
            f"by {pressed_um:.3g} µm: the sensor's spring gave way, or the contact was felt before the surface moved."
        ]
    return []


def _within_range(check: VisionCheck) -> str:
    error_percent = check.error_within_range_percent
    return "" if error_percent is None else f"; in the others its force is within {error_percent:.2g} % RMS"
