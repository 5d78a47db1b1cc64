"""`move --retract` says how far the tool was taken away, and is no success if it was not."""

import re

import pytest
import yaml

from microdrivers.configs import shipped_rig

STAGE = "probe_stage"


@pytest.fixture
def rig_file(tmp_path):
    """The probe's stage, whose x is referenced near the end of its travel, at +624.75 µm."""

    def write(retract_um):
        data = yaml.safe_load(shipped_rig().read_text(encoding="utf-8"))
        for section in ("microscope", "probe"):
            data.pop(section, None)
        data["safety"] = "none"
        data["devices"] = {STAGE: data["devices"][STAGE] | {"retract_um": retract_um}}
        file = tmp_path / "retract.yaml"
        file.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
        return file

    return write


def moved_um(result):
    return float(re.search(r"taken away by (-?[\d.]+) µm of 400 µm", result.stdout)[1])


def test_the_whole_way(run, rig_file):
    result = run("move", rig_file([-400, 0, 0]), STAGE, "--retract", "--fake")
    assert result.exit_code == 0, result.output
    assert moved_um(result) == pytest.approx(400.0, abs=0.2)


@pytest.mark.parametrize(
    ("way", "free_um"), [((240, 320, 0), 0.4), ((400, 0, 0), 0.25), ((0, 400, 0), 400.0), ((-240, 320, 0), 400.0)]
)
def test_only_what_is_free_counts(run, rig_file, way, free_um):
    """A tool whose whole way away is at its end is away; one of two axes at its end does not take it there."""
    result = run("move", rig_file(list(way)), STAGE, "--retract", "--fake")
    assert moved_um(result) == pytest.approx(free_um, abs=0.2)
    assert result.exit_code == (1 if way[1] and free_um < 400.0 else 0), result.output
    assert ("already at the end of its way away: nothing to retract" in result.stdout) == (way == (400, 0, 0))
    if result.exit_code:
        assert "the tool is not taken away as far as retract_um says" in result.stderr
        assert "look whether the tool is clear" in result.stderr


def test_a_tool_at_the_end_of_its_travel_and_in_a_box_is_not_away(run, rig_file):
    file = rig_file([400, 0, 0])
    data = yaml.safe_load(file.read_text(encoding="utf-8"))
    box = {"name": "wall", "min_um": [8500, 0, -1000], "max_um": [8600, 15000, 1000]}
    data["safety"] = {"force_guards": "none", "keep_out": [box]}
    axes = data["devices"][STAGE]["axes"]
    axes["y"]["homing_method"] = 37  # where it then is, the file does not tell
    file.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    result = run("move", file, STAGE, "--retract", "--fake")
    assert result.exit_code == 1, result.output
    assert "nothing to retract" not in result.stdout


def test_the_example_of_the_help_is_no_failure_on_the_emulated_workstation(run):
    result = run("move", shipped_rig(), STAGE, "--retract", "--fake")
    assert result.exit_code == 0, result.output
    assert "nothing to retract" in result.stdout
