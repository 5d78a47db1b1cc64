"""The analysis that a recording holds, run again: one row of figures."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from microdrivers.core.clock import utc_now
from microdrivers.core.errors import MicrodriversError, UnsupportedError
from microdrivers.recording.header import RecordingHeader
from microdrivers.recording.reader import Recording
from microdrivers.recording.replay import notes_of
from microdrivers.results.force import ForceResult
from microdrivers.results.optics import OpticsResult
from microdrivers.routines.past_run import PastRun

Row = dict[str, str | int | float | bool | None]
"""A cell for each of `COLUMNS`; None where a figure is undefined."""

COLUMNS: Mapping[str, type] = {
    "file": str, "kind": str, "error": str, "doubtful": bool,
    "complete": bool, "losses": int, "missing": int, "dropped": int, "repeated": int, "unsorted": int,
    "created_utc": str, "rig": str, "seed": int,
    "frames": int, "lost_frames": int, "unmatched_frames": int,
    "scale_px_per_um": float, "scale_sigma_px_per_um": float, "zoom": float, "magnification": float,
    "angle_deg": float, "angle_sigma_deg": float, "tilt_low_deg": float, "tilt_high_deg": float, "view": str,
    "prediction_error_px": float, "iterations_to_0p1_px": int,
    "protocol": str, "k1_uN_per_um": float, "k1_sigma_uN_per_um": float, "k2_uN_per_um3": float,
    "k2_sigma_uN_per_um3": float, "b_uN_s_per_um": float, "b_sigma_uN_s_per_um": float, "fit_error_percent": float,
    "misfit": bool, "vision_force_error_percent": float, "deepest_um": float, "largest_force_uN": float,
    "true_scale_error_percent": float, "true_angle_error_deg": float, "true_k1_error_percent": float,
    "true_k2_error_percent": float, "true_b_error_percent": float, "notes": str,
}  # fmt: skip
"""Columns of the table and what they hold.

`doubtful` marks a row with an `error` or with `doubts`: the run is not `complete`, or something of its recording is
damaged or lost (`losses`, `dropped`, `missing`), stands there twice (`repeated`) or is out of order (`unsorted`).
`missing` counts samples that the file lacks: those that the estimators had, or whose numbers are skipped. `notes` are
those of the result. `true_…` is against the truth of a simulation.
"""

_FLAWS = {
    "losses": "damaged or lost parts", "missing": "missing samples", "dropped": "dropped samples",
    "repeated": "samples that stand there twice", "unsorted": "samples out of order",
}  # fmt: skip


def analyse_recording(file: str) -> Row:
    """Run the analysis again that a recording holds: an optical calibration, or a force characterisation.

    Whatever is wrong with the file stands in the row's `error`; never raises for a bad file.
    """
    row: Row = dict.fromkeys(COLUMNS) | {"file": file}
    try:
        with _one_thread(), Recording(Path(file)) as recording:
            row |= _origin(recording.header)
            topics = recording.topics.values()
            skipped = sum(topic.gaps for topic in topics)
            row |= {"losses": len(recording.losses), "missing": skipped}
            row |= {name: sum(getattr(topic, name) for topic in topics) for name in ("dropped", "repeated", "unsorted")}
            found, past_run = _analyse(recording)
            row |= found | {"missing": max(skipped, past_run.missing)}
    except MicrodriversError as error:
        row["error"] = f"{type(error).__name__}: {str(error).splitlines()[0]}"
    except Exception as error:  # noqa: BLE001 - one bad file must not end the batch; the row tells what happened
        row["error"] = f"{type(error).__name__}: {error}".splitlines()[0]
    return row | {"doubtful": bool(row["error"] or doubts(row))}


def failed_row(file: str, error: str) -> Row:
    """The row of a recording of which nothing is known but why it was not analysed."""
    return dict.fromkeys(COLUMNS) | {"file": file, "error": error, "doubtful": True}


def doubts(row: Row) -> list[str]:
    """Why the figures of a row are not to be trusted without a second look; empty if nothing speaks against it."""
    flaws = [f"{what}: {row[name]}" for name, what in _FLAWS.items() if row[name]]
    return flaws if row["complete"] else ["not complete", *flaws]


@contextmanager
def _one_thread() -> Iterator[None]:
    """Parallel processes share the cores already; and on any machine the same code runs."""
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _origin(header: RecordingHeader) -> Row:
    return {"created_utc": header.created_utc or None, "rig": header.rig or None, "seed": header.seed}


def _analyse(recording: Recording) -> tuple[Row, PastRun]:
    # Where all notes are in what is damaged, the inbox of its estimator still tells what it was.
    names = (*(note.kind for note in notes_of(recording)), *recording.arrivals)
    kinds = {name.partition("/")[0] for name in names}
    if "optics" in kinds:
        optics, past_run = analyse_optics(recording)
        return _row_of(optics) | _optics_row(optics), past_run
    if "force" in kinds:
        force, past_run = analyse_force(recording)
        return _row_of(force) | _force_row(force), past_run
    raise UnsupportedError(
        f"{recording.file} holds no analysis that could be run again",
        remedy="give recordings of `microdrivers calibrate optics` or `calibrate force`",
    )


def _known(recording: Recording) -> dict[str, Any]:
    recorded = recording.attachments.get("provenance.json")
    known: dict[str, Any] = json.loads(recorded) if recorded is not None else {}
    return known | {"source": f"recording {recording.file}", "clock": "recorded"}


def analyse_optics(recording: Recording) -> tuple[OpticsResult, PastRun]:
    """The optical calibration of a recording, estimated anew as it was set, and what is told of its run.

    Raises:
        UnsupportedError: it holds none, or lacks what its estimator needs. IllConditioned: it determines none.
    """
    from microdrivers.report.truth import OpticsTruthCollector
    from microdrivers.routines.optics import OpticsReplay, calibrate_optics
    from microdrivers.routines.optics.calibration import build_result
    from microdrivers.routines.provenance import describe_run

    source = OpticsReplay(recording)
    truth = OpticsTruthCollector(source.bus)
    run = calibrate_optics(source)
    if not run.estimates:
        raise UnsupportedError(
            f"{recording.file} gave its estimator nothing", remedy="record the topics of stage, zoom and camera"
        )
    result = build_result(run, describe_run(_known(recording), command="analyse", now=utc_now()))
    return result.model_copy(update={"truth": truth.compare(result, run.estimates)}), run.past_run


def analyse_force(recording: Recording) -> tuple[ForceResult, PastRun]:
    """The force characterisation of a recording, identified anew as it was set, and what is told of its run.

    Raises:
        UnsupportedError: it holds none, or lacks what its estimators need. NoContact, IllConditioned and other
            DataError or CalibrationError: it shows or determines no specimen.
    """
    from microdrivers.report.force_truth import ContactTruthCollector
    from microdrivers.routines.force import Characterisation, IndentationReplay, build_result
    from microdrivers.routines.provenance import describe_run

    source = IndentationReplay(recording)
    truth = ContactTruthCollector(source.bus)
    run = Characterisation(source).run()
    result = build_result(run, describe_run(_known(recording), command="analyse", now=utc_now()))
    return result.model_copy(update={"truth": truth.compare(result, run.first.deformations)}), run.past_run


def _row_of(result: OpticsResult | ForceResult) -> Row:
    return {"kind": result.kind, "complete": result.complete, "notes": " ".join(result.notes) or None}


def _optics_row(result: OpticsResult) -> Row:
    from microdrivers.report.optics_quantities import settled_error

    settled, change, truth = settled_error(result), result.zoom_change, result.truth
    row: Row = {
        "frames": result.frames, "lost_frames": result.lost_frames,
        "unmatched_frames": result.unmatched_frames, "scale_px_per_um": result.scale_px_per_um,
        "scale_sigma_px_per_um": result.scale_sigma_px_per_um, "zoom": result.zoom,
        "magnification": result.magnification, "angle_deg": result.angle_deg,
        "angle_sigma_deg": result.angle_sigma_deg, "tilt_low_deg": result.tilt.interval_deg[0],
        "tilt_high_deg": result.tilt.interval_deg[1], "view": result.view,
        "prediction_error_px": settled.median_px if settled is not None else None,
        "iterations_to_0p1_px": change.iterations_to_0p1_px if change is not None else None,
    }  # fmt: skip
    if truth is not None:
        scale, angle = truth.errors["scale_percent"], truth.errors["angle_deg"]
        assert isinstance(scale, float)
        assert isinstance(angle, float)
        row |= {"true_scale_error_percent": scale, "true_angle_error_deg": angle}
    return row


def _force_row(result: ForceResult) -> Row:
    best = result.protocols[result.best]
    row: Row = {
        "frames": len(result.traces.time_s),
        "protocol": result.best, "k1_uN_per_um": best.k1_uN_per_um, "k1_sigma_uN_per_um": best.k1_sigma_uN_per_um,
        "k2_uN_per_um3": best.k2_uN_per_um3, "k2_sigma_uN_per_um3": best.k2_sigma_uN_per_um3,
        "b_uN_s_per_um": best.b_uN_s_per_um, "b_sigma_uN_s_per_um": best.b_sigma_uN_s_per_um,
        "fit_error_percent": best.error_percent, "misfit": result.misfit.found,
        "vision_force_error_percent": result.vision_force_error_percent, "deepest_um": result.setup.deepest_um,
        "largest_force_uN": result.setup.largest_force_uN, "zoom": result.setup.zoom,
    }  # fmt: skip
    if result.truth is not None:
        row |= {f"true_{name}_error_percent": result.truth.errors_percent.get(name) for name in ("k1", "k2", "b")}
    return row
