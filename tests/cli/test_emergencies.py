"""stop with obstacles, faults from the command line, and emulated rigs on ports."""

import json
import re
import socket
import threading

import pytest
import yaml

from microdrivers.configs import shipped_rig
from microdrivers.fakes.wire import wire_named

RIG = shipped_rig("microscope")
ALARM = 0x30


def test_stop_stops_although_the_wire_log_cannot_be_written(run, prepared, tmp_path):
    emulators = prepared()
    (tmp_path / "wire.jsonl").write_text("evidence", encoding="utf-8")
    result = run("stop", RIG, "--fake", "--wire-log", "wire.jsonl")
    assert result.exit_code == 1
    assert result.stdout.count("told to stop") == 2
    assert "stop #24" in [text for _, text in emulators[0].events]
    assert "no wire log of this: wire.jsonl: the file exists" in result.stderr
    assert (tmp_path / "wire.jsonl").read_text(encoding="utf-8") == "evidence"


def test_stop_names_a_fault_and_the_command_that_clears_it(run, prepared):
    prepared(alarmed)
    result = run("stop", RIG, "--fake")
    assert re.search(r"zoom\s+told to stop: .*; FAULT: alarm 30h is on: overload", result.stdout)
    assert f"microdrivers clear-fault {RIG} zoom" in result.stdout


def test_stop_names_another_program_first(run):
    result = run("stop", RIG)
    assert result.stdout.count("to do: another program may hold the port") == 2


@pytest.mark.xdist_group("real_time")
def test_stop_at_a_tcp_port_that_hangs_up_says_that_it_was_probably_not_reached(run, tmp_path):
    data = yaml.safe_load(RIG.read_text(encoding="utf-8"))
    del data["microscope"], data["devices"]["camera_fine"], data["devices"]["zoom"]
    with socket.create_server(("127.0.0.1", 0)) as listener:
        data["devices"]["sample_stage"]["connection"]["port"] = f"socket://127.0.0.1:{listener.getsockname()[1]}"
        file = tmp_path / "tcp.yaml"
        file.write_text(yaml.safe_dump(data), encoding="utf-8")

        def turn_away():
            newcomer, _ = listener.accept()
            newcomer.close()

        porter = threading.Thread(target=turn_away)
        porter.start()
        result = run("stop", file)
        porter.join()
    assert result.exit_code == 1
    assert re.search(r"sample_stage\s+(PROBABLY )?NOT REACHED", result.stdout)
    assert "to do: another program may hold the port" in result.stdout


def alarmed(rig):
    wire_named("zoom").emulator.device.raise_alarm(rig.clock.now_ns(), ALARM)


@pytest.mark.parametrize("command", ["status", "doctor"])
def test_a_fault_names_the_command_that_clears_it(run, prepared, command):
    prepared(alarmed)
    result = run(command, RIG, "--fake")
    assert f"microdrivers clear-fault {RIG} zoom" in result.stdout


def test_clear_fault_shows_and_clears_it_and_says_how_the_device_is(run, prepared):
    prepared(alarmed)
    result = run("clear-fault", RIG, "zoom", "--fake")
    assert result.exit_code == 0, result.output
    assert "zoom: FAULT: alarm 30h is on: overload" in result.stdout
    assert re.search(r"zoom: fault cleared; now at zoom \d", result.stdout)
    assert "flags ALARM" not in result.stdout


def test_clear_fault_of_hardware_asks_first(run, bench):
    rig, file = bench
    drive = wire_named("zoom").emulator.device
    drive.raise_alarm(rig.clock.now_ns(), ALARM)
    refused = run("clear-fault", file, "zoom", stdin="n\n")
    assert refused.exit_code == 1
    assert "is the way free?" in refused.stderr
    assert drive.alarm == ALARM
    assert run("clear-fault", file, "zoom", "--yes").exit_code == 0
    assert drive.alarm == 0


@pytest.mark.parametrize(
    ("device", "exit_code", "what"),
    [("zoom", 0, "no fault is known"), ("camera_fine", 1, "is a camera"), ("stage", 1, "is no device of this rig")],
)
def test_clear_fault_without_a_fault(run, device, exit_code, what):
    result = run("clear-fault", RIG, device, "--fake")
    assert result.exit_code == exit_code
    assert what in result.output


def test_a_served_rig_is_called_emulated(run, bench):
    _, file = bench
    file.write_text(file.read_text(encoding="utf-8") + "emulated: true\n", encoding="utf-8")
    assert "emulated, on ports" in run("doctor", file).stdout.splitlines()[0]
    assert json.loads(run("status", file, "--json").stdout)["fake"] is True


@pytest.mark.parametrize("swapped", ["sample_stage", "zoom"])
def test_swapped_ports_are_thought_of(run, bench, swapped):
    _, file = bench
    other = {"sample_stage": "zoom", "zoom": "sample_stage"}[swapped]
    data = yaml.safe_load(file.read_text(encoding="utf-8"))
    del data["microscope"], data["devices"]["camera_fine"], data["devices"][other]
    data["devices"][swapped]["connection"]["port"] = f"fake://{other}"
    file.write_text(yaml.safe_dump(data), encoding="utf-8")
    assert "or another device is behind this port" in run("status", file).stdout
