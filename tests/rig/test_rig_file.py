"""Rig files: every mistake is found, with its place and what to do."""

import re

import pytest

from microdrivers.configs import shipped_rig
from microdrivers.core.errors import ConfigError, ConfigErrors, UnsupportedError
from microdrivers.rig import load_rig_file

GOOD = shipped_rig("microscope").read_text(encoding="utf-8")


@pytest.fixture
def edited(tmp_path):
    """Write the shipped rig with one edit; returns the file and the line that was edited."""

    def edit(old, new):
        assert old in GOOD, old
        file = tmp_path / "lab.yaml"
        file.write_text(GOOD.replace(old, new, 1), encoding="utf-8")
        return file, GOOD[: GOOD.index(old)].count("\n") + 1

    return edit


def test_the_whole_workstation_is_valid_and_can_be_opened_in_part():
    description = load_rig_file(shipped_rig())
    kinds = {name: entry.driver.kind.__name__ for name, entry in description.devices.items()}
    assert kinds == {
        "sample_stage": "XYThetaStage",
        "probe_stage": "FineStage",
        "gripper_stage": "FineStage",
        "zoom": "ZoomMotor",
        "probe_force": "ForceSensor",
        "gripper_force": "ForceSensor",
        "camera_coarse": "Camera",
        "camera_fine": "Camera",
        "camera_lateral": "Camera",
    }
    assert set(description.restricted_to(["zoom", "probe_stage"]).devices) == {"zoom", "probe_stage"}
    assert description.microscope_devices == ("sample_stage", "zoom", "camera_fine")
    with pytest.raises(UnsupportedError, match="gripper_satge"):
        description.restricted_to(["gripper_satge"])


def test_the_optical_half_is_valid():
    description = load_rig_file(shipped_rig("microscope"))
    assert list(description.devices) == ["sample_stage", "zoom", "camera_fine"]
    assert description.as_data()["devices"]["zoom"]["backlash_steps"] == 20


@pytest.mark.parametrize(
    ("given", "twice", "message"),
    [
        ("/dev/ttyUSB1", "/dev/ttyUSB0", "port /dev/ttyUSB0 already belongs to 'sample_stage'"),
        ("node_id: 14", "node_id: 11", "node 11 on socketcan:can0 already belongs to 'probe_stage'"),
        ("node_id: 21", "node_id: 12", "node 12 on socketcan:can0 already belongs to 'probe_stage'"),
        ("/dev/video2", "/dev/video1", "camera v4l2:///dev/video1 already belongs to 'camera_coarse'"),
    ],
)
def test_nothing_belongs_to_two_devices(tmp_path, given, twice, message):
    file = tmp_path / "lab.yaml"
    file.write_text(shipped_rig().read_text(encoding="utf-8").replace(given, twice), encoding="utf-8")
    with pytest.raises((ConfigError, ConfigErrors), match=message):
        load_rig_file(file)


MISTAKES = {
    "misspelt key": ("baudrate: 115200", "baudrat: 115200", "unknown key", "did you mean 'baudrate'"),
    "wrong unit in the key": (
        "max_speed_um_s: 1500",
        "max_speed_mm_s: 1.5",
        "unknown key",
        "did you mean 'max_speed_um_s'",
    ),
    "unknown key at the top": ("name: microscope", "nmae: microscope", "unknown key", "did you mean 'name'"),
    "unit in the value": ("tolerance_um: 0.15", "tolerance_um: 0.15 um", "is not a number", "unit is part of the key"),
    "out of range": ("unit_id: 1", "unit_id: 40", "less than or equal to 31", "correct the value"),
    "negative": ("acceleration_um_s2: 20000", "acceleration_um_s2: -1", "greater than 0", "correct the value"),
    "not finite": ("pixel_pitch_um: 7.4", "pixel_pitch_um: .nan", "nan is not a finite number", ""),
    "odd baud rate": ("baudrate: 115200", "baudrate: 115201", "115201", "correct the value"),
    "missing driver": (
        "driver: oriental-az-zoom",
        "driver: oriental-azz",
        "no driver 'oriental-azz' is installed",
        "oriental-az-zoom",
    ),
    "role without device": (
        "sample_stage: sample_stage",
        "sample_stage: sample_stag",
        "there is no device",
        "did you mean 'sample_stage'?",
    ),
    "role of another kind": ("zoom: zoom", "zoom: camera_fine", "of kind Camera, not ZoomMotor", "device: zoom"),
    "key given twice": ("exposure_ms: 2.0", "rate_hz: 25", "given twice", "keep one"),
    "tab": ("  zoom:\n", "\tzoom:\n", "not valid YAML", "indentation"),
    "unknown target": ("kind: square", "kind: sqare", "square", ""),
    "another schema": ("schema_version: 1", "schema_version: 2", "1", ""),
    "exposure too long": ("exposure_ms: 2.0", "exposure_ms: 200.0", "does not fit rate_hz", ""),
    "same axis twice": ('id: "2"', 'id: "1"', "different controller axis ids", ""),
    "axis id without quotes": ('id: "2"', "id: 2", "is not text", "put it in quotes"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named_with_its_place(edited, mistake):
    old, new, what, remedy = MISTAKES[mistake]
    file, line = edited(old, new)
    with pytest.raises(ConfigError) as caught:
        load_rig_file(file)
    text = str(caught.value)
    assert what in text
    assert remedy in text
    places = [int(place) for place in re.findall(rf"{re.escape(str(file))}:(\d+):\d+", text)]
    assert line in places


def test_all_mistakes_are_reported_at_once(tmp_path):
    file = tmp_path / "lab.yaml"
    file.write_text(
        GOOD.replace("baudrate: 115200", "baud: 9600").replace("objective: 1.5", "objective: -1").replace("gain", "g"),
        encoding="utf-8",
    )
    with pytest.raises(ConfigErrors) as caught:
        load_rig_file(file)
    assert len(caught.value.errors) >= 2
    assert {error.line for error in caught.value.errors} != {1}


@pytest.mark.parametrize("content", ["", "just text", "- a\n- b\n", "{}", "devices: {}\n", "\x00\x01"])
def test_what_is_no_rig_file_is_refused(tmp_path, content):
    file = tmp_path / "lab.yaml"
    file.write_text(content, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"lab\.yaml"):
        load_rig_file(file)


def test_a_missing_file_says_so(tmp_path):
    with pytest.raises(ConfigError, match="no such file"):
        load_rig_file(tmp_path / "none.yaml")


def test_numbers_are_yaml_1_2(edited):
    file, _ = edited("resolution_um: 0.05", "resolution_um: 5e-2")
    assert load_rig_file(file).devices["sample_stage"].settings.axes.x.resolution_um == 0.05


def test_whole_numbers_are_decimal_whatever_their_zeros(edited):
    file, _ = edited("unit_id: 1", "unit_id: 017")
    assert load_rig_file(file).devices["zoom"].settings.unit_id == 17


@pytest.mark.parametrize("value", ["!!int abc", "!!timestamp foo", "&a [*a]", "!!python/name:os.system"])
def test_tags_and_references_are_refused_by_place(edited, value):
    file, _ = edited("unit_id: 1", f"unit_id: {value}")
    with pytest.raises(ConfigError, match=r"lab\.yaml"):
        load_rig_file(file)
