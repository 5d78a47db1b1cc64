"""The calibration itself: the same for a live rig, a simulation and a recording."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from microdrivers.core.inbox import EstimatorHost, Inbox
from microdrivers.core.samples import Frame, OpticsEstimate, Sample, TrackedPoint, XYThetaSample, ZoomSample
from microdrivers.core.units import NS_PER_S
from microdrivers.estimators.optics.calibrator import CalibratorSettings, OpticsCalibrator, PointTracker
from microdrivers.results.optics import (
    OpticsResult,
    Tilt,
    Traces,
    Truth,
    ValidFor,
    ZoomChange,
    iterations_to_settle,
)
from microdrivers.results.record import Provenance, Trace
from microdrivers.routines.notes import note, noted_ending
from microdrivers.routines.optics.choice import Choice, begins_change, choose_estimate
from microdrivers.routines.optics.source import DONE, HOST, SETTINGS, Optics, OpticsSource
from microdrivers.routines.past_run import PastRun
from microdrivers.routines.progress import Progress, SilentProgress


class OpticsRun(NamedTuple):
    """What a run left behind.

    Attributes:
        complete: False if it was interrupted.
        estimates: one a matched frame.
        waiting_frames: of a run that ended as planned, the last ones, after which no pose or no zoom reading came.
        arrivals: bus-wide order numbers in the order in which the estimator saw the samples.
        recorded: those samples, if asked for.
        past_run: what a recording tells of its run.
        last_zoom: the newest reading, which no frame need have been used with; of a run that ended as planned, and
            whose recording does not lack the last frames, with the last frame that was taken. None without any.
    """

    complete: bool
    estimates: list[OpticsEstimate]
    lost_frames: int
    unmatched_frames: int
    waiting_frames: int
    settings: CalibratorSettings
    optics: Optics
    arrivals: list[int]
    recorded: list[Sample]
    past_run: PastRun
    last_zoom: float | None = None


def calibrate_optics(
    source: OpticsSource,
    *,
    settings: CalibratorSettings | None = None,
    progress: Progress | None = None,
    keep_samples: bool = False,
    on_host: Callable[[str, Inbox], object] = lambda _name, _inbox: None,
) -> OpticsRun:
    """Let a source publish and estimate P from what it publishes, on line.

    Args:
        source: what to calibrate with.
        settings: of the estimator; None: those of the recorded run, or the usual ones.
        progress: where to report.
        keep_samples: keep what the estimator got in `recorded`.
        on_host: is told the estimator's inbox once it is there, for who records the order of arrival.

    An interruption (Ctrl-C) ends the source, which stops what moves, and keeps what was measured.

    Raises:
        MicrodriversError: whatever the source raises.
    """
    settings = settings or source.past_settings or CalibratorSettings()
    bus, names = source.bus, source.names
    stage, zoom = bus.topic(names.stage, XYThetaSample), bus.topic(names.zoom, ZoomSample)
    track = bus.topic(f"{names.camera}/track", TrackedPoint)
    estimated = bus.topic("estimate/optics", OpticsEstimate)
    estimates: list[OpticsEstimate] = []
    subscription = estimated.subscribe(estimates.append)
    hosts: list[EstimatorHost] = []
    calibrators: list[OpticsCalibrator] = []
    newest_zoom: ZoomSample | None = None

    def publish(result: Sample) -> None:
        nonlocal newest_zoom
        if isinstance(result, OpticsEstimate):
            estimated.publish(result)
        elif isinstance(result, TrackedPoint):
            newest_zoom = zoom.latest
            track.publish(result)

    def begin(tracker: PointTracker) -> None:
        calibrators.append(OpticsCalibrator(tracker, settings, frames=source.frames_expected()))
        # The first frame was exposed before now: it needs the poses and zoom readings from before.
        history = sorted((*stage.history, *zoom.history), key=lambda sample: sample.order)
        hosts.append(
            EstimatorHost(
                source.clock,
                calibrators[-1],
                (stage, zoom, bus.topic(names.camera, Frame)),
                publish,
                history=history,
                keep_samples=keep_samples,
            )
        )
        on_host(HOST, hosts[-1].inbox)

    def finish() -> None:
        for host in hosts:
            host.close()
        subscription.cancel()

    note(bus, source.clock, SETTINGS, settings._asdict())
    with noted_ending(bus, source.clock, DONE, finish=finish) as ending:
        source.run(begin, progress or SilentProgress())
    ended_by = ending.ended_by
    if ended_by or source.past_run.lost_last:
        newest_zoom = zoom.latest
    return OpticsRun(
        complete=not ended_by,
        estimates=estimates,
        lost_frames=sum(calibrator.lost_frames for calibrator in calibrators),
        unmatched_frames=sum(calibrator.unmatched_frames for calibrator in calibrators),
        waiting_frames=0 if ended_by else sum(calibrator.waiting_frames for calibrator in calibrators),
        settings=settings,
        optics=source.optics(),
        arrivals=[order for host in hosts for order in host.inbox.arrivals],
        recorded=[sample for host in hosts for sample in host.recorded],
        past_run=source.past_run,
        last_zoom=None if newest_zoom is None else newest_zoom.zoom,
    )


def build_result(run: OpticsRun, provenance: Provenance, truth: Truth | None = None) -> OpticsResult:
    """Turn a run into its result.

    Raises:
        IllConditioned: the run does not determine a calibration; the message says what was missing.
    """
    lost_frames = run.lost_frames + run.past_run.lost_frames
    unmatched_frames = run.unmatched_frames + run.waiting_frames
    choice = choose_estimate(
        run.estimates,
        pixel_pitch_um=run.optics.pixel_pitch_um,
        lost_frames=lost_frames,
        unmatched_frames=unmatched_frames,
    )
    final, parameters = choice.estimate, choice.parameters
    outdated = choice.frames_since_change > 0 or _changed_unseen(run)
    p = final.projection
    pitch_um = run.optics.pixel_pitch_um
    scales = _trace([e.scale_px_per_um for e in run.estimates])
    return OpticsResult(
        complete=run.complete and not (run.past_run.ended_by or run.waiting_frames or outdated),
        projection=(p[:3], p[3:]),
        scale_px_per_um=parameters.scale_px_per_um,
        scale_sigma_px_per_um=parameters.sigma_scale_px_per_um or 0.0,
        zoom=final.zoom,
        magnification=parameters.magnification,
        angle_deg=parameters.angle_deg,
        angle_sigma_deg=parameters.sigma_angle_deg or 0.0,
        tilt=Tilt(
            interval_deg=parameters.tilt_deg_interval,
            label=parameters.tilt_label,
            sign_ambiguous=parameters.tilt_sign_ambiguous,
        ),
        view=parameters.view,
        translation_um=parameters.translation_um,
        covariance=np.array(final.covariance).reshape(6, 6).tolist(),
        degrees_of_freedom=final.degrees_of_freedom,
        prediction_error_px=_trace([e.prediction_error_px for e in run.estimates]),
        posterior_error_px=_trace([e.posterior_error_px for e in run.estimates]),
        magnification_trace=[None if s is None or pitch_um is None else s * pitch_um for s in scales],
        zoom_change=None if outdated else zoom_change(run.estimates),
        frames=len(run.estimates),
        lost_frames=lost_frames,
        unmatched_frames=unmatched_frames,
        valid_for=ValidFor(
            camera=run.optics.camera,
            binning=run.optics.binning,
            roi=run.optics.roi,
            objective=run.optics.objective,
            zoom=final.zoom,
        ),
        traces=_traces(run.estimates, scales),
        notes=_notes(run, choice),
        provenance=provenance,
        truth=truth,
    )


def zoom_change(estimates: Sequence[OpticsEstimate]) -> ZoomChange | None:
    """How the last zoom change of a run settled; None if the zoom rested throughout.

    Where the zoom moved between two frames, no frame was exposed meanwhile: the first frame is the one after.
    """
    first = max((i for i in range(1, len(estimates)) if begins_change(estimates[i - 1], estimates[i])), default=None)
    if first is None:
        return None
    last = first - 1
    while last + 1 < len(estimates) and estimates[last + 1].zoom_moving:
        last += 1
    prior = _trace([estimate.prediction_error_px for estimate in estimates])
    posterior = _trace([estimate.posterior_error_px for estimate in estimates])
    return ZoomChange(
        first_frame=first,
        last_moving_frame=last,
        zoom_before=estimates[max(first - 1, 0)].zoom,
        zoom_after=estimates[-1].zoom,
        iterations_to_0p1_px=iterations_to_settle(prior, first_frame=first),
        iterations_to_0p1_px_from_end=iterations_to_settle(prior, first_frame=last + 1),
        posterior_iterations_to_0p1_px=iterations_to_settle(posterior, first_frame=first),
        posterior_iterations_to_0p1_px_from_end=iterations_to_settle(posterior, first_frame=last + 1),
    )


def _trace(values: Sequence[float]) -> Trace:
    return [value if math.isfinite(value) else None for value in values]


def _traces(estimates: Sequence[OpticsEstimate], scales: Trace) -> Traces:
    start_ns = estimates[0].t_ns
    return Traces(
        frame=[e.frame_index for e in estimates],
        time_s=[(e.t_ns - start_ns) / NS_PER_S for e in estimates],
        x_um=[e.x_um for e in estimates],
        y_um=[e.y_um for e in estimates],
        u_px=[e.u_px for e in estimates],
        v_px=[e.v_px for e in estimates],
        zoom=[e.zoom for e in estimates],
        zoom_moving=[e.zoom_moving for e in estimates],
        projection=[e.projection if math.isfinite(e.scale_px_per_um) else None for e in estimates],
        scale_px_per_um=scales,
        angle_deg=_trace([e.angle_deg for e in estimates]),
    )


def _notes(run: OpticsRun, choice: Choice) -> list[str]:
    notes = []
    since = choice.frames_since_change
    if since:
        notes.append(
            f"The run ended {_frames(since)} after the zoom began to change, too few for the new zoom "
            f"({choice.why_not_newer}): this is the calibration at zoom {choice.estimate.zoom:.4g}, and the zoom "
            f"now reads {run.estimates[-1].zoom:.4g}."
        )
    elif _changed_unseen(run):
        lost = " A target of texture is not found again once the zoom has changed." if run.lost_frames else ""
        notes.append(
            f"The zoom changed to {run.last_zoom:.4g}, where no frame could be used: this is the calibration at zoom "
            f"{choice.estimate.zoom:.4g}.{lost}"
        )
    if not run.complete:
        notes.append("The run was interrupted; the result holds what had been measured until then.")
    elif run.past_run.ended_by:
        notes.append(
            f"The recorded run is not whole: {run.past_run.ended_by}. "
            "The result holds what had been measured until then."
        )
    notes += run.past_run.notes()
    if run.lost_frames:
        notes.append(f"The target was not found in {_frames(run.lost_frames)}.")
    if run.waiting_frames:
        notes.append(
            f"No pose or no zoom reading came after the last {_frames(run.waiting_frames)} of the run, which could not "
            "be used."
        )
    if run.unmatched_frames:
        notes.append(f"{_frames(run.unmatched_frames)} had no pose close enough before and after.")
    if run.optics.pixel_pitch_um is None:
        notes.append("The pixel pitch is not known, so no magnification is given; the scale is complete without it.")
    return notes


def _changed_unseen(run: OpticsRun) -> bool:
    """Whether the zoom has left that of the last frame that could be used."""
    seen = run.estimates[-1].zoom
    return run.last_zoom is not None and abs(run.last_zoom - seen) > run.settings.zoom_still * abs(seen)


def _frames(number: int) -> str:
    return "1 frame" if number == 1 else f"{number} frames"
