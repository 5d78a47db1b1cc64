"""Plausible mistakes in the workstation's rig file: each is named with its key, its line and what to do."""

import copy
import math
import re
from unittest import mock

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.configs import shipped_rig
from microdrivers.core.errors import ConfigError
from microdrivers.rig import load_rig_file, rig_file
from microdrivers.rig.yaml_file import read_document

GOOD = shipped_rig().read_text(encoding="utf-8")
PROBE = "devices.probe_stage"
BUS = "connection: {interface: socketcan, channel: can0, bitrate: 500000}"
ORDER = "reference_order: [z, x, y]  # away"
RETRACT = "retract_um: [400, 0, 0]"
READY = "ready_um: [-390, 0, 0]"
ORIGIN = "origin_um: [7950, 7500, 0]"
METHOD = "homing_method: 18     # away"
FOREIGN = re.compile("Input|should|Field required|Tuple|[Pp]ydantic|parse|valid ")

# name: what stands in the file, what somebody writes, the key that is blamed, what is said, the remedy
MISTAKES = {
    # sections of one device
    "no such homing method": (
        METHOD, "homing_method: 99     # away", f"{PROBE}.axes.x.homing_method", "99", "17 or 18",
    ),
    "reserved homing method": (METHOD, "homing_method: 16     # away", f"{PROBE}.axes.x.homing_method", "16", "33 or"),
    "homing method in words": (
        METHOD, "homing_method: index  # away", f"{PROBE}.axes.x.homing_method", "is not a whole number",
        "bare number",
    ),
    "misspelt interface": (
        "interface: socketcan", "interface: soketcan", f"{PROBE}.connection.interface",
        "python-can knows no interface 'soketcan'",
        "did you mean 'socketcan'? (what else there is comes with a plug-in",
    ),
    "unknown interface": (
        "interface: socketcan", "interface: telepathy", f"{PROBE}.connection.interface", "no interface 'telepathy'",
        "it knows canalystii",
    ),
    "option outside options": (
        BUS, BUS[:-1] + ", fd: true}", f"{PROBE}.connection.fd", "fd is no key", "write options: {fd: …}",
    ),
    "misspelt key of a bus": (
        "bitrate: 500000}", "bitrat: 500000}", f"{PROBE}.connection.bitrat", "unknown key", "did you mean 'bitrate'?",
    ),
    "options in a list": (
        BUS, BUS[:-1] + ", options: [fd]}", f"{PROBE}.connection.options", "['fd'] is not a mapping", "key: value",
    ),
    "fd that is neither": (
        BUS, BUS[:-1] + ", options: {fd: yes}}", f"{PROBE}.connection.options.fd", "fd is 'yes'",
        "write true for CAN FD",
    ),
    "misspelt option": (
        BUS, BUS[:-1] + ", options: {local_lopback: true}}", f"{PROBE}.connection.options.local_lopback",
        "unknown to socketcan", "did you mean 'local_loopback'?",
    ),
    "bit rate among the options": (
        BUS, BUS[:-1] + ", options: {bitrate: 500000}}", f"{PROBE}.connection.options.bitrate", "not python-can's",
        "beside options",
    ),
    "nested option": (
        BUS, BUS[:-1] + ", options: {a: {b: 1}}}", f"{PROBE}.connection.options.a", "a is {'b': 1}",
        "a number or text",
    ),
    "short vector": (
        ORDER, f"axes_in_rig: {{x: [1, 0]}}\n    {ORDER}", f"{PROBE}.axes_in_rig.x", "3 values are needed here, not 2",
        "pair of brackets",
    ),
    "long vector": (
        ORDER, f"axes_in_rig: {{x: [1, 0, 0, 0]}}\n    {ORDER}", f"{PROBE}.axes_in_rig.x",
        "3 values are needed here, not 4", "pair of brackets",
    ),
    "vector that is none": (
        ORDER, f"axes_in_rig: {{x: [2, 0, 0]}}\n    {ORDER}", f"{PROBE}.axes_in_rig.x", "length 1, not 2", "",
    ),
    "order of two": (
        ORDER, "reference_order: [z, x]  # away", f"{PROBE}.reference_order", "once each, not z, x",
        "for example [z, x, y]",
    ),
    "order of another axis": (
        ORDER, "reference_order: [z, x, theta]  # away", f"{PROBE}.reference_order", "not z, x, theta", "[z, x, y]",
    ),
    "order in one word": (ORDER, "reference_order: zxy  # away", f"{PROBE}.reference_order", "not 'zxy'", "[z, x, y]"),
    "not a number in a list": (
        ORIGIN, "origin_um: [.nan, 7500, 0]", f"{PROBE}.origin_um.0", "nan is not a finite number", "",
    ),
    "infinite range": (
        "range_uN: [-2000, 2000]", "range_uN: [-2000, .inf]", "devices.probe_force.range_uN.1", "inf is not a finite",
        "",
    ),
    "not a number in a box": (
        "max_um: [15000, 15000, -500]", "max_um: [15000, 15000, .nan]", "safety.keep_out.0.max_um.2",
        "nan is not a fin", "",
    ),
    "number in quotes": (
        "node_id: 11", 'node_id: "11"', f"{PROBE}.axes.x.node_id", "'11' is not a whole", "number: 11",
    ),
    "hexadecimal": ("node_id: 11", "node_id: 0x0B", f"{PROBE}.axes.x.node_id", "'0x0B' is not a whole", "number: 11"),
    "empty value": ("node_id: 11", "node_id:", f"{PROBE}.axes.x.node_id", "nothing stands here; a whole number", ""),
    "text without quotes": (
        "channel: can0", "channel: 0", f"{PROBE}.connection.channel", "0 is not text", "put it in quotes",
    ),
    "one end of a range": (
        "travel_um: [-625, 625]", "travel_um: 625", f"{PROBE}.axes.x.travel_um", "625 is not a list", "in brackets",
    ),
    "three ends of a range": (
        "travel_um: [-625, 625]", "travel_um: [-625, 0, 625]", f"{PROBE}.axes.x.travel_um", "2 values are needed", "",
    ),
    "swapped ends of a range": (
        "travel_um: [-625, 625]", "travel_um: [625, -625]", f"{PROBE}.axes.x.travel_um", "must rise", "",
    ),
    "node given twice in a stage": (
        "node_id: 12", "node_id: 11", f"{PROBE}.axes.y.node_id", "different node ids, not [11, 11, 13]", "",
    ),
    "misspelt choice": (
        "handedness: right", "handedness: rihgt", "frames.handedness", "must be 'right' or 'left'",
        "did you mean 'right'?",
    ),
    "unknown kind of target": (
        "kind: square", "kind: squares", "microscope.target.kind", "'squares' is not possible",
        "did you mean 'square'?",
    ),
    "key of another unit": (
        "side_um: 400", "side_um: 400\n    size_um: 3", "microscope.target.size_um", "unknown key",
        "did you mean 'side_um'?",
    ),
    "one point of a curve too long": (
        "[10000, 11.25]", "[10000, 11.25, 1]", "devices.zoom.curve.1", "2 values are needed here, not 3", "",
    ),
    "device without section": (
        "  camera_lateral:\n    driver: camera", "  camera_lateral:\n  other:\n    driver: camera",
        "devices.camera_lateral", "nothing stands here; a mapping", "key: value",
    ),
    "device in capitals": ("  camera_lateral:", "  Lateral:", "devices.Lateral", "small letters", ""),
    "section in one line": (
        "connection: {port: /dev/ttyUSB2, baudrate: 115200, parity: N}", "connection: /dev/ttyUSB2",
        "devices.gripper_force.connection", "is not a mapping of keys", "key: value",
    ),
    "misspelt driver": (
        "driver: cia402-fine-stage", "driver: cia402-finestage", f"{PROBE}.driver", "no driver",
        "mean 'cia402-fine-stage'?",
    ),
    "no source": (
        "source: v4l2:///dev/video0", "source: /dev/video0", "devices.camera_fine.source", "no installed frame source",
        "begin it with one of",
    ),
    "misspelt source": (
        "source: v4l2:///dev/video0", "source: v4l3:///dev/video0", "devices.camera_fine.source", "no installed frame",
        "did you mean v4l2://?",
    ),
    "axis of a larger controller": (
        "controller: C-884", "controller: C-884.4DC", "devices.sample_stage.axes.y.id", "'5' is none of a C-884.4DC",
        "correct it",
    ),
    "controller of one axis": (
        "controller: C-884", "controller: C-863.12", "devices.sample_stage.controller", "drives one axis",
        "address: 1, 2, 3",
    ),
    "controller without GCS": (
        "controller: C-884", "controller: C-863.10", "devices.sample_stage.controller", "speaks no GCS", "C-863.12",
    ),
    "resolution of another unit": (
        "resolution_uN: 0.01", "resolution_uN: 10000", "devices.probe_force.resolution_uN", "whole range_uN", "unit",
    ),
    "empty name": ("port: /dev/ttyUSB1", 'port: ""', "devices.zoom.connection.port", "the text is empty", "leave"),
    "node of this computer": (
        "node_id: 21", "node_id: 127", "devices.probe_force.node_id", "less than or equal to 126", "",
    ),
    "adapter without port": (
        "interface: socketcan", "interface: slcan", f"{PROBE}.connection.channel", "'can0' is no serial", "/dev/tty",
    ),
    "interface that is a port": (
        "channel: can0", "channel: /dev/ttyACM0", f"{PROBE}.connection.channel", "no name of a network", ": slcan",
    ),
    "target without kind": ("    kind: square\n", "", "microscope.target.kind", "required key is missing", "'kind'"),
    "number for a name": ("  camera_lateral:", "  5:", "devices.5", "small letters", ""),
    "digits grouped": (
        "115200\n      timeout_s: 0.5", "115_200\n      timeout_s: 0.5", "devices.sample_stage.connection.baudrate",
        "'115_200' is not possible", "bare number: 115200",
    ),
    "exponent for a whole number": (
        "speed_steps_s: 20000", "speed_steps_s: 2e4", "devices.zoom.speed_steps_s", "20000.0 is not a whole", ": 20000",
    ),
    # between sections
    "two bit rates on a bus": (
        f"{BUS}\n    node_id: 21", f"{BUS[:-7]}250000}}\n    node_id: 21", "devices.probe_force.connection.bitrate",
        "250000 contradicts 'probe_stage', which states 500000", "same bitrate",
    ),
    "other options on a bus": (
        f"{BUS}\n    node_id: 21", f"{BUS[:-1]}, options: {{fd: true}}}}\n    node_id: 21",
        "devices.probe_force.connection.options", "contradicts 'probe_stage', which states {}", "same options",
    ),
    "adapter on a stage's port": (
        f"{BUS}\n    node_id: 21", "connection: {interface: slcan, channel: /dev/ttyUSB0@115200}\n    node_id: 21",
        "devices.probe_force.connection", "port /dev/ttyUSB0 already belongs to 'sample_stage' alone", "own port",
    ),
    "misspelt carrier": (
        "carried_by: gripper_stage", "carried_by: griper_stage", "devices.gripper_force.carried_by",
        "there is no device 'griper_stage'", "did you mean 'gripper_stage'?",
    ),
    "carried by a camera": (
        "carried_by: gripper_stage", "carried_by: zoom", "devices.gripper_force.carried_by",
        "of kind ZoomMotor, not Stage", "sample_stage, probe_stage, gripper_stage",
    ),
    "ready outside the travel": (
        READY, "ready_um: [-390, 630, 0]", "probe.ready_um.1", "-625 to 625 µm", "not in the rig's",
    ),
    "ready in a box": (
        READY, "ready_um: [-390, 0, -600]", "probe.ready_um", "in the keep-out box 'slide'", "origin_um of",
    ),
    "references found in a box": (
        ORIGIN, "origin_um: [7950, 7500, -1200]", PROBE, "(8575, 6875, -575) µm of the rig's frame, into the keep-out "
        "box 'slide'", "homing_method",
    ),
    "ready beside a box": (READY, "ready_um: [-390, 0, -498]", "probe.ready_um", "nearer to it than 5 µm", ""),
    "retraction beyond the travel": (
        RETRACT, "retract_um: [4000, 0, 0]", f"{PROBE}.retract_um.0", "the whole travel", "unit",
    ),
    "retraction downwards": (
        RETRACT, "retract_um: [0, 0, -400]", f"{PROBE}.retract_um", "down by 400 µm", "turn it round",
    ),
    "retraction aside": (
        RETRACT, "retract_um: [20, 300, 0]", f"{PROBE}.retract_um", "aside, at right angles to the axis of probe_force",
        "back along that axis, or up",
    ),
    "retraction into the specimen": (
        RETRACT, "retract_um: [-400, 0, 0]", f"{PROBE}.retract_um", "towards what the probe presses on",
        "axis of probe_force",
    ),
    "another tool's sensor": (
        "force: probe_force", "force: gripper_force", "probe.force", "not carried by probe_stage but by gripper_stage",
        "name",
    ),
    "misspelt role": (
        "  stage: probe_stage\n  force", "  stage: prob_stage\n  force", "probe.stage", "there is no device",
        "'probe_stage'?",
    ),
    "camera from the side": (
        "camera: camera_fine\n  obj", "camera: camera_lateral\n  obj", "microscope.camera", "view: lateral",
        "behind the zoom",
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named_with_key_line_and_remedy(tmp_path, mistake):
    old, new, key, what, remedy = MISTAKES[mistake]
    assert old in GOOD, old
    text = GOOD.replace(old, new, 1)
    if mistake == "axis of a larger controller":
        text = text.replace('id: "2"', 'id: "5"')
    file = tmp_path / "lab.yaml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_rig_file(file)
    error = next(each for each in getattr(caught.value, "errors", (caught.value,)) if f": {key}: " in str(each))
    assert what in error.what
    assert remedy in error.remedy
    blamed = text.splitlines()[error.line - 1][error.column - 1 :]
    name = [part for part in key.split(".") if not part.isdecimal()][-1]
    present = re.search(rf"\b{name}:", blamed) or key.rpartition(".")[2].isdecimal() or name not in new
    assert present, blamed
    assert not FOREIGN.search(str(caught.value))


def test_one_mistake_is_one_error(tmp_path):
    for mistake in ("one point of a curve too long", "nested option", "device without section", "short vector"):
        old, new, *_ = MISTAKES[mistake]
        file = tmp_path / "lab.yaml"
        file.write_text(GOOD.replace(old, new, 1), encoding="utf-8")
        with pytest.raises(ConfigError) as caught:
            load_rig_file(file)
        assert not hasattr(caught.value, "errors"), mistake


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("interface: socketcan", "interface: microdrivers"),  # a plug-in's
        (METHOD, "homing_method: -1     # away"),
        ("z: up", "z: towards the operator"),
        (ORDER, f"axes_in_rig: {{x: [0.9999, 0, -0.0141]}}\n    {ORDER}"),  # hardly tilted
    ],
)
def test_what_may_be_meant_is_let_be(tmp_path, old, new):
    text = GOOD.replace(old, new)
    if "z: towards" in new:
        text = text.replace(RETRACT, "retract_um: [0, 0, -400]")
    file = tmp_path / "lab.yaml"
    file.write_text(text, encoding="utf-8")
    load_rig_file(file)


def test_a_sensor_alone_may_name_a_stage_that_is_elsewhere(tmp_path):
    file = tmp_path / "lab.yaml"
    text = re.sub(r"(?s)^(safety|probe|microscope):.*?(?=^\S)", "", GOOD, flags=re.M)
    head, _, devices = text.partition("devices:\n")
    sensor = devices[devices.index("  probe_force:") : devices.index("  gripper_force:")]
    file.write_text(f"{head}devices:\n{sensor}", encoding="utf-8")
    assert load_rig_file(file).devices["probe_force"].settings.carried_by == "probe_stage"


DOCUMENT = read_document(shipped_rig())
PLACES = [place for place in DOCUMENT.places if place]
ODD = (
    None, "", "x", "12", "0x1", -1, 0, 10**30, 1e300, math.nan, -math.inf, True, [], {}, [1], [1, 2, 3], [[1]],
    {"a": 1}, {1: 2},
)  # fmt: skip


@settings(deadline=None, max_examples=200)
@given(st.sampled_from(PLACES), st.sampled_from(ODD))
def test_whatever_stands_anywhere_is_taken_or_explained(place, odd):
    data = copy.deepcopy(DOCUMENT.data)
    section = data
    for part in place[:-1]:
        section = section[part]
    section[place[-1]] = odd
    with mock.patch.object(rig_file, "read_document", return_value=DOCUMENT._replace(data=data)):
        try:
            load_rig_file(shipped_rig())
        except ConfigError as error:
            found = error
        else:
            return
    assert not FOREIGN.search(str(found))
    for each in getattr(found, "errors", (found,)):
        assert each.line > 1
        assert each.key
        assert each.remedy
