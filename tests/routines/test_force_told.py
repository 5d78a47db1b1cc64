"""What result, page and summary of a characterisation say, and how."""

import dataclasses
import re

import msgspec
import numpy as np
import pytest

from microdrivers.core.bus import Bus
from microdrivers.core.contact_samples import SpecimenTruth
from microdrivers.estimators.force.identify import identify
from microdrivers.recording.indentation_table import IndentationTable
from microdrivers.report.force_quantities import slip_text, truth_rows
from microdrivers.report.force_report import force_report_html
from microdrivers.report.force_summary import force_summary
from microdrivers.report.force_truth import ContactTruthCollector
from microdrivers.report.number_format import without_exponents
from microdrivers.results.force import ForceTruth
from microdrivers.routines.force import Characterisation, IndentationPlayback
from tests.routines.indentation_source import REAL, result_of


def test_page_and_summary_tell_every_protocol(characterised):
    _, _, result, _ = characterised
    page, summary = force_report_html(result), force_summary(result)
    for name in result.protocols:
        assert name in page
        assert name in summary
    assert page.count("<svg") == 4
    assert "<script" not in page
    assert max(len(line) for line in summary.splitlines()) <= 120


def test_a_model_that_does_not_fit_is_said_beside_its_numbers(characterised):
    _, _, result, _ = characterised
    (note,) = [note for note in result.notes if note.startswith("The model does not explain the record as fitted by")]
    assert "unloading_springs (" in note
    assert "× noise" in note
    assert "single" not in note
    summary = force_summary(result)
    assert "In brackets" in summary
    (row,) = [line for line in summary.splitlines() if line.startswith("  unloading_springs")]
    assert row.count("(") == 3


def test_a_press_without_a_guard_is_told(characterised):
    _, run, result, _ = characterised
    assert not any("No force guard" in note for note in result.notes)
    unguarded = result_of(run._replace(setup=run.setup._replace(guarded=False)))
    assert any(note.startswith("No force guard watched over the indentation") for note in unguarded.notes)


def test_a_drift_of_the_picture_that_is_not_known_is_told(characterised):
    _, run, result, _ = characterised
    seen = run._replace(setup=run.setup._replace(camera="camera_fine"))
    broken_off = seen._replace(first=seen.first._replace(drift=None, ended=False))
    (note,) = set(result_of(broken_off).notes) - set(result_of(run).notes)
    assert note.startswith("How far the picture drifted is not known, as the record ends before the probe was away")
    assert note in force_report_html(result_of(broken_off))
    assert "picture drifted" in force_summary(result_of(broken_off))
    assert not any("picture drifted" in note for note in result.notes)


def test_a_check_indentation_that_had_not_begun_is_told_as_such(characterised):
    _, run, _, _ = characterised
    began, not_begun = (
        result_of(run._replace(check=run.first._replace(samples=[], forces=[], began=began))) for began in (True, False)
    )
    assert any("ended before the probe had pressed noticeably" in note for note in began.notes)
    assert any("The check indentation had not begun" in note for note in not_begun.notes)


def test_a_slip_that_is_not_identifiable_is_not_quoted(characterised):
    _, _, result, _ = characterised
    assert not result.slip.identifiable
    assert result.slip.reason
    slipped = result.model_copy(update={"best": "slip_corrected"})
    shown = slip_text(slipped)
    assert shown.startswith("(offset ")
    assert f"not to be quoted: {without_exponents(result.slip.reason)}" in shown
    wide = result.slip.model_copy(
        update={"reason": "offset in µm: 95 % interval 1 to 9; α in 1/s: 95 % interval 0 to 1"}
    )
    assert slip_text(slipped.model_copy(update={"slip": wide})).endswith("not to be quoted: its 95 % interval is wide")


def test_a_slip_that_fits_better_and_is_not_preferred_is_said(characterised):
    _, _, result, _ = characterised
    assert "Slip " not in force_summary(result)
    better = result.protocols["slip_corrected"].model_copy(update={"error_percent": 0.01})
    protocols = result.protocols | {"slip_corrected": better}
    why = result.slip.model_copy(update={"reason": "the surface came back"})
    refused = result.model_copy(update={"protocols": protocols, "slip": why})
    assert "Slip          the best fit does without, though with it the error is less: the surface" in force_summary(
        refused
    )


def test_the_truth_stands_in_brackets_where_the_estimate_does(characterised):
    _, _, result, _ = characterised
    known = truth_of(result, best="single")
    assert [row.name for row in known] == ["k1", "k2", "b"]
    assert not any(row.error.startswith("(") for row in known)
    weak = truth_of(result, best="slip_corrected")
    assert [row.name for row in weak] == ["k1", "k2", "b", "slip offset", "slip rate"]
    assert all(row.error.startswith("(") and row.value.startswith("(") for row in weak[3:])


def test_errors_are_of_what_the_best_fit_has(characterised):
    _, _, result, _ = characterised
    bus = Bus()
    truth = ContactTruthCollector(bus)
    bus.topic("truth/specimen", SpecimenTruth).publish(
        SpecimenTruth(
            t_ns=0, device="world", preset="", sensor="", surface_um=(0.0, 0.0, 0.0), k1_uN_per_um=4.0,
            k2_uN_per_um3=1e-4, b_loading_uN_s_per_um=20.0, b_unloading_uN_s_per_um=20.0, m_kg=0.0, slip_um=25.0,
            slip_rate_per_s=0.1, branch_uN_per_um=0.0, branch_s=0.0, adhesion_uN=0.0,
        )
    )  # fmt: skip
    assert set(truth.compare(result, []).errors_percent) == {"k1", "k2", "b"}
    slipped = truth.compare(result.model_copy(update={"best": "slip_corrected"}), [])
    assert set(slipped.errors_percent) == {"k1", "k2", "b", "slip_offset", "slip_rate"}


def truth_of(result, *, best):
    truth = ForceTruth(
        preset="", k1_uN_per_um=4.0, k2_uN_per_um3=1e-4, b_uN_s_per_um=20.0, b_unloading_uN_s_per_um=20.0, m_kg=0.0,
        slip_offset_um=25.0, slip_rate_per_s=0.1, outside_model=[], errors_percent={}, vision_deformation_rms_um=None,
    )  # fmt: skip
    return truth_rows(result.model_copy(update={"best": best, "truth": truth}))


def test_a_force_that_the_camera_tells_after_the_release_is_said(characterised):
    _, run, result, _ = characterised
    assert result.vision_check.left_over_uN is None
    last = run.check.forces[-30:]
    left = [msgspec.structs.replace(force, force_uN=40.0, flags=frozenset({"MAY_BE_RELEASED"})) for force in last]
    spoilt = result_of(run._replace(check=run.check._replace(forces=[*run.check.forces[:-30], *left])))
    assert spoilt.vision_check.left_over_uN == 40.0
    assert any("still indicated up to 40 µN after contact was lost" in note for note in spoilt.notes)


def test_a_zero_of_the_sensor_is_no_force_on_the_specimen(characterised):
    _, run, result, _ = characterised
    record = run.record._replace(force_uN=run.record.force_uN + 20.0)
    shifted = result_of(run._replace(record=record, identification=identify(record)))
    assert shifted.setup.largest_force_uN == pytest.approx(result.setup.largest_force_uN, abs=0.1)


def test_a_way_back_that_was_not_fitted_has_no_speed(characterised):
    _, run, _, _ = characterised
    loading = {"loading": run.identification.protocols["loading"]}
    found = dataclasses.replace(run.identification, protocols=loading, best="loading", slip=None)
    alone = result_of(run._replace(identification=found, setup=run.setup._replace(speed_um_s=None)))
    assert alone.setup.unloading_speed_um_s is None
    assert alone.setup.fastest_unloading_um_s is None
    summary = force_summary(alone)
    assert "back" not in summary
    assert "paper" not in summary.split("\n\n")[1]  # it printed no figures of the loading alone


def test_the_page_of_what_is_no_embryo_is_short_and_without_the_papers_figures():
    run = Characterisation(IndentationPlayback(IndentationTable(REAL))).run()
    result = result_of(run, clock="recorded")
    page, summary = force_report_html(result), force_summary(result)
    text = re.sub(r"<svg.*?</svg>", "", page, flags=re.DOTALL)
    reasons = re.findall(r"<li>(.*– .*)</li>", text)
    assert 3 <= len(reasons) <= 5
    assert max(map(len, reasons)) < 120
    assert not re.search(r"\de-\d", text)
    assert not re.search(r"\de-\d", summary)
    assert "paper 4.5161" not in text
    assert "paper" not in summary.split("\n\n")[1]
    assert "µm/\u2060s" in text


def test_how_good_the_camera_is_within_the_range_of_the_model_is_said(characterised):
    _, run, result, _ = characterised
    assert result.vision_check.error_within_range_percent is None
    outside = [
        msgspec.structs.replace(force, force_uN=1.5 * force.force_uN, flags=frozenset({"OUTSIDE_RANGE"}))
        if force.velocity_um_s < -1.0
        else force
        for force in run.check.forces
    ]
    spoilt = result_of(run._replace(check=run.check._replace(forces=outside)))
    within_percent = spoilt.vision_check.error_within_range_percent
    assert within_percent <= result.vision_check.error_percent
    assert spoilt.vision_check.error_percent > 10.0 * within_percent
    (note,) = [note for note in spoilt.notes if "lie outside the range" in note]
    assert re.search(r"identified; in the others its force is within [\d.]+ % RMS\.$", note)


def test_why_the_specimen_was_not_pressed_as_deeply_as_asked_for_is_said(characterised):
    _, run, result, _ = characterised
    deep_um = result.setup.pressed_um

    def told(*, asked_um, limit_uN=None, ended=True):
        first = run.first._replace(turned_at_uN=limit_uN, ended=ended)
        notes = result_of(run._replace(first=first, setup=run.setup._replace(depth_um=asked_um))).notes
        return [note for note in notes if note.startswith("The probe ")]

    assert told(asked_um=deep_um) == told(asked_um=deep_um + 50.0, ended=False) == []
    assert told(asked_um=deep_um + 50.0, limit_uN=1200.0) == [
        "The probe turned back at 1200 µN, the largest force that it may press with, after "
        f"{deep_um:.3g} of {deep_um + 50.0:g} µm."
    ]
    (note,) = told(asked_um=1.3 * deep_um)
    assert note.startswith(f"The probe went on by {1.3 * deep_um:g} µm beyond the contact that it had felt, and the ")
    assert f"pressed by {deep_um:.3g} µm" in note


def test_a_speed_limit_that_no_speed_keeps_is_not_told(characterised):
    _, run, result, _ = characterised
    assert result.largest_speed_um_s > 0.0
    clipped = run.record._replace(force_uN=np.minimum(run.record.force_uN, 0.5 * np.nanmax(run.record.force_uN)))
    told = result_of(run._replace(record=clipped))
    assert told.largest_speed_um_s is None
    assert "Speed limit" not in force_summary(told)
