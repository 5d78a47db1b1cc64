"""The report of an optical calibration: one HTML page that needs nothing but itself."""

from __future__ import annotations

from pathlib import Path

from markupsafe import Markup

from microdrivers.estimators.optics import student_factor
from microdrivers.report.number_format import compact, fixed, significant
from microdrivers.report.optics_quantities import (
    PAPER_SETTLING,
    key_quantities,
    projection_quantities,
    settled_error,
    settled_index,
    settling,
    zoom_name,
)
from microdrivers.report.page import page
from microdrivers.results.optics import OpticsResult

_TEMPLATE = "optics_report.html.j2"


def write_optics_report(result: OpticsResult, file: Path) -> None:
    """Write the report of a calibration as one self-contained HTML page.

    The page shows figures 4–7 of Bilen et al. redrawn from the run, has no script and loads nothing.

    Raises:
        OSError: the file cannot be written.
    """
    file.write_text(optics_report_html(result), encoding="utf-8")


def optics_report_html(result: OpticsResult) -> str:
    """The page as text; equal results give equal text."""
    # Here, because it imports matplotlib, which takes half a second.
    from microdrivers.report.optics_figures import draw_optics_figures

    figures = draw_optics_figures(result)
    return page(
        _TEMPLATE,
        result,
        title=f"Optical calibration of {result.provenance.rig_name or result.valid_for.camera}",
        quantities=key_quantities(result),
        projection=projection_quantities(result),
        settling=settling(result),
        paper_settling=PAPER_SETTLING,
        student_factor=_student_factor(result),
        error=_error(result),
        figures=figures and {name: Markup(svg) for name, svg in figures._asdict().items() if isinstance(svg, str)},
        captions=_captions(result, figures.off_scale if figures else frozenset()),
        zoom_name=zoom_name(result.zoom),
    )


def _student_factor(result: OpticsResult) -> str:
    dof = result.degrees_of_freedom
    if dof < 2.0:
        return ""
    return f"Student’s factor {fixed(student_factor(dof), 2)} for {significant(dof, 3)} degrees of freedom"


def _error(result: OpticsResult) -> dict[str, str]:
    """The settled prediction error as text; empty if no error is defined."""
    error = settled_error(result)
    if error is None:
        return {}
    return {
        "median": significant(error.median_px, 2),
        "most": significant(error.largest_of_95_percent_px, 2),
        "frames": str(error.frames),
    }


def _captions(result: OpticsResult, off_scale: frozenset[str]) -> dict[str, str]:
    """What each figure shows and how it compares with the paper's."""
    change = result.zoom_change
    dashed = "" if result.truth is None else " Dashed: the simulation’s truth" + (
        "." if change is None else " after the change."
    )  # fmt: skip
    shaded = "" if change is None else " Shaded: the zoom moves."
    cut = " Part of the transient lies outside the scale."

    def ending(name: str) -> str:
        return dashed + shaded + (cut if name in off_scale else "")

    return {
        "trajectory": _trajectory_caption(result),
        "projection": "The six entries of the projection matrix P as estimated on line, frame by frame."
        + ending("projection") + " The paper’s Fig. 5 shows the same six curves.",
        "error": _error_caption(result) + shaded,
        "magnification": _magnification_caption(result) + ending("magnification"),
    }  # fmt: skip


def _trajectory_caption(result: OpticsResult) -> str:
    text = (
        "Trajectory of the tracked point (a) in the image, from the principal point with v down, and (b) in world "
        "coordinates, from the stage’s encoders; one dot a frame, ring: the first frame. "
    )
    change = result.zoom_change
    if change is None:
        return text + "The zoom rested; in the paper’s Fig. 4 it changes half-way and the image shows two arcs."
    before, after = compact(change.zoom_before), compact(change.zoom_after)
    return (
        f"{text}Blue: zoom {before}; orange: zoom {after}; grey: the zoom moves. One path of the stage gives two arcs "
        "of different radius in the image, as in the paper’s Fig. 4 at 0.9X and 1.2X."
    )


def _error_caption(result: OpticsResult) -> str:
    text = (
        "Prediction error of the newest frame: a priori, with the estimate before that frame (the stricter), and a "
        "posteriori, as eqs. (9)–(10) print it. Logarithmic scale; values below 0.001 px are drawn at 0.001 px. "
    )
    change = result.zoom_change
    if change is None:
        return text + "The zoom rested, so there is no change to recover from as in the paper’s Fig. 6."
    settled = settled_index(result)
    reached = (
        "Here the a priori error does not settle within 0.1 px"
        if settled is None
        else f"Here the a priori error settles within 0.1 px at iteration {settled - change.first_frame + 1}"
    )
    return f"{text}{reached}; the paper’s Fig. 6 reports 8 iterations. Iteration 1 is frame {change.first_frame}."


def _magnification_caption(result: OpticsResult) -> str:
    if result.magnification is None:
        text = "Scale M, px/µm, frame by frame; without a pixel pitch there is no magnification."
        values = result.traces.scale_px_per_um
    else:
        text = "Magnification at the sensor (scale × pixel pitch) frame by frame."
        values = result.magnification_trace
    start = settled_index(result)
    settled = [] if start is None else [value for value in values[start:] if value is not None]
    last = settled[len(settled) // 2 :]
    if len(last) > 1:
        spread = 50.0 * (max(last) - min(last)) / (sum(last) / len(last))
        text += f" Over the last {len(last)} frames it stays within ±{significant(spread, 2)} %."
    if result.zoom_change is None:
        return text + " The paper’s Fig. 7 shows a change of the zoom."
    return (
        f"{text} The paper’s Fig. 7 shows the same step, with a jump while the zoom moves and small variations "
        "afterwards, which it ascribes to the stage not being parallel to the image."
    )
