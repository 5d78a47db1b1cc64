"""Turns a characterisation into its result."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from microdrivers.core.contact_samples import IndentationSample, VisionForceSample
from microdrivers.core.errors import MicrodriversError
from microdrivers.core.protocol_names import ProtocolName
from microdrivers.core.units import NS_PER_S
from microdrivers.devices.force_sensor import SATURATED
from microdrivers.estimators.force.motion_limit import speed_limit
from microdrivers.estimators.force.protocol_fit import ProtocolFit
from microdrivers.estimators.force.record import IndentationRecord, saturated
from microdrivers.estimators.force.vision_force import MAY_BE_RELEASED, OUTSIDE_RANGE
from microdrivers.results.force import (
    Contact,
    ForceResult,
    ForceTraces,
    Identifiable,
    Misfit,
    ProtocolResult,
    Setup,
    SlipFit,
    VisionCheck,
)
from microdrivers.results.record import Provenance, Trace
from microdrivers.routines.force.characterisation import ForceRun, Indentation
from microdrivers.routines.force.frames import TOUCHES_UN
from microdrivers.routines.force.source import IndentationSetup
from microdrivers.routines.force.touch_checks import slip_used_up_um, surface_ahead_um

Array = npt.NDArray[np.float64]

_FEWEST_IN_CONTACT = 10
_CAME_BACK = 0.5
"""Of the deepest: an indentation that ends above it had no reversal yet, as far as is known."""

_USED_UP = 0.03
"""Of a slip: more than this, used up by the approach, and what is found is not the specimen's own."""

_SURFACE_UM = 3.0
"""Farther than this from where the approach felt a contact, the surface lies elsewhere."""

_TARED_IN_CONTACT = "the probe still pressed when it had gone back, and the sensor's zero was taken there"

_LEFT = 0.5
"""Of the camera's force: what the sensor feels less than, of a specimen that has been let go."""


def build_result(run: ForceRun, provenance: Provenance) -> ForceResult:
    """All that was found, with what it is valid for."""
    found = run.identification
    protocols = _trusted(run)
    best = protocols[found.best]
    check = compare(run.check) if run.check is not None else None
    borne_uN = run.record.force_uN - found.baseline_uN
    largest_uN = float(np.nanmax(np.where(saturated(run.record), np.nan, borne_uN)))
    return ForceResult(
        complete=run.complete,
        contact=Contact(
            time_s=best.contact_time_s,
            deformation_um=best.contact_um,
            deformation_sigma_um=_known(best.sigma_contact_um),
        ),
        protocols={name: _protocol(fit, _relative_scale_sigma(run.setup)) for name, fit in protocols.items()},
        best=found.best,
        slip=_slip(run),
        misfit=Misfit(
            found=best.misfit.found,
            found_by=best.misfit.found_by,
            statistic=_known(best.misfit.statistic),
            p_value=_known(best.misfit.p_value),
            text=best.misfit.text,
        ),
        vision_force_error_percent=None if check is None else check.error_percent,
        vision_check=check,
        largest_speed_um_s=_speed_limit(best, largest_uN),
        excluded_samples=_excluded(run),
        deformation_sigma_um=found.deformation_sigma_um,
        force_sigma_uN=found.force_sigma_uN,
        setup=_setup(run, best, largest_uN),
        traces=_traces(run),
        notes=_notes(run, check),
        provenance=provenance,
    )


def _trusted(run: ForceRun) -> Mapping[ProtocolName, ProtocolFit]:
    """The protocols; nothing is determined by a press that began in contact, for the sensor was tared there."""
    protocols = run.identification.protocols
    if not _began_in_contact(run):
        return protocols
    return {name: fit.with_weak(dict.fromkeys(fit.identifiable, _TARED_IN_CONTACT)) for name, fit in protocols.items()}


def _began_in_contact(run: ForceRun) -> bool:
    """Whether the probe of a rig still pressed when it had gone back from the touch."""
    return run.setup.touch_uN is not None and run.identification.contact.seen == "nothing"


def compare(check: Indentation) -> VisionCheck | None:
    """The camera's force against the sensor's, frame by frame; None if hardly a common frame saw contact."""
    pairs = _pairs(check)
    if not pairs:
        return None
    measured = np.array([sample.force_uN for sample, _ in pairs])
    seen = np.array([force.force_uN for _, force in pairs])
    off = np.abs(seen - measured)
    error_percent = _error_percent(off, measured)
    if error_percent is None:
        return None
    outside = np.array([OUTSIDE_RANGE in force.flags for _, force in pairs])
    since_s = [(sample.t_ns - pairs[0][0].t_ns) / NS_PER_S for sample, _ in pairs]
    pressed_um = [sample.deformation_um for sample, _ in pairs]
    return VisionCheck(
        error_percent=error_percent,
        largest_error_uN=float(np.max(off)),
        largest_error_s=since_s[int(np.argmax(off))],
        deepest_s=since_s[int(np.argmax(pressed_um))] if pressed_um[-1] < _CAME_BACK * max(pressed_um) else None,
        samples=len(pairs),
        outside_range=int(np.sum(outside)),
        left_over_uN=max(
            (
                force.force_uN
                for sample, force in pairs
                if MAY_BE_RELEASED in force.flags and sample.force_uN < _LEFT * force.force_uN
            ),
            default=None,
        ),
        error_within_range_percent=_error_percent(off[~outside], measured[~outside]) if outside.any() else None,
    )


def _error_percent(off_uN: Array, measured_uN: Array) -> float | None:
    """RMS of what is off, of the RMS of the force; None where hardly any frame felt a force."""
    if np.sum(np.abs(measured_uN) > TOUCHES_UN) < _FEWEST_IN_CONTACT:
        return None
    return 100.0 * float(np.sqrt(np.mean(off_uN**2)) / np.sqrt(np.mean(measured_uN**2)))


def _pairs(check: Indentation) -> list[tuple[IndentationSample, VisionForceSample]]:
    forces = {force.t_ns: force for force in check.forces if math.isfinite(force.force_uN)}
    return [(sample, forces[sample.t_ns]) for sample in check.samples if sample.t_ns in forces]


def _protocol(fit: ProtocolFit, scale_sigma: float) -> ProtocolResult:
    """With what the scale's own uncertainty adds: a length wrong by a share of itself is so in every sample."""
    slopes = scale_sigma * np.array([fit.k1_uN_per_um, 3.0 * fit.k2_uN_per_um3, fit.b_loading_uN_s_per_um])
    covariance = fit.covariance + np.outer(slopes, slopes)
    known = bool(np.isfinite(covariance).all())
    sigmas = np.sqrt(np.diag(covariance).clip(min=0.0))
    return ProtocolResult(
        k1_uN_per_um=fit.k1_uN_per_um,
        k1_sigma_uN_per_um=_known(sigmas[0]),
        k2_uN_per_um3=fit.k2_uN_per_um3,
        k2_sigma_uN_per_um3=_known(sigmas[1]),
        b_uN_s_per_um=fit.b_loading_uN_s_per_um,
        b_sigma_uN_s_per_um=_known(sigmas[2]),
        b_unloading_uN_s_per_um=fit.b_unloading_uN_s_per_um,
        m_kg=fit.m_kg,
        covariance=covariance.tolist() if known else None,
        error_percent=fit.error_percent,
        noise_residual_ratio=_known(fit.noise_residual_ratio),
        condition_number=_known(fit.condition_number),
        residual_uN=_known(fit.residual_uN),
        identifiable=Identifiable(
            **{name: fit.identifiable.get(name, False) for name in ("k1", "k2", "b", "m")}, reasons=dict(fit.weak)
        ),
    )


def _relative_scale_sigma(setup: IndentationSetup) -> float:
    """Relative standard deviation of all lengths; 0 where a recording states them."""
    scale, sigma = setup.scale_px_per_um, setup.scale_sigma_px_per_um
    return sigma / scale if scale and sigma else 0.0


def _slip(run: ForceRun) -> SlipFit | None:
    """The offset is as uncertain as the picture's scale and drift, too."""
    found, drift = run.identification, run.first.drift
    slip = found.slip
    if slip is None:
        return None
    drifted_um = 0.0 if drift is None else drift.sigma_um_s * found.contact_duration_s
    scaled_um = _relative_scale_sigma(run.setup) * slip.offset_um
    used_up = "" if slip.reason else _used_up(run)
    return SlipFit(
        offset_um=slip.offset_um,
        offset_sigma_um=_known(math.hypot(slip.sigma_offset_um, drifted_um, scaled_um)),
        rate_per_s=slip.rate_per_s,
        rate_sigma_per_s=_known(slip.sigma_rate_per_s),
        not_returned_um=slip.not_returned_um,
        identifiable=slip.identifiable and not used_up,
        reason=slip.reason or used_up,
    )


def _used_up(run: ForceRun) -> str:
    """Why the slip that was found is only what the approach has left of it; empty if it is not, or nothing is known."""
    setup, fit = run.setup, run.identification.protocols.get("slip_corrected")
    if fit is None or setup.speed_um_s is None or setup.touch_uN is None or setup.touched_s is None:
        return ""
    model = fit.model()
    used_um = slip_used_up_um(model, speed_um_s=setup.speed_um_s, touch_uN=setup.touch_uN, touched_s=setup.touched_s)
    if used_um <= _USED_UP * model.slip_um:
        return ""
    how_much = f"{used_um:.2g} µm" if math.isfinite(used_um) else "any part"
    return (
        f"the approach at {setup.speed_um_s:g} µm/s may have used up {how_much} of it, and this is what was left: "
        "press a fresh specimen several times as fast"
    )


def _speed_limit(best: ProtocolFit, force_uN: float) -> float | None:
    """What keeps the predicted force below the largest measured, down to the deepest point, if the model holds."""
    if not (best.identifiable["k1"] and best.identifiable["b"]):
        return None
    try:
        return _known(speed_limit(best.model(), max_force_uN=force_uN, depth_um=best.deepest_um).speed_um_s)
    except MicrodriversError:  # the model says nothing about speeds here
        return None


def _excluded(run: ForceRun) -> dict[str, int]:
    excluded = {reason: len(where) for reason, where in run.identification.excluded_samples.items() if len(where)}
    excluded.pop("not measured", None)  # told by each frame's own reason
    for reason, count in run.first.unmatched.items():
        if reason != SATURATED:
            excluded[f"frames_{reason.lower()}"] = count
    return excluded


def _setup(run: ForceRun, best: ProtocolFit, largest_uN: float) -> Setup:
    known, drift = run.setup, run.first.drift
    branches = run.identification.branches
    in_um_s = _mean_speed_um_s(run.record, branches.loading) or best.fastest_um_s
    both_ways = "single" in run.identification.protocols
    out_um_s = _mean_speed_um_s(run.record, branches.unloading) if both_ways else None
    return Setup(
        sensor=known.sensor,
        stage=known.stage,
        camera=known.camera,
        scale_source=known.scale_source,
        scale_px_per_um=known.scale_px_per_um,
        scale_sigma_px_per_um=known.scale_sigma_px_per_um,
        zoom=known.zoom,
        speed_um_s=in_um_s if known.speed_um_s is None else known.speed_um_s,
        deepest_um=best.deepest_um,
        largest_force_uN=largest_uN,
        tare_uN=known.tare_uN,
        image_drift_um_s=None if drift is None else drift.rate_um_s,
        image_drift_sigma_um_s=None if drift is None else drift.sigma_um_s,
        unloading_speed_um_s=out_um_s if known.speed_um_s is None or out_um_s is None else known.speed_um_s,
        pressed_um=float(np.nanmax(run.record.deformation_um)) - best.contact_um,
        fastest_um_s=best.fastest_um_s,
        fastest_unloading_um_s=best.fastest_unloading_um_s or None,
    )


def _mean_speed_um_s(record: IndentationRecord, branch: range) -> float | None:
    """Of the contact point over a branch; None if it was hardly seen there."""
    seen = np.arange(branch.start, branch.stop)
    seen = seen[np.isfinite(record.deformation_um[seen])]
    if len(seen) < 2:
        return None
    first, last = seen[0], seen[-1]
    way_um = record.deformation_um[last] - record.deformation_um[first]
    return abs(float(way_um / (record.time_s[last] - record.time_s[first])))


def _traces(run: ForceRun) -> ForceTraces:
    record, found = run.record, run.identification
    pairs = _pairs(run.check) if run.check is not None else []
    start_ns = pairs[0][0].t_ns if pairs else 0
    return ForceTraces(
        time_s=record.time_s.tolist(),
        deformation_um=_trace(record.deformation_um),
        force_uN=_trace(record.force_uN),
        branch=found.branches.labels(),
        fitted_uN={name: _trace(fit.force_uN) for name, fit in found.protocols.items()},
        check_time_s=[(sample.t_ns - start_ns) / NS_PER_S for sample, _ in pairs],
        check_force_uN=[sample.force_uN for sample, _ in pairs],
        check_vision_uN=_trace([force.force_uN for _, force in pairs]),
    )


def _trace(values: Sequence[float] | Array) -> Trace:
    return [float(value) if math.isfinite(value) else None for value in values]


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _within_range(check: VisionCheck) -> str:
    error_percent = check.error_within_range_percent
    return "" if error_percent is None else f"; in the others its force is within {error_percent:.2g} % RMS"


def _notes(run: ForceRun, check: VisionCheck | None) -> list[str]:
    notes = [f"{note[0].upper()}{note[1:]}." for note in run.identification.notes]
    protocols = run.identification.protocols
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
    if _began_in_contact(run):
        notes.append(
            f"Nothing is determined: {_TARED_IN_CONTACT}. A faster approach, or a sensor with less noise, feels the "
            "specimen earlier."
        )
    elif ahead_um is not None and abs(ahead_um) > _SURFACE_UM:
        notes.append(
            f"The camera shows the surface {abs(ahead_um):.3g} µm {'beyond' if ahead_um > 0.0 else 'before'} where the "
            "approach felt a contact: the specimen was pressed less or more deeply than asked for by as much."
        )
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
    best = protocols[run.identification.best]
    if best.misfit.found:
        notes.append(
            "The model does not explain this specimen within the noise: use its parameters with care, and its force "
            "from the camera only near the conditions of this record."
        )
    return notes
