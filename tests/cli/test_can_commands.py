"""The commands on a rig with fine stages and force sensors on one CAN bus: emulated, and with nodes gone."""

import json
import re

import pytest
import yaml

import microdrivers.rig
from microdrivers.configs import shipped_rig
from microdrivers.fakes.can import medium_named
from microdrivers.rig import build_rig

ON_BUS = ("probe_stage", "gripper_stage", "probe_force")
BUS = "socketcan:can0"


@pytest.fixture
def rig_file(tmp_path):
    """The CAN devices of the workstation."""
    data = yaml.safe_load(shipped_rig().read_text(encoding="utf-8"))
    for section in ("microscope", "probe"):
        data.pop(section, None)
    data["safety"] = "none"
    data["devices"] = {name: data["devices"][name] for name in ON_BUS}
    file = tmp_path / "can.yaml"
    file.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    return file


@pytest.fixture
def disturbed(monkeypatch):
    """Interfere with every rig that a command builds, before it is opened; returns the rigs."""

    def install(disturb=lambda rig: None):
        rigs = []

        def build(*arguments, **options):
            rig = build_rig(*arguments, **options)
            disturb(rig)
            rigs.append(rig)
            return rig

        monkeypatch.setattr(microdrivers.rig, "build_rig", build)
        return rigs

    return install


def drive(rig, stage, axis):
    return rig.simulation.emulations[stage].devices[axis]


def without_gripper_y(rig):
    drive(rig, "gripper_stage", "y").node.receive = lambda frame, t_ns: ()


def line_of(output, name):
    (line,) = [line for line in output.splitlines() if re.match(rf"{name} ", line)]
    return line


# ---------------------------------------------------------------------- status


def test_status_has_one_line_a_device(run, rig_file):
    result = run("status", rig_file, "--fake")
    assert result.exit_code == 0, result.output
    for stage, serial_numbers in (("probe_stage", "4020011/4020012/4020013"), ("gripper_stage", "4020014/")):
        line = line_of(result.stdout, stage)
        assert serial_numbers in line
        assert "NOT REFERENCED: z, x, y; at rest" in line
    assert re.search(r"link open \| force -?\d+\.\d+ µN .*flags UNTARED", line_of(result.stdout, "probe_force"))


def test_status_as_json(run, rig_file):
    found = json.loads(run("status", rig_file, "--fake", "--json").stdout)["devices"]
    assert found["probe_stage"]["state"]["referenced"] == {"x": False, "y": False, "z": False}
    assert found["probe_stage"]["state"]["z_um"] == 0.0
    assert found["probe_force"]["state"]["flags"] == ["UNTARED"]
    assert {entry["link"] for entry in found.values()} == {"open"}


def test_status_names_a_missing_drive_and_shows_the_others(run, rig_file, disturbed):
    disturbed(without_gripper_y)
    result = run("status", rig_file, "--fake")
    assert result.exit_code == 1
    line = line_of(result.stdout, "gripper_stage")
    assert "ERROR: axis y (node 15), reading 1000h.0" in line
    assert "to do: check power, the node id switches" in line
    assert "at rest" in line_of(result.stdout, "probe_stage")
    assert "UNTARED" in line_of(result.stdout, "probe_force")


def test_status_shows_a_fault_and_the_command_that_clears_it(run, rig_file, disturbed):
    disturbed(lambda rig: drive(rig, "probe_stage", "z").inject_fault(rig.clock.now_ns(), 0x7121))
    line = line_of(run("status", rig_file, "--fake").stdout, "probe_stage")
    assert "FAULT: axis z (node 13): motor blocked (error code 7121h)" in line
    assert f"microdrivers clear-fault {rig_file} probe_stage" in line
    cleared = run("clear-fault", rig_file, "probe_stage", "--fake")
    assert cleared.exit_code == 0, cleared.output
    assert "probe_stage: fault cleared; now at" in cleared.stdout


def test_without_hardware_the_missing_interface_is_named(run, rig_file):
    result = run("status", rig_file)
    assert result.exit_code == 1
    assert result.stdout.count("ERROR: CAN bus can0 (socketcan) cannot be opened") == 3
    assert result.stdout.count("to do:") == 3


# ---------------------------------------------------------------------- doctor


def test_doctor_shows_the_bus_with_load_and_counters(run, rig_file):
    result = run("doctor", rig_file, "--fake")
    assert result.exit_code == 0, result.output
    bus = result.stdout[result.stdout.index(f"CAN {BUS}") :]
    assert f"shared by {', '.join(ON_BUS)}" in bus
    assert re.search(r"load it with \d\d% of 500 kbit/s", bus)
    assert "0 error frames" in bus
    assert re.search(r"3 devices: \d+ OK, 3 warnings, no problems", result.stdout.splitlines()[-1])


def test_doctor_says_nothing_of_a_bus_that_could_not_be_opened(run, rig_file):
    result = run("doctor", rig_file)
    assert result.exit_code == 1
    assert result.stdout.count("CAN bus can0 (socketcan) cannot be opened") == 3
    assert "since it was opened" not in result.stdout
    assert "shared by" not in result.stdout


def test_doctor_as_json_holds_the_bus(run, rig_file, disturbed):
    disturbed(without_gripper_y)
    result = run("doctor", rig_file, "--fake", "--json")
    assert result.exit_code == 1
    diagnosis = json.loads(result.stdout)
    (bus,) = diagnosis["buses"]
    assert bus["name"] == f"CAN {BUS}"
    assert bus["devices"] == list(ON_BUS)
    assert bus["figures"]["stream_hz"].keys() == {"probe_stage", "probe_force"}
    assert 0.1 < bus["figures"]["load"] < 0.5
    assert bus["figures"]["counters"]["timeouts"] > 0
    (gripper,) = [device for device in diagnosis["devices"] if device["name"] == "gripper_stage"]
    assert [finding["level"] for finding in gripper["findings"]] == ["problem"]


# ---------------------------------------------------------------------- move, stop


def test_move_references_an_emulated_stage_and_ends_on_target(run, rig_file):
    result = run("move", rig_file, "probe_stage", "--x-um", 20, "--z-um", -30.05, "--fake")
    assert result.exit_code == 0, result.output
    assert "x 20.00 µm" in result.stdout
    assert "z -30.05 µm" in result.stdout
    assert "referencing z, x, y" in result.stderr


@pytest.mark.parametrize(("box_from_um", "code"), [(8000, 1), (8600, 0)])
def test_a_search_for_references_that_ends_in_a_keep_out_box_fails_and_names_the_way_out(
    run, rig_file, box_from_um, code
):
    data = yaml.safe_load(rig_file.read_text(encoding="utf-8"))
    holder = {"name": "holder", "min_um": [box_from_um, 7200, -5000], "max_um": [8800, 8000, 5000]}
    data["safety"] = {"force_guards": "none", "keep_out": [holder]}
    data["devices"]["probe_stage"]["axes"]["y"]["homing_method"] = 37
    rig_file.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    result = run("reference", rig_file, "--device", "probe_stage", "--fake")
    assert result.exit_code == code, result.output
    assert "z, x, y referenced" in result.stdout
    assert ("the tip is in the keep-out box 'holder'" in result.stderr) == bool(code)
    assert (f"microdrivers move {rig_file} probe_stage --by --y-um" in result.stderr.replace("\n", " ")) == bool(code)


def test_stop_tells_all_drives_and_no_sensor(run, rig_file, disturbed):
    rigs = disturbed()
    result = run("stop", rig_file, "--fake")
    assert result.exit_code == 0, result.output
    for stage in ("probe_stage", "gripper_stage"):
        assert "told to stop: " in line_of(result.stdout, stage)
        assert "at rest" in line_of(result.stdout, stage)
    assert "probe_force" not in result.stdout
    assert len(rigs) == 1


def test_stop_reaches_what_it_can_and_says_which_drive_is_not_known(run, rig_file, disturbed):
    heard = []

    def listen(rig):
        without_gripper_y(rig)
        medium_named(BUS).on_passed = lambda t_ns, who, frame: heard.append((who, frame.id, frame.data))

    disturbed(listen)
    result = run("stop", rig_file, "--fake")
    assert result.exit_code == 1
    assert "told to stop: " in line_of(result.stdout, "probe_stage")
    line = line_of(result.stdout, "gripper_stage")
    assert "told to stop, but WHO LISTENS IS NOT KNOWN" in line
    assert "axis y (node 15)" in line
    assert "emergency stop" in result.stderr
    quick_stop = bytes.fromhex("2B4060000200")  # 6040h = 0002h, by SDO: no PDO is set up yet
    for node in range(11, 17):
        mine = [(identifier, data) for who, identifier, data in heard if who == "host" and identifier == 0x600 + node]
        assert mine[0][1].startswith(quick_stop), node


def test_stop_without_a_bus_reaches_nobody(run, rig_file, disturbed):
    disturbed(lambda rig: medium_named(BUS).unplug())
    result = run("stop", rig_file, "--fake")
    assert result.exit_code == 1
    assert result.stdout.count("NOT REACHED") == 2
    assert "emergency stop" in result.stderr


# ---------------------------------------------------------------------- serve


@pytest.mark.xdist_group("real_time")
def test_serve_puts_all_devices_of_a_bus_on_one_adapter(run, rig_file, tmp_path):
    served = tmp_path / "served.yaml"
    result = run("serve", rig_file, "--for", 0, "--json", "--write", served)
    assert result.exit_code == 0, result.output
    places = json.loads(result.stdout)
    assert set(places) == set(ON_BUS)
    (place,) = set(places.values())
    assert place.endswith("can-socketcan-can0")
    connections = [entry["connection"] for entry in yaml.safe_load(served.read_text())["devices"].values()]
    assert connections[0] == connections[1] == connections[2]
    assert connections[0] | {"interface": "slcan", "channel": place, "bitrate": 500_000} == connections[0]


@pytest.mark.xdist_group("real_time")
def test_serve_on_an_interface_that_is_not_there_is_one_clear_message(run, rig_file):
    result = run("serve", rig_file, "--for", 0, "--can", "nocan7")
    assert result.exit_code == 1
    assert "nocan7" in result.output
    assert "to do:" in result.output
