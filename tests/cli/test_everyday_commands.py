"""status, move, stop, doctor and reference as a user meets them, on emulators and with cables pulled."""

import json
import re

import msgspec
import pytest

from microdrivers.backends.pi_gcs.stage import GcsXYThetaStage
from microdrivers.configs import shipped_rig
from microdrivers.core.samples import ZoomSample
from microdrivers.fakes.wire import Wire, wire_named

RIG = shipped_rig("microscope")

COMMANDS = ["status", "move", "stop", "snap", "doctor", "reference"]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(run, command):
    result = run(command, "--help")
    assert result.exit_code == 0
    assert f"microdrivers {command} lab.yaml" in result.output


@pytest.mark.parametrize("command", COMMANDS)
def test_a_missing_rig_file_is_one_clear_message(run, command):
    more = {"move": ["zoom", "--zoom", 1], "snap": ["--out", "a.png"], "reference": ["--axes", "x"]}
    result = run(command, "none.yaml", *more.get(command, []))
    assert result.exit_code == 1
    assert "none.yaml: there is no such file" in result.output


def test_a_world_without_fake_is_refused(run):
    result = run("status", RIG, "--seed", 3)
    assert result.exit_code == 1
    assert "add --fake" in result.output


# ---------------------------------------------------------------------- status


def test_status_has_one_line_a_device(run):
    result = run("status", RIG, "--fake")
    assert result.exit_code == 0, result.output
    stage, zoom, camera = result.stdout.splitlines()
    assert stage.startswith("sample_stage  Physik Instrumente")
    assert "C-884" in stage
    assert "NOT REFERENCED: x, y, theta" in stage
    assert re.search(r"zoom \d\.\d{3} \(\d+ steps\); referenced; at rest", zoom)
    assert "exposure 2 ms" in camera
    assert "\x1b" not in result.output


def test_status_as_json_is_json_and_nothing_else(run):
    result = run("status", RIG, "--fake", "--json")
    found = json.loads(result.stdout)["devices"]
    assert found["sample_stage"]["state"]["referenced"] == {"x": False, "y": False, "theta": False}
    assert found["sample_stage"]["state"]["target_x_um"] is None
    assert found["sample_stage"]["link"] == "open"
    assert found["camera_fine"]["state"]["exposure_ms"] == 2.0
    assert found["zoom"]["error"] is None


def test_status_shows_the_others_if_one_is_unplugged(run, prepared):
    prepared(lambda rig: wire_named("sample_stage").unplug())
    result = run("status", RIG, "--fake")
    assert result.exit_code == 1
    stage, zoom, camera = result.stdout.splitlines()
    assert "ERROR" in stage
    assert "cable" in stage
    assert "steps" in zoom
    assert "exposure" in camera


def test_status_names_missing_hardware(run):
    result = run("status", RIG)
    assert result.exit_code == 1
    assert result.stdout.count("ERROR") == 3
    assert "/dev/ttyUSB0" in result.stdout
    assert "--fake" in result.stdout


# ---------------------------------------------------------------------- move


def test_move_reports_where_the_stage_was_seen(run):
    result = run(
        "move",
        RIG,
        "sample_stage",
        "--x-um",
        7600,
        "--y-um",
        7450.5,
        "--speed-um-s",
        500,
        "--fake",
    )
    assert result.exit_code == 0, result.output
    x_um, y_um = (float(text) for text in re.findall(r"[xy] (\d+\.\d+) µm", result.stdout))
    assert (x_um, y_um) == pytest.approx((7600, 7450.5), abs=0.2)
    assert "NOT REFERENCED: theta" in result.stdout
    assert "off target by x" in result.stdout


def test_move_by_counts_from_where_the_device_is(run):
    moved = run("move", RIG, "sample_stage", "--by", "--x-um", -20, "--theta-deg", 0.5, "--fake")
    assert "x 7480.0" in moved.stdout or "x 7479.9" in moved.stdout
    assert "θ 0.5" in moved.stdout or "θ 0.4999" in moved.stdout


def test_move_sets_the_zoom(run):
    assert "zoom 1.2" in run("move", RIG, "zoom", "--zoom", 1.2, "--fake").stdout
    there = float(re.search(r"zoom (\S+) \(", run("status", RIG, "--fake").stdout)[1])
    after = run("move", RIG, "zoom", "--by", "--zoom", 0.3, "--fake").stdout
    assert float(re.search(r"zoom (\S+) \(", after)[1]) == pytest.approx(there + 0.3, abs=0.003)


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["sample_stage"], "a move needs a target"),
        (["sample_stage", "--speed-um-s", 5], "a move needs a target"),
        (["sample_stage", "--zoom", 1], "--zoom cannot be used here"),
        (["zoom", "--x-um", 1], "--x-um cannot be used here"),
        (["camera_fine", "--x-um", 1], "cannot move"),
        (["stage", "--x-um", 1], "name one of sample_stage, zoom"),
        (["sample_stage", "--x-um", 1e6], "outside 0 to 15000 µm"),
        (["sample_stage", "--x-um", "nan"], "not a finite number"),
        (["sample_stage", "--x-um", 7600, "--speed-um-s", 1e5], "speed"),
        (["zoom", "--zoom", 20], "outside"),
    ],
)
def test_move_refuses_and_moves_nothing(run, prepared, arguments, what):
    emulators = prepared()
    result = run("move", RIG, *arguments, "--fake")
    assert result.exit_code == 1
    assert what in result.output
    assert not [text for _, text in emulators[0].events if text.startswith("move")]


def test_move_of_an_unreferenced_axis_names_the_command_that_references_it(run, bench):
    _, file = bench
    result = run("move", file, "sample_stage", "--x-um", 7600, "--theta-deg", 1)
    assert result.exit_code == 1
    assert f"microdrivers reference {file} --device sample_stage --axes x,theta" in result.output


def test_ctrl_c_during_a_move_stops_the_stage(run, prepared, monkeypatch):
    emulators, honest, after = prepared(), Wire.write, [0]

    def interrupting(wire, data):
        honest(wire, data)
        after[0] += b"MOV" in data or bool(after[0])
        if after[0] == 6:
            after[0] += 1
            raise KeyboardInterrupt

    monkeypatch.setattr(Wire, "write", interrupting)
    result = run("move", RIG, "sample_stage", "--x-um", 12_000, "--fake")
    assert result.exit_code == 130
    said = re.search(r"sample_stage: told to stop: x (\d+\.\d+) µm, .*; at rest", result.stderr)
    assert said, result.stderr
    assert 7500 < float(said[1]) < 11_000
    texts = [text for _, text in emulators[0].events]
    moved = next(number for number, text in enumerate(texts) if text.startswith("move x"))
    assert "stop #24" in texts[moved:]


# ---------------------------------------------------------------------- stop


def test_stop_tells_all_that_moves(run, prepared):
    emulators = prepared()
    result = run("stop", RIG, "--fake")
    assert result.exit_code == 0, result.output
    assert result.stdout.count("told to stop") == 2
    assert "camera_fine" not in result.stdout
    assert "stop #24" in [text for _, text in emulators[0].events]


def test_stop_reaches_the_others_if_one_is_unplugged_and_says_so(run, prepared):
    prepared(lambda rig: wire_named("zoom").unplug())
    result = run("stop", RIG, "--fake")
    assert result.exit_code == 1
    assert re.search(r"sample_stage\s+told to stop", result.stdout)
    assert re.search(r"zoom\s+NOT REACHED", result.stdout)
    assert "emergency stop" in result.stderr


def test_stop_without_hardware_says_what_could_not_be_reached(run):
    result = run("stop", RIG)
    assert result.exit_code == 1
    assert result.stdout.count("NOT REACHED") == 2
    assert "another program" in result.stdout


class KeepsMoving(GcsXYThetaStage):
    def _read(self):
        return msgspec.structs.replace(super()._read(), moving=True)


def test_stop_does_not_call_stopped_what_still_moves(run, prepared):
    prepared(sample_stage=KeepsMoving)
    result = run("stop", RIG, "--fake")
    assert result.exit_code == 1
    assert re.search(r"sample_stage.*STILL MOVING", result.stdout)


def test_stop_halts_a_motor_that_another_program_left_moving(run, bench):
    rig, file = bench
    zoom = rig.devices["zoom"]
    zoom.open()
    zoom.start_move_to(zoom=11.25)  # four seconds at this speed
    zoom.close()
    result = run("stop", file)
    assert result.exit_code == 0, result.output
    assert re.search(r"zoom\s+told to stop: .*at rest", result.stdout)
    zoom.open()
    sample = zoom.read()
    assert isinstance(sample, ZoomSample)
    assert sample.zoom < 9
    assert not sample.moving


# ---------------------------------------------------------------------- doctor, reference


def test_doctor_ends_with_a_summary(run):
    result = run("doctor", RIG, "--fake", "--motion", "--seed", 2)
    assert result.exit_code == 0, result.output
    assert result.stdout.splitlines()[-1] == "3 devices: 21 OK, no warnings, no problems"
    assert "emulated" in result.stdout
    assert "\x1b" not in result.stdout


def test_doctor_as_json_holds_findings_and_figures(run, prepared):
    def without_camera(rig):
        del rig.devices["camera_fine"]
        wire_named("zoom").unplug()

    prepared(without_camera)
    result = run("doctor", RIG, "--fake", "--json")
    assert result.exit_code == 1
    stage, zoom = json.loads(result.stdout)["devices"]
    assert stage["figures"]["read_median_ms"] > 0
    assert [finding["level"] for finding in zoom["findings"]] == ["problem"]


def test_doctor_without_hardware_shows_every_device_with_what_to_try(run):
    result = run("doctor", RIG)
    assert result.exit_code == 1
    assert result.stdout.count("PROBLEM") == 3
    assert result.stdout.count("try: ") == 3
    assert "3 problems" in result.stdout.splitlines()[-1]


@pytest.mark.parametrize("command", [["doctor", "--motion"], ["reference", "--axes", "x"]], ids=lambda c: c[0])
def test_hardware_is_moved_only_after_a_yes(run, bench, command):
    _, file = bench
    result = run(command[0], file, *command[1:], stdin="n\n")
    assert result.exit_code == 1
    assert "Is the way free?" in result.stderr
    assert "Aborted" in result.stderr
    events = [text for _, text in wire_named("sample_stage").emulator.events]
    assert not [text for text in events if text.startswith(("move", "reference"))]


def test_reference_finds_the_zooms_too(run):
    result = run("reference", RIG, "--device", "zoom", "--fake")
    assert result.exit_code == 0, result.output
    assert "reference found; now at zoom" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["--device", "zoom", "--axes", "x"], "one axis only"),
        (["--device", "camera_fine"], "has no reference"),
        (["--device", "stage"], "is no device of this rig"),
        ([], "axes to reference: none"),
    ],
)
def test_reference_refuses_before_anything_is_opened(run, prepared, arguments, what):
    emulators = prepared()
    result = run("reference", RIG, *arguments, "--fake")
    assert result.exit_code == 1
    assert what in result.output
    assert emulators[0].events == []
