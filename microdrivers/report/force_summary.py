"""The terminal summary of a force characterisation: plain text, short enough to be seen at once."""

from __future__ import annotations

import textwrap

from microdrivers.report.force_quantities import (
    K2_UNIT,
    camera_text,
    excluded_text,
    pressed_text,
    protocol_rows,
    slip_fits_better,
    slip_text,
    truth_rows,
    valid_depth_text,
    valid_speed_text,
)
from microdrivers.report.number_format import significant, without_exponents
from microdrivers.report.page import created, run_kind
from microdrivers.results.force import ForceResult

_WIDTH = 100


def force_summary(result: ForceResult) -> str:
    """What a characterisation found, in plain text; notes come last.

    Values have the half-width of their 95 % interval; one that the record does not determine stands in brackets.
    """
    lines = [*_heading(result), "", *_protocols(result), "", *_performance(result)]
    notes = [
        line
        for note in result.notes
        for line in textwrap.wrap(note, _WIDTH, initial_indent="  ! ", subsequent_indent="    ")
    ]
    if notes:
        lines += ["", *notes]
    return "\n".join(line.rstrip() for line in lines)


def _heading(result: ForceResult) -> list[str]:
    provenance, setup = result.provenance, result.setup
    specimen = provenance.settings.get("specimen") or (result.truth.preset if result.truth is not None else "")
    what = f"Force characterisation{f' of {specimen}' if specimen else ''}"
    where = f", {provenance.rig_name}, {setup.sensor}" if provenance.rig_name else ""
    state = "complete" if result.complete else "NOT COMPLETE"
    return [what + where, f"{run_kind(provenance).label}, {state}, {created(provenance)}"]


def _protocols(result: ForceResult) -> list[str]:
    found = protocol_rows(result)
    heads = ["", "k1 (µN/µm)", f"k2 ({K2_UNIT})", "b (µN·s/µm)", "error"]
    rows = [heads + ["paper"] * bool(found[0].paper)]
    rows += [
        [f"{'*' if row.best else ' '} {row.key}", row.k1.text, row.k2.text, row.b.text, row.error, *row.paper[3:]]
        for row in found
    ]
    lines = _table(rows)
    truth = truth_rows(result)
    if truth:
        lines += [
            "",
            *_table([["  truth of the simulation", "", ""], *([f"  {t.name}", t.truth, t.error] for t in truth)]),
        ]
    return lines


def _table(rows: list[list[str]]) -> list[str]:
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]


def _best(result: ForceResult) -> str:
    return f"{result.best} (*)" + ", which does not explain the specimen" * result.misfit.found


def _performance(result: ForceResult) -> list[str]:
    rows = [
        ("Best", f"{_best(result)}; error is RMS(F − F̂)/RMS(F) over the samples used"),
        ("Pressed", pressed_text(result)),
        ("Valid for", f"{valid_depth_text(result)}; {valid_speed_text(result)}"),
    ]
    slip = slip_text(result)
    if slip and (result.best == "slip_corrected" or slip_fits_better(result)):
        rows.append(("Slip", slip))
    if any(quantity.weak for row in protocol_rows(result) for quantity in (row.k1, row.k2, row.b)):
        rows.append(("In brackets", "not to be quoted as properties of the specimen; report.html says why"))
    rows.append(("Residual", without_exponents(result.misfit.text)))
    if result.vision_check is not None:
        rows.append(("Camera alone", camera_text(result.vision_check)))
    if result.largest_speed_um_s is not None:
        force_uN = significant(result.setup.largest_force_uN, 4)
        fastest = significant(result.largest_speed_um_s, 3)
        slip_out = ", the slip left out" if result.best == "slip_corrected" else ""
        rows.append(
            ("Speed limit", f"up to {fastest} µm/s the force stays below {force_uN} µN in that range{slip_out}")
        )
    excluded = excluded_text(result)
    if excluded:
        rows.append(("Not used", f"samples: {excluded}"))
    width = max(len(name) for name, _ in rows)
    return [f"  {name.ljust(width)}  {text}" for name, text in rows]
