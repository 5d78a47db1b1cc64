"""The terminal summary of a calibration: plain text, short enough to be seen at once."""

from __future__ import annotations

import textwrap

from microdrivers.report.number_format import significant
from microdrivers.report.optics_quantities import (
    PAPER_SETTLING,
    Quantity,
    key_quantities,
    settled_error,
    settling,
    zoom_name,
)
from microdrivers.report.page import created, run_kind
from microdrivers.results.optics import OpticsResult

MOST_LINES = 25
_WIDTH = 100


def optics_summary(result: OpticsResult) -> str:
    """What a calibration found, in at most 25 lines of plain text; notes come last.

    Values have the half-width of their 95 % interval and a unit; a simulated run also its truth and error.
    """
    lines = [*_heading(result), "", *_quantities(key_quantities(result)), "", *_performance(result)]
    notes = _notes(result)
    if notes:
        lines += ["", *notes]
    if len(lines) > MOST_LINES:
        lines = [*lines[: MOST_LINES - 1], "  … the rest is in the report"]
    return "\n".join(line.rstrip() for line in lines)


def _heading(result: OpticsResult) -> list[str]:
    provenance = result.provenance
    # Of an image sequence no rig is known.
    what = ", ".join(filter(None, (provenance.rig_name, result.valid_for.camera, zoom_name(result.zoom))))
    state = "complete" if result.complete else "NOT COMPLETE"
    return [f"Optical calibration of {what}", f"{run_kind(provenance).label}, {state}, {created(provenance)}"]


def _quantities(quantities: list[Quantity]) -> list[str]:
    rows = [["", "", "truth", "error"]] if any(q.truth for q in quantities) else []
    for quantity in quantities:
        error = quantity.error
        if quantity.inside is False:
            error = f"{error} outside the interval".lstrip() if quantity.plus_minus or quantity.unit else "differs"
        rows.append([quantity.name, quantity.text(), quantity.truth, error])
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    return [
        "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows
    ]  # fmt: skip


def _performance(result: OpticsResult) -> list[str]:
    rows = []
    error = settled_error(result)
    if error is not None:
        rows.append(
            ("Prediction error", f"{significant(error.median_px, 2)} px median, "
             f"{significant(error.largest_of_95_percent_px, 2)} px in 95 % of {error.frames} frames")
        )  # fmt: skip
    change = result.zoom_change
    if change is not None:
        move = f"{zoom_name(change.zoom_before)} to {zoom_name(change.zoom_after)[5:]}"
        rows.append(("Zoom change", f"{move} at frame {change.first_frame}; error within 0.1 px after"))
        rows += [
            (f"  {row.name}", f"{row.from_start} from its start, {row.from_end} from its end")
            for row in settling(result)
        ]
        rows.append(("  paper", PAPER_SETTLING))
    rows.append(
        ("Frames", f"{result.frames} used, {result.lost_frames} lost, {result.unmatched_frames} without a pose")
    )
    width = max(len(name) for name, _ in rows)
    return [f"  {name.ljust(width)}  {text}" for name, text in rows]


def _notes(result: OpticsResult) -> list[str]:
    lines: list[str] = []
    for note in result.notes:
        lines += textwrap.wrap(note, _WIDTH, initial_indent="  ! ", subsequent_indent="    ")
    return lines
