import numpy as np
import pytest

from microdrivers.estimators.optics import optical_parameters, student_factor
from microdrivers.report.optics_quantities import (
    key_quantities,
    projection_quantities,
    settled_error,
    settled_index,
    settling,
)
from microdrivers.report.page import created, run_kind


def by_name(result):
    return {quantity.name: quantity for quantity in key_quantities(result)}


def test_half_widths_are_students(make_result):
    result = make_result(scale_sigma_px_per_um=0.001, degrees_of_freedom=4.0)
    expected = 0.001 * student_factor(4.0)
    assert float(by_name(result)["Scale"].plus_minus) == pytest.approx(expected, rel=0.05)
    pitch = result.magnification / result.scale_px_per_um
    assert float(by_name(result)["Magnification"].plus_minus) == pytest.approx(expected * pitch, rel=0.05)


@pytest.mark.parametrize("mirrored", [False, True])
def test_translation_interval_follows_from_the_covariance_of_p(make_result, mirrored):
    result = make_result(mirrored=mirrored)
    covariance = np.array(result.covariance)
    factor = student_factor(result.degrees_of_freedom)
    entries = np.array(result.projection).ravel()
    for axis in (0, 1):
        step = 1e-7 * np.maximum(np.abs(entries), 1e-3)
        gradient = np.array([
            (_translation(entries + d)[axis] - _translation(entries - d)[axis]) / (2 * step[i])
            for i, d in enumerate(np.diag(step))
        ])  # fmt: skip
        expected = factor * np.sqrt(gradient @ covariance @ gradient)
        row = by_name(result)[f"Translation along {'uv'[axis]}"]
        assert float(row.plus_minus) == pytest.approx(expected, rel=0.051)


def _translation(entries):
    return optical_parameters(entries.tolist()).translation_um


def test_error_is_estimate_minus_truth_and_says_whether_the_interval_holds_it(make_result):
    result = make_result()
    truth = result.truth.model_copy(update={"scale_px_per_um": result.scale_px_per_um / 1.01})
    row = by_name(result.model_copy(update={"truth": truth}))["Scale"]
    assert row.error == "+1.0 %"
    assert row.inside is False
    assert by_name(result)["Magnification"].inside is True


def test_angle_error_goes_the_short_way_round(make_result):
    result = make_result(angle_deg=-179.5)
    result = result.model_copy(update={"angle_deg": 179.9, "angle_sigma_deg": 0.1})
    row = by_name(result)["In-plane angle"]
    assert row.error == "−0.60°"


def test_nothing_about_truth_without_truth(make_result):
    for quantity in key_quantities(make_result(with_truth=False)):
        assert (quantity.truth, quantity.error, quantity.inside) == ("", "", None)


@pytest.mark.parametrize(
    ("interval", "text", "inside"),
    [((0.0, 1.234), "≤ 1.2°", True), ((0.512, 1.2), "0.51° to 1.2°", False), ((0.0, 90.0), "not determined", None)],
)
def test_tilt_is_a_bound_or_an_interval(make_result, interval, text, inside):
    result = make_result()
    tilt = result.tilt.model_copy(update={"interval_deg": interval})
    row = by_name(result.model_copy(update={"tilt": tilt}))["Tilt"]
    assert row.text() == text
    assert row.inside is inside
    assert result.tilt.label in row.symbol


def test_wrong_handedness_shows(make_result):
    result = make_result()
    truth = result.truth.model_copy(update={"view": "along_plus_z"})
    assert by_name(result)["View"].inside is True
    assert by_name(result.model_copy(update={"truth": truth}))["View"].inside is False


def test_unknown_uncertainty_leaves_the_value_alone(make_result):
    result = make_result(scale_sigma_px_per_um=0.0, degrees_of_freedom=0.0)
    row = by_name(result)["Scale"]
    assert row.plus_minus == ""
    assert row.inside is None
    assert projection_quantities(result)[0][0].plus_minus == ""


def test_projection_rows_are_p(make_result):
    result = make_result()
    rows = projection_quantities(result)
    assert [[q.name for q in row] for row in rows] == [["p11", "p12", "p13"], ["p21", "p22", "p23"]]
    value = float(rows[1][2].value.replace("−", "-"))
    assert value == pytest.approx(result.projection[1][2], abs=0.01)
    assert rows[1][2].unit == "px"


def test_settling_counts_and_seconds(make_result):
    result = make_result()
    change = result.zoom_change.model_copy(
        update={"iterations_to_0p1_px": 8, "iterations_to_0p1_px_from_end": 1, "posterior_iterations_to_0p1_px": None}
    )
    rows = settling(result.model_copy(update={"zoom_change": change}))
    assert rows[0].from_start == "8 iterations (0.27 s)"
    assert rows[0].from_end == "1 iteration (0.03 s)"
    assert rows[1].from_start == "not reached"
    assert settling(make_result(zoom_change=False)) == []


def test_a_lost_frame_takes_its_time_until_the_error_settles(make_result):
    result = make_result()
    change = result.zoom_change.model_copy(update={"iterations_to_0p1_px": 7})
    times_s = [time_s + (index > change.first_frame + 3) / 30 for index, time_s in enumerate(result.traces.time_s)]
    traces = result.traces.model_copy(update={"time_s": times_s})
    rows = settling(result.model_copy(update={"zoom_change": change, "traces": traces}))
    assert rows[0].from_start == "7 iterations (0.27 s)"


def test_settled_frames(make_result):
    result = make_result()
    change = result.zoom_change
    assert settled_index(result) == change.first_frame + change.iterations_to_0p1_px - 1
    assert settled_error(result).frames == result.frames - settled_index(result)
    never = result.model_copy(update={"zoom_change": change.model_copy(update={"iterations_to_0p1_px": None})})
    assert settled_index(never) is None
    assert settled_error(never).frames == result.frames - change.last_moving_frame - 4
    undefined = make_result(zoom_change=False, prediction_error_px=[None] * 100)
    assert settled_index(undefined) is None
    assert settled_error(undefined) is None


@pytest.mark.parametrize(
    ("fake", "clock", "key"),
    [(True, "simulated", "simulated"), (True, "recorded", "simulated"), (False, "recorded", "recorded"),
     (False, "system", "real"), (True, "system", "simulated")],
)  # fmt: skip
def test_run_kind(make_result, fake, clock, key):
    assert (
        run_kind(make_result(frames=10, zoom_change=False, provenance={"fake": fake, "clock": clock}).provenance).key
        == key
    )


@pytest.mark.parametrize(
    ("text", "shown"),
    [("2025-03-04T09:15:42Z", "2025-03-04 09:15 UTC"), ("2025-03-04T09:15:42+02:00", "2025-03-04 07:15 UTC"),
     ("2025-03-04T09:15:42", "2025-03-04 09:15 UTC"), ("yesterday", "yesterday")],
)  # fmt: skip
def test_created(make_result, text, shown):
    assert created(make_result(frames=10, zoom_change=False, provenance={"created_utc": text}).provenance) == shown
