"""The report of a force characterisation: one HTML page that needs nothing but itself."""

from __future__ import annotations

from pathlib import Path

from markupsafe import Markup

from microdrivers.report.force_quantities import (
    FACTOR_95,
    K2_UNIT,
    camera_text,
    excluded_text,
    pressed_text,
    protocol_rows,
    slip_text,
    truth_rows,
    valid_depth_text,
    valid_speed_text,
    weak_lines,
)
from microdrivers.report.number_format import significant, with_uncertainty, without_exponents
from microdrivers.report.page import created, page
from microdrivers.results.force import ForceResult

_TEMPLATE = "force_report.html.j2"


def write_force_report(result: ForceResult, file: Path) -> None:
    """Write the report of a characterisation as one self-contained HTML page.

    The page shows figures 9–11 of Bilen et al. redrawn from the run, has no script and loads nothing.

    Raises:
        OSError: the file cannot be written.
    """
    file.write_text(force_report_html(result), encoding="utf-8")


def force_report_html(result: ForceResult) -> str:
    """The page as text; equal results give equal text."""
    # Here, because it imports matplotlib, which takes half a second.
    from microdrivers.report.force_figures import draw_force_figures

    figures = draw_force_figures(result)
    specimen = result.provenance.settings.get("specimen") or (result.truth.preset if result.truth is not None else "")
    check, rows = result.vision_check, protocol_rows(result)
    return page(
        _TEMPLATE,
        result,
        title=f"Force characterisation{f' of {specimen}' if specimen else ''}",
        when=created(result.provenance),
        rows=rows,
        weak=weak_lines(rows),
        best=next(row for row in rows if row.best),
        misfit=without_exponents(result.misfit.text),
        truths=truth_rows(result),
        k2_unit=K2_UNIT,
        slip=slip_text(result),
        excluded=excluded_text(result),
        samples=len(result.traces.time_s),
        pressed=_unbroken(pressed_text(result)),
        valid_depth=valid_depth_text(result),
        valid_speed=valid_speed_text(result),
        scale=_scale(result),
        drift=_drift(result),
        noise=f"{significant(result.deformation_sigma_um, 2)} µm, {significant(result.force_sigma_uN, 2)} µN",
        vision="" if check is None else significant(check.error_percent, 2),
        worst="" if check is None else camera_text(check).rpartition("; ")[2],
        speed="" if result.largest_speed_um_s is None else significant(result.largest_speed_um_s, 3),
        figures={name: Markup(svg) for name, svg in figures._asdict().items() if svg} if figures else {},
    )


def _unbroken(text: str) -> str:
    """Numbers stay on the line of their units."""
    return text.replace(" µ", "\u00a0µ").replace("µm/s", "µm/\u2060s")


def _scale(result: ForceResult) -> str:
    setup = result.setup
    if setup.scale_px_per_um is None:
        return setup.scale_source
    sigma = setup.scale_sigma_px_per_um
    shown = significant(setup.scale_px_per_um, 5)
    if sigma:
        shown += f" ± {significant(100.0 * 1.96 * sigma / setup.scale_px_per_um, 2)} %"
    return f"{shown} px/µm, by {setup.scale_source}"


def _drift(result: ForceResult) -> str:
    setup = result.setup
    if setup.image_drift_um_s is None:
        return ""
    sigma = setup.image_drift_sigma_um_s
    rate = with_uncertainty(1e3 * setup.image_drift_um_s, None if sigma is None else FACTOR_95 * 1e3 * sigma)
    return f"{rate.value} ± {rate.plus_minus} nm/s of the picture against the probe’s encoder, taken off"
