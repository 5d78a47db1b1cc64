"""What the commands tell somebody to do is a command, and names what was typed."""

from pathlib import Path

import pytest
import yaml

from microdrivers.cli.rig_options import saying_commands
from microdrivers.configs import shipped_rig
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.errors import ConnectError, DeviceFault, LinkLost, NotReferenced
from microdrivers.devices.fine_stage import FineStage
from microdrivers.devices.xytheta_stage import XYThetaStage
from microdrivers.rig import Rig, open_rig
from microdrivers.routines.commands import as_commands
from microdrivers.routines.force import PressExperiment
from microdrivers.routines.progress import SilentProgress

LAB = Path("lab.yaml")


@pytest.mark.parametrize(
    ("remedy", "said"),
    [
        ("then clear_fault()", "then `microdrivers clear-fault lab.yaml probe_stage`"),
        ("reference(['z', 'x'])", "`microdrivers reference lab.yaml --device probe_stage --axes z,x`"),
        (
            "move_by(dx_um=-3, dz_um=110.5) leads out",
            "`microdrivers move lab.yaml probe_stage --by --x-um -3 --z-um 110.5` leads out",
        ),
        ("then reference() again", "then `microdrivers reference lab.yaml --device probe_stage` again"),
        ("stop() and retract()", "`microdrivers stop lab.yaml` and `microdrivers move lab.yaml probe_stage --retract`"),
        ("read() a fresh one", "read() a fresh one"),
    ],
)
def test_calls_become_commands(remedy, said):
    assert as_commands(remedy, LAB, "probe_stage") == said


def test_without_a_device_only_a_stop_is_a_command():
    assert as_commands("clear_fault() or stop()", Path("my lab.yaml"), "") == (
        "clear_fault() or `microdrivers stop 'my lab.yaml'`"
    )


def test_every_part_of_an_error_names_commands():
    parts = [
        DeviceFault("stands", remedy="clear_fault()", device="zoom"),
        LinkLost("silent", remedy="reference(['y'])", device="gripper_stage"),
    ]
    with pytest.raises(ConnectError) as caught, saying_commands(LAB):
        raise ConnectError("two:", parts)
    assert "to do: `microdrivers clear-fault lab.yaml zoom`" in str(caught.value)
    assert "to do: `microdrivers reference lab.yaml --device gripper_stage --axes y`" in str(caught.value)


@pytest.fixture
def can_file(tmp_path):
    data = yaml.safe_load(shipped_rig().read_text(encoding="utf-8"))
    for section in ("microscope", "probe"):
        data.pop(section)
    data["safety"] = "none"
    data["devices"] = {name: data["devices"][name] for name in ("probe_stage", "probe_force")}
    file = tmp_path / "can.yaml"
    file.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    return file


def test_a_fine_stage_is_referenced_in_its_own_order(run, can_file):
    result = run("reference", can_file, "--device", "probe_stage", "--fake")
    assert result.exit_code == 0, result.output
    assert "probe_stage: z, x, y referenced" in result.stdout
    assert "microdrivers reference lab.yaml --device probe_stage" in run("reference", "--help").stdout


def test_another_order_is_refused_with_the_command_for_the_right_one(run, can_file):
    result = run("reference", can_file, "--device", "probe_stage", "--axes", "x,y", "--fake")
    assert result.exit_code == 1
    assert "must not be referenced before z" in result.output
    assert f"to do: `microdrivers reference {can_file} --device probe_stage --axes z,x,y`" in result.output


def test_an_xytheta_stage_still_needs_its_axes_named(run):
    result = run("reference", shipped_rig("microscope"), "--fake")
    assert result.exit_code == 1
    assert "--axes x,y,theta" in result.output


@pytest.mark.parametrize(("name", "kind"), [("sample_stage", XYThetaStage), ("probe_stage", FineStage)])
def test_a_relative_move_without_reference_is_not_called_absolute(name, kind):
    with (
        open_rig(shipped_rig(), fake=True, clock=SimulatedClock(), devices=[name]) as rig,
        pytest.raises(NotReferenced, match="reference of axis x is not known") as caught,
    ):
        rig.device(name, kind).move_by(dx_um=3.0)
    assert "absolute" not in str(caught.value)
    assert "nor by a distance" in caught.value.what


def test_a_misspelt_specimen_is_blamed_on_its_option(run):
    result = run("calibrate", "force", "--specimen", "slip_corected")
    assert result.exit_code == 1
    assert "error: --specimen: 'slip_corected' is not possible here: it must be 'none', 'single'," in result.output
    assert "did you mean 'slip_corrected'?" in result.output
    assert "world_overrides" not in result.output


def test_a_log_of_nothing_but_can_frames_says_so(run, can_file, tmp_path):
    log = tmp_path / "can.jsonl"
    assert run("status", can_file, "--fake", "--wire-log", log).exit_code == 0
    result = run("status", shipped_rig(), "--wire-replay", log)
    assert result.exit_code == 1
    assert "nothing but frames of CAN socketcan:can0, and CAN buses are not replayed" in result.output


@pytest.mark.xdist_group("real_time")
def test_serve_says_how_others_reach_a_bus_and_that_they_take_turns(run, can_file):
    result = run("serve", can_file, "--for", 0, "--can", "slcan")
    assert result.exit_code == 0, result.output
    (line,) = [line for line in result.stdout.splitlines() if "serial CAN adapter" in line]
    assert "one program at a time has it, with all devices on its bus (probe_stage, probe_force)" in line
    channel = result.stdout.splitlines()[1].split()[1]
    assert f"can.Bus(interface='slcan', channel='{channel}', bitrate=500000)" in line


def test_a_probe_without_reference_is_told_the_command_that_takes_its_name(run, can_file, monkeypatch):
    monkeypatch.setattr(Rig, "fake", property(lambda _rig: False))
    with (
        open_rig(shipped_rig(), fake=True, clock=SimulatedClock(), devices="probe") as rig,
        pytest.raises(NotReferenced) as caught,
    ):
        PressExperiment(rig).prepare(SilentProgress())
    _, _, command = caught.value.remedy.partition("microdrivers ")
    monkeypatch.undo()
    asked = [str(can_file) if word == str(shipped_rig()) else word for word in command.split()]
    assert run(*asked, "--fake").exit_code == 0
