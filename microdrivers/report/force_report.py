"""The report of a force characterisation: one HTML page that needs nothing but itself."""

from __future__ import annotations

from pathlib import Path

from markupsafe import Markup

from microdrivers.report.force_quantities import FACTOR_95, K2_UNIT, excluded_text, protocol_rows, slip_text, truth_rows
from microdrivers.report.number_format import compact, significant, with_uncertainty
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
    setup, check = result.setup, result.vision_check
    return page(
        _TEMPLATE,
        result,
        title=f"Force characterisation{f' of {specimen}' if specimen else ''}",
        when=created(result.provenance),
        rows=protocol_rows(result),
        best=next(row for row in protocol_rows(result) if row.best),
        truths=truth_rows(result),
        k2_unit=K2_UNIT,
        slip=slip_text(result),
        excluded=excluded_text(result),
        samples=len(result.traces.time_s),
        pressed=f"{significant(setup.deepest_um, 4)} µm, {significant(setup.largest_force_uN, 4)} µN, "
        f"{compact(setup.speed_um_s)} µm/s",
        scale=_scale(result),
        drift=_drift(result),
        noise=f"{significant(result.deformation_sigma_um, 2)} µm, {significant(result.force_sigma_uN, 2)} µN",
        vision="" if check is None else significant(check.error_percent, 2),
        speed="" if result.largest_speed_um_s is None else significant(result.largest_speed_um_s, 3),
        figures={name: Markup(svg) for name, svg in figures._asdict().items() if svg} if figures else {},
    )


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
