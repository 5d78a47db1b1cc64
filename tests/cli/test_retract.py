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


@pytest.mark.parametrize(("way", "free_um"), [((400, 0, 0), 0.25), ((0, 400, 0), 400.0), ((-240, 320, 0), 400.0)])
def test_only_what_is_free_counts(run, rig_file, way, free_um):
    result = run("move", rig_file(list(way)), STAGE, "--retract", "--fake")
    assert moved_um(result) == pytest.approx(free_um, abs=0.2)
    assert result.exit_code == (0 if free_um == 400.0 else 1), result.output
    if free_um < 400.0:
        assert "the tool is not taken away as far as retract_um says" in result.stderr
        assert "look whether the tool is clear" in result.stderr
