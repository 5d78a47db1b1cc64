"""Image sequences: the real micrographs calibrate, and every mistake in a folder is named with its place."""

import csv
import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from microdrivers.cli.main import main
from microdrivers.core.errors import ConfigError
from microdrivers.recording.image_sequence import ImageSequence

MICROGRAPHS = Path(__file__).parent.parent / "data" / "micrograph_sequence"

TRUE_BLOCK = np.array([[-0.285, -0.012], [0.010, -0.291]])
"""px per µm; stated with the data."""


@pytest.fixture
def sequence(tmp_path):
    """A copy of the first ten micrographs that a test may damage."""
    folder = tmp_path / "sequence"
    folder.mkdir()
    lines = (MICROGRAPHS / "frames.csv").read_text().splitlines()[:11]
    (folder / "frames.csv").write_text("\n".join(lines) + "\n")
    for line in lines[1:]:
        shutil.copy(MICROGRAPHS / line.split(",")[0], folder)
    return folder


def edit_cell(folder, line, column, value):
    rows = list(csv.reader((folder / "frames.csv").read_text().splitlines()))
    rows[line - 1][rows[0].index(column)] = value
    (folder / "frames.csv").write_text("\n".join(",".join(row) for row in rows) + "\n")


def calibrate(folder, out, *options):
    return CliRunner().invoke(main, ["calibrate", "optics", "--images", str(folder), "--out", str(out), *options])


def test_real_micrographs_calibrate_to_their_stated_projection(tmp_path):
    ran = calibrate(MICROGRAPHS, tmp_path / "out")
    assert ran.exit_code == 0, ran.output
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    block = np.array(result["projection"])[:, :2]
    assert np.linalg.norm(block - TRUE_BLOCK) / np.linalg.norm(TRUE_BLOCK) <= 0.003
    errors = result["prediction_error_px"]
    assert errors[:3] == [None, None, None]
    assert max(errors[5:]) <= 0.1
    assert result["frames"] == 30
    assert result["truth"] is None
    assert result["magnification"] is None
    assert result["zoom_change"] is None
    page = re.sub(r"<(style|svg).*?</\1>|<[^>]*>", " ", (tmp_path / "out" / "report.html").read_text(), flags=re.DOTALL)
    assert not re.search(r"\b(nan|none|inf)\b", page.lower())


def test_a_zoom_at_which_nothing_was_found_is_told(tmp_path):
    folder = shutil.copytree(MICROGRAPHS, tmp_path / "sequence")
    rows = ImageSequence(folder).rows
    blank = np.zeros_like(ImageSequence(folder).load(rows[0]))
    for row in rows[20:]:
        edit_cell(folder, row.line, "zoom", "1.5")
        cv2.imwrite(str(row.file), blank)
    result = calibrate(folder, tmp_path / "one")
    assert (result.exit_code, "NOT COMPLETE" in result.stdout) == (1, True), result.output
    found = json.loads((tmp_path / "one" / "result.json").read_text())
    assert not found["complete"]
    [told] = [note for note in found["notes"] if "The zoom changed" in note]
    assert "The zoom changed to 1.5, where no frame could be used: this is the calibration at zoom 1." in told
    result = calibrate(folder, tmp_path / "two", "--frames", "20")
    assert result.exit_code == 0, result.output
    assert not any(told in result.stdout for told in ("NOT COMPLETE", "The zoom changed"))


def test_comments_and_further_columns_are_allowed(sequence):
    text = (sequence / "frames.csv").read_text().splitlines()
    text[0] += ",note"
    text[1:] = [line + ",ok" for line in text[1:]]
    (sequence / "frames.csv").write_text("# taken by hand\n" + "\n".join(text) + "\n")
    assert len(ImageSequence(sequence)) == 10


def test_a_missing_column_is_named(sequence):
    table = sequence / "frames.csv"
    table.write_text(table.read_text().replace("x_um", "x_mm"))
    with pytest.raises(ConfigError, match=r"frames\.csv:1:1: column x_um is missing"):
        ImageSequence(sequence)


def test_frames_without_a_pose_or_a_zoom_are_left_out_and_told(sequence, tmp_path):
    edit_cell(sequence, 2, "zoom", "nan")
    edit_cell(sequence, 2, "y_um", "")
    ran = calibrate(sequence, tmp_path / "out")
    assert ran.exit_code == 0, ran.output
    found = json.loads((tmp_path / "out" / "result.json").read_text())
    assert found["frames"] == 9
    told = ["frames without a pose (x_um, y_um): 1 of 10, left out.", "frames without a zoom: 1 of 10, left out."]
    assert [note.partition("flaw: ")[2] for note in found["notes"] if "flaw" in note] == told


@pytest.mark.parametrize("value", ["abc", "inf", "1.0 um"])
def test_a_value_that_is_no_number_has_its_line_and_column(sequence, value):
    edit_cell(sequence, 4, "y_um", value)
    with pytest.raises(ConfigError, match=r"frames\.csv:4:4: y_um: .*not a finite number"):
        ImageSequence(sequence)


def test_time_must_increase(sequence):
    edit_cell(sequence, 5, "time_s", "0.0")
    with pytest.raises(ConfigError, match=r"frames\.csv:5:2: time_s: time does not increase"):
        ImageSequence(sequence)


def test_an_image_that_is_not_there_is_named(sequence):
    (sequence / "003.png").unlink()
    with pytest.raises(ConfigError, match=r"frames\.csv:5:1: file: there is no image '003\.png'"):
        ImageSequence(sequence)


@pytest.mark.parametrize("keep", [0, 10, 2000])
def test_a_truncated_image_is_named_and_nothing_is_written(sequence, tmp_path, keep):
    image = sequence / "005.png"
    image.write_bytes(image.read_bytes()[:keep])
    ran = calibrate(sequence, tmp_path / "out")
    assert ran.exit_code == 1
    assert "005.png" in ran.output
    assert "frames.csv:7" in ran.output
    assert "Traceback" not in ran.output
    assert not (tmp_path / "out").exists()


def test_an_image_of_another_size_is_named(sequence, tmp_path):
    import cv2

    image = cv2.imread(str(sequence / "004.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(sequence / "004.png"), image[:-20])
    ran = calibrate(sequence, tmp_path / "out")
    assert ran.exit_code == 1
    assert "004.png is 320×220 px, the first 320×240" in ran.output


def test_no_motion_is_said(sequence, tmp_path):
    """The same picture and pose again and again, but for the encoder's last digit."""
    for number in range(10):
        shutil.copy(MICROGRAPHS / "000.png", sequence / f"{number:03}.png")
        edit_cell(sequence, number + 2, "x_um", f"{0.05 * (number % 2)}")
        edit_cell(sequence, number + 2, "y_um", f"{0.05 * (number % 3)}")
    ran = calibrate(sequence, tmp_path / "out")
    assert ran.exit_code == 1
    assert re.search(r"to do: .*both (of its )?axes", ran.output)


def test_a_folder_without_a_table_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"needs a frames\.csv"):
        ImageSequence(tmp_path)


def test_a_sequence_of_an_unknown_rig_is_called_by_its_folder(sequence, tmp_path, monkeypatch):
    monkeypatch.chdir(sequence)
    ran = calibrate(Path(), tmp_path / "out")
    assert ran.exit_code == 0, ran.output
    assert f"Optical calibration of {sequence.name}, zoom 1\n" in ran.output
    assert f"<title>Optical calibration of {sequence.name}</title>" in (tmp_path / "out" / "report.html").read_text()
    assert yaml.safe_load((tmp_path / "out" / "calibration.yaml").read_text())["rig"] is None


def test_images_exclude_a_rig(tmp_path):
    ran = calibrate(MICROGRAPHS, tmp_path / "out", "--fake")
    assert ran.exit_code == 1
    assert "--images replaces the rig" in ran.output
