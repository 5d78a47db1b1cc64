"""--wire-log and --wire-replay as a user meets them."""

import json
import re

import pytest
import yaml

from microdrivers.configs import shipped_rig
from microdrivers.devices.wire_log_format import read_wire_log
from microdrivers.rig import load_rig_file, open_rig
from microdrivers.rig.serving import ServedRig

RIG = shipped_rig("microscope")

MOVE = ["move", RIG, "sample_stage", "--x-um", 7600, "--y-um", 7450]


@pytest.mark.parametrize("command", ["status", "doctor", "move", "reference", "stop", "snap"])
def test_every_command_on_a_rig_has_both_options(run, command):
    text = run(command, "--help").output
    assert "--wire-log FILE" in text
    assert "--wire-replay FILE" in text
    assert "must not exist" in re.sub(r"\s+", " ", text)


@pytest.mark.parametrize("command", [["serve"], ["calibrate", "optics"]])
def test_the_other_commands_can_log(run, command):
    assert "--wire-log FILE" in run(*command, "--help").output


@pytest.mark.parametrize(
    "command",
    [["status"], ["doctor", "--motion"], ["stop"], ["reference", "--axes", "x,y"], ["reference", "--device", "zoom"]],
    ids=" ".join,
)
def test_a_command_prints_the_same_from_its_log(run, command):
    name, *options = command
    logged = run(name, RIG, *options, "--fake", "--wire-log", "wire.jsonl")
    replayed = run(name, RIG, *options, "--wire-replay", "wire.jsonl")
    assert logged.exit_code == replayed.exit_code == 0, replayed.output

    def devices(text):
        """What is said of devices, the camera and headings excepted."""
        return [line for line in re.split(r"camera_fine|\d devices", text)[0].splitlines() if "microscope" not in line]

    assert devices(replayed.stdout) == devices(logged.stdout) != []


def test_a_move_replays_and_another_move_does_not(run, caplog):
    logged = run(*MOVE, "--fake", "--wire-log", "wire.jsonl")
    replayed = run(*MOVE, "--wire-replay", "wire.jsonl")
    assert replayed.exit_code == 0, replayed.output
    assert replayed.stdout == logged.stdout
    assert "no answer" not in caplog.text
    other = run("move", RIG, "sample_stage", "--x-um", 7700, "--wire-replay", "wire.jsonl")
    assert other.exit_code == 1
    assert re.search(r'no answer to "VEL|no answer to "MOV', caplog.text)


def test_a_log_from_hardware_replays_without_what_only_emulators_need(run, tmp_path):
    run(*MOVE, "--fake", "--wire-log", "wire.jsonl")
    log = tmp_path / "wire.jsonl"
    log.write_text(log.read_text(encoding="utf-8").replace('"source": "fake"', '"source": "live"'), encoding="utf-8")
    replayed = run(*MOVE, "--wire-replay", "wire.jsonl")
    assert replayed.exit_code == 1
    assert "referencing" not in replayed.output
    assert "microdrivers reference" in replayed.output


def test_a_cut_reply_fails_again_in_the_replay(run, tmp_path):
    run("status", RIG, "--fake", "--wire-log", "wire.jsonl")
    log = tmp_path / "wire.jsonl"
    lines = log.read_text(encoding="utf-8").splitlines(keepends=True)
    stop = next(number for number, line in enumerate(lines) if "u0018" in line)
    end = max(n for n, line in enumerate(lines[:stop]) if '"sample_stage", "direction": "received"' in line)
    log.write_text("".join(lines[:end] + lines[end + 1 :]), encoding="utf-8")
    result = run("status", RIG, "--wire-replay", "wire.jsonl")
    assert result.exit_code == 1
    stage, zoom = result.stdout.splitlines()
    assert "only a part of the reply" in stage
    assert "steps" in zoom


def test_the_log_tells_what_was_run_on_which_rig_and_holds_events(run, tmp_path):
    run("snap", RIG, "--out", "frame.png", "--fake", "--seed", 4, "--wire-log", "wire.jsonl")
    log = read_wire_log(tmp_path / "wire.jsonl")
    assert (log.header.source, log.header.seed) == ("fake", 4)
    assert log.header.rig == load_rig_file(RIG).as_data()
    assert [record.kind for record in log.records] == ["opened", "stopped", "closed"]


def test_an_existing_log_is_kept_and_nothing_is_opened(run, prepared, tmp_path):
    emulators = prepared()
    (tmp_path / "wire.jsonl").write_text("evidence", encoding="utf-8")
    for command in (
        ["status", RIG, "--fake"],
        ["calibrate", "optics"],
        ["serve", RIG],
    ):
        result = run(*command, "--wire-log", "wire.jsonl")
        assert result.exit_code == 1
        assert "wire.jsonl: the file exists" in result.output
    assert not emulators
    assert (tmp_path / "wire.jsonl").read_text(encoding="utf-8") == "evidence"


def test_a_log_that_cannot_be_written_is_refused(run):
    result = run("status", RIG, "--fake", "--wire-log", "none/wire.jsonl")
    assert result.exit_code == 1
    assert "none/wire.jsonl: the wire log cannot be written there" in result.output


def test_a_command_that_opened_nothing_leaves_no_log(run, tmp_path, caplog):
    assert run("move", RIG, "zoom", "--x-um", 1, "--fake", "--wire-log", "wire.jsonl").exit_code == 1
    assert not (tmp_path / "wire.jsonl").exists()
    assert "nothing passed on any wire" in caplog.text


@pytest.mark.parametrize("options", [["--fake"], ["--seed", 1], ["--world", "world.yaml"]])
def test_replay_and_simulation_exclude_each_other(run, options):
    result = run("status", RIG, "--wire-replay", "wire.jsonl", *options)
    assert result.exit_code == 1
    assert "takes the place of a simulation" in result.output


def test_images_have_no_wires(run):
    result = run("calibrate", "optics", "--images", "folder", "--wire-log", "wire.jsonl")
    assert result.exit_code == 1
    assert "leave out" in result.output


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (None, "there is no such file"),
        ("rig: 1\n", "not a wire log"),
        ('{"format": "microdrivers-wire-log", "version": 9}\n', "version 9"),
    ],
)
def test_a_file_that_is_no_wire_log_is_refused(run, tmp_path, text, what):
    if text is not None:
        (tmp_path / "wire.jsonl").write_text(text, encoding="utf-8")
    result = run("status", RIG, "--wire-replay", "wire.jsonl")
    assert result.exit_code == 1
    assert what in result.output


@pytest.mark.xdist_group("real_time")
@pytest.mark.parametrize("transport", ["pty", "tcp"])
def test_a_served_rig_logs_what_its_emulators_see(run, tmp_path, transport):
    data = yaml.safe_load(RIG.read_text(encoding="utf-8"))
    del data["microscope"], data["devices"]["camera_fine"]
    rig_file, served_file, log = tmp_path / "rig.yaml", tmp_path / "served.yaml", tmp_path / "wire.jsonl"
    rig_file.write_text(yaml.safe_dump(data), encoding="utf-8")
    with ServedRig(load_rig_file(rig_file), transport=transport, wire_log=log) as serving:
        serving.write(served_file)
        with open_rig(served_file, wire_log=tmp_path / "host.jsonl") as rig:
            stage, zoom = (rig.devices[name].read() for name in ("sample_stage", "zoom"))

    def sent(file):
        return [
            (record.device, record.data)
            for record in read_wire_log(file).records
            if getattr(record, "direction", "") == "sent"
        ]

    assert read_wire_log(log).header.source == "served"
    for device in ("sample_stage", "zoom"):
        on_port, by_host = (
            b"".join(data for name, data in sent(file) if name == device) for file in (log, tmp_path / "host.jsonl")
        )
        assert by_host.startswith(on_port[:-1])  # a stop sent while closing may not have arrived any more
    result = run("status", rig_file, "--wire-replay", log, "--json")
    found = json.loads(result.stdout)["devices"]
    assert found["sample_stage"]["state"]["x_um"] == stage.x_um
    assert found["zoom"]["state"]["position_steps"] == zoom.position_steps
