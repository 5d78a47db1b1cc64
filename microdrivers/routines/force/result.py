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
from microdrivers.routines.force.result_notes import TARED_IN_CONTACT, began_in_contact, notes_of
from microdrivers.routines.force.sensor_lag import beyond_intervals, lag_biases, lag_s
from microdrivers.routines.force.source import IndentationSetup
from microdrivers.routines.force.touch_checks import slip_used_up_um

Array = npt.NDArray[np.float64]

_FEWEST_IN_CONTACT = 10
_CAME_BACK = 0.5
"""Of the deepest: an indentation that ends above it had no reversal yet, as far as is known."""

_USED_UP = 0.03
"""Of a slip: more than this, used up by the approach, and what is found is not the specimen's own."""

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
        notes=notes_of(run, check),
        provenance=provenance,
    )


def _trusted(run: ForceRun) -> Mapping[ProtocolName, ProtocolFit]:
    """The protocols, with what the arrangement does not let them determine.

    Nothing, if the press began in contact, for the sensor was tared there; otherwise what a slow sensor shifts.
    """

    def doubts(fit: ProtocolFit) -> dict[str, str]:
        if began_in_contact(run):
            return dict.fromkeys(fit.identifiable, TARED_IN_CONTACT)
        return _shifted_by_lag(fit, run.setup)

    return {name: fit.with_weak(doubts(fit)) for name, fit in run.identification.protocols.items()}


def _shifted_by_lag(fit: ProtocolFit, setup: IndentationSetup) -> dict[str, str]:
    if setup.bandwidth_hz is None or setup.speed_um_s is None or not fit.deepest_um > 0.0:
        return {}
    late_s = lag_s(setup.bandwidth_hz)
    biases = lag_biases(fit, late_s, speed_um_s=setup.speed_um_s)
    shifted = beyond_intervals(biases, _covariance(fit, _relative_scale_sigma(setup)))
    if not shifted:
        return {}
    by_how_much = ", ".join(f"{name} by about {bias:+.2g}" for name, bias in shifted.items())
    why = (
        f"with its bandwidth of {setup.bandwidth_hz:g} Hz the sensor is {1e3 * late_s:.2g} ms late, which shifts "
        f"{by_how_much}, beyond what the intervals hold"
    )
    return dict.fromkeys(biases, why)


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
    """What a result tells of a fit."""
    covariance = _covariance(fit, scale_sigma)
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


def _covariance(fit: ProtocolFit, scale_sigma: float) -> Array:
    """With what the scale's own uncertainty adds: a length wrong by a share of itself is so in every sample."""
    slopes = scale_sigma * np.array([fit.k1_uN_per_um, 3.0 * fit.k2_uN_per_um3, fit.b_loading_uN_s_per_um])
    covariance: Array = fit.covariance + np.outer(slopes, slopes)
    return covariance


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
        limit = speed_limit(best.model(), max_force_uN=force_uN, depth_um=best.deepest_um)
        return None if limit.limited_by == "static_force" else _known(limit.speed_um_s)
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
