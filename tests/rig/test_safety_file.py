"""The safety section of a rig file: stated or refused, and every mistake in it named with its place and a remedy."""

import re

import pytest
import yaml

from microdrivers.configs import shipped_rig
from microdrivers.core.errors import ConfigError
from microdrivers.rig import load_rig_file

SECTION = """safety:
  force_guards:
    - sensor: probe_force
      stage: probe_stage
      max_force_uN: 1500
      stale_after_ms: 50
  keep_out:
    - name: slide
      min_um: [0, 0, -5000]
      max_um: [15000, 15000, -500]

"""
GUARD = "stale_after_ms: 50"
GRIPPER_GUARD = "{sensor: gripper_force, stage: gripper_stage, max_force_uN: 80}"
PROBE_GUARD = "{sensor: probe_force, stage: probe_stage, max_force_uN: 80}"
BOX = "    - name: slide"


def tools_only():
    """The workstation's tools and zoom, in a file that is quickly read."""
    data = yaml.safe_load(shipped_rig().read_text(encoding="utf-8"))
    for section in ("microscope", "probe", "safety"):
        data.pop(section, None)
    names = ("zoom", "probe_stage", "gripper_stage", "probe_force", "gripper_force")
    data["devices"] = {name: data["devices"][name] for name in names}
    return yaml.safe_dump(data, sort_keys=False)


WITHOUT = tools_only()


@pytest.fixture
def written(tmp_path):
    def write(section, text=WITHOUT):
        file = tmp_path / "lab.yaml"
        file.write_text(text.replace("devices:\n", f"{section}devices:\n", 1), encoding="utf-8")
        return file

    return write


def test_the_shipped_rig_states_its_own(written):
    assert load_rig_file(written(SECTION)).rig.safety == load_rig_file(shipped_rig()).rig.safety
    (guard,) = load_rig_file(shipped_rig()).rig.safety.force_guards
    assert (guard.sensor, guard.stage, guard.max_force_uN) == ("probe_force", "probe_stage", 1500.0)


def test_a_stage_that_carries_a_force_sensor_demands_a_statement(written):
    with pytest.raises(ConfigError, match="probe_stage carries a force sensor") as caught:
        load_rig_file(written(""))
    text = str(caught.value)
    assert "devices.probe_force.carried_by" in text
    assert "{sensor: probe_force, stage: probe_stage, max_force_uN: …}" in text
    assert "safety: none" in text


@pytest.mark.parametrize("section", ["safety: none\n\n", "safety: {force_guards: none, keep_out: none}\n\n"])
def test_none_is_a_statement_too(written, section):
    safety = load_rig_file(written(section)).rig.safety
    assert safety.force_guards == safety.keep_out == ()


def test_without_a_sensor_on_a_stage_nothing_needs_to_be_stated():
    assert load_rig_file(shipped_rig("microscope")).rig.safety.force_guards == ()


@pytest.mark.parametrize("section", [SECTION, "safety: none\n\n"])
def test_what_a_served_rig_file_is_written_from_says_the_same(written, tmp_path, section):
    description = load_rig_file(written(section))
    again = tmp_path / "again.yaml"
    again.write_text(yaml.safe_dump(description.as_data()), encoding="utf-8")
    assert load_rig_file(again).rig.safety == description.rig.safety


MISTAKES = {
    "misspelt key": ("sensor: probe_force", "sensr: probe_force", "unknown key", "did you mean 'sensor'"),
    "no limit": ("      max_force_uN: 1500\n", "", "required key is missing", "add 'max_force_uN'"),
    "unit in the value": ("max_force_uN: 1500", "max_force_uN: 1.5 mN", "is not a number", "unit is part of the key"),
    "negative limit": ("max_force_uN: 1500", "max_force_uN: -3", "greater than 0", "correct the value"),
    "unknown sensor": ("sensor: probe_force", "sensor: prob", "there is no device 'prob'", "name one of"),
    "no sensor": ("sensor: probe_force", "sensor: zoom", "'zoom' is not a ForceSensor", "probe_force, gripper_force"),
    "unknown stage": ("stage: probe_stage", "stage: prob", "there is no device 'prob'", "probe_stage, gripper_stage"),
    "not a fine stage": ("stage: probe_stage", "stage: zoom", "is not a FineStage", "probe_stage, gripper_stage"),
    "another stage's sensor": (
        "stage: probe_stage", "stage: gripper_stage", "not carried by gripper_stage but by probe_stage", "carried_by",
    ),
    "beyond the sensor": ("max_force_uN: 1500", "max_force_uN: 2500", "outside what probe_force can tell", "range_uN"),
    "below its resolution": ("max_force_uN: 1500", "max_force_uN: 0.005", "0.01 to 2000 µN", "check the unit"),
    "stale before it comes": (
        GUARD, f"{GUARD}\n    - {GRIPPER_GUARD}",
        "shorter than two readings of gripper_force at 30 Hz", "allow 67 ms",
    ),
    "guarded twice": (
        GUARD, f"{GUARD}\n    - {PROBE_GUARD}",
        "'probe_force' is listed twice", "keep one",
    ),
    "a speed that it never has": (GUARD, "max_speed_um_s: 5000", "probe_stage moves at 1000 µm/s", "leave it out"),
    "a zero beyond the limit": (GUARD, "zero_within_uN: 1600", "hide the whole limit", "less than"),
    "an empty list": (f"  keep_out:\n{BOX}", f"  keep_out: []\n#{BOX}", "a list is needed here", "write none"),
    "half a section": ("  keep_out:", "  keep_uot:", "unknown key", "did you mean 'keep_out'"),
    "a box inside out": ("max_um: [15000, 15000, -500]", "max_um: [15000, 15000, -5500]", "along z a box", "correct"),
    "a flat point": ("min_um: [0, 0, -5000]", "min_um: [0, 0]", "a point is needed here: [x, y, z]", "correct"),
    "two boxes of a name": (
        BOX, f"    - {{name: slide, min_um: [0, 0, 0], max_um: [1, 1, 1]}}\n{BOX}",
        "'slide' is listed twice", "keep one",
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named_with_its_place(written, mistake):
    old, new, what, remedy = MISTAKES[mistake]
    assert old in SECTION
    section = SECTION.replace(old, new, 1)
    if mistake == "an empty list":
        section = re.sub(r"(?m)^      (min|max)_um.*\n", "", section)
    file = written(section)
    with pytest.raises(ConfigError) as caught:
        load_rig_file(file)
    text = str(caught.value)
    assert what in text, text
    assert remedy in text, text
    lines = file.read_text(encoding="utf-8").splitlines()
    first = lines.index("safety:")
    for place in re.findall(rf"{re.escape(str(file))}:(\d+):\d+", text):
        assert first <= int(place) <= first + 14
    assert "safety" in text


def test_a_tool_whose_tip_is_not_known_cannot_be_kept_out(written):
    text = re.sub(r"    origin_um:\n    - 6200\n    - 7500\n    - 0\n", "", WITHOUT)
    with pytest.raises(ConfigError, match="not known where the tip of gripper_stage is") as caught:
        load_rig_file(written(SECTION, text))
    assert "origin_um" in caught.value.remedy
    assert "keep_out: none" in caught.value.remedy
    assert caught.value.key == "devices.gripper_stage"


def test_a_guarded_stage_needs_a_way_out(written):
    text = re.sub(r"    retract_um:\n    - 400\n    - 0\n    - 0\n", "", WITHOUT)
    with pytest.raises(ConfigError, match="no way to take the tool away") as caught:
        load_rig_file(written(SECTION, text))
    assert caught.value.key == "devices.probe_stage"
    load_rig_file(written("safety: none\n\n", text))


def test_a_broken_device_is_not_also_called_missing(written):
    with pytest.raises(ConfigError) as caught:
        load_rig_file(written(SECTION, WITHOUT.replace("resolution_uN: 0.01", "resolution_uN: 0.01 µN")))
    assert "is not a number" in str(caught.value)
    assert "there is no device" not in str(caught.value)
