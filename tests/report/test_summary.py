import subprocess
import sys

import pytest

from microdrivers.report.summary import MOST_LINES, optics_summary


def test_says_what_was_found(make_result):
    text = optics_summary(make_result())
    assert text.startswith("Optical calibration of workstation, camera_fine, zoom 1.2\nsimulated, complete")
    assert "±" in text
    assert "px/µm" in text
    assert "paper           8 iterations (0.26 s)" in text
    assert text.splitlines()[-1] == "  ! 1 frame had no pose close enough before and after it."


def test_columns_line_up(make_result):
    lines = optics_summary(make_result()).splitlines()
    header = next(line for line in lines if line.strip().startswith("truth"))
    scale = next(line for line in lines if "Scale" in line)
    assert scale[header.index("truth") - 1] == " "
    assert scale[header.index("truth")] == "0"
    assert scale[header.index("error")] in "+−0"


def test_no_truth_columns_without_truth(make_result):
    text = optics_summary(make_result(with_truth=False, complete=False, provenance={"fake": False, "clock": "system"}))
    assert "truth" not in text
    assert "real hardware, NOT COMPLETE" in text


@pytest.mark.parametrize("notes", [0, 1, 60])
def test_stays_short_and_ends_with_the_notes(make_result, notes):
    text = optics_summary(make_result(notes=["a rather long remark about this run " * 5] * notes))
    lines = text.splitlines()
    assert len(lines) <= MOST_LINES
    assert all(len(line) <= 110 for line in lines)
    assert ("in the report" in lines[-1]) == (notes > 1)


def test_a_missed_truth_is_named(make_result):
    result = make_result()
    truth = result.truth.model_copy(update={"angle_deg": -90.0, "view": "along_plus_z"})
    text = optics_summary(result.model_copy(update={"truth": truth}))
    assert "−3.4013° outside the interval" in text
    assert "differs" in text


@pytest.mark.parametrize("case", [{"zoom_change": False}, {"magnification": False}, {"frames": 4, "zoom_change": False},
                                  {"prediction_error_px": [None] * 100}])  # fmt: skip
def test_nothing_undefined_shows(make_result, case):
    text = optics_summary(make_result(**case))
    for word in ("nan", "None", "inf"):
        assert word not in text


def test_costs_no_matplotlib():
    code = (
        "import sys, microdrivers.report.summary, microdrivers.report.optics_report;"
        "assert not {'matplotlib', 'cv2', 'pymodbus'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
