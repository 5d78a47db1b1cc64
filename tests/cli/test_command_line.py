"""The command line as a user meets it."""

import json
import signal
import subprocess
import sys

import pytest
from click.testing import CliRunner

from microdrivers.cli import main as main_module
from microdrivers.cli.main import main
from microdrivers.configs import shipped_rig
from microdrivers.results.optics import read_result


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Run a command in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        return CliRunner().invoke(main, [str(argument) for argument in arguments], catch_exceptions=False)

    return call


@pytest.mark.parametrize(
    "command",
    [[], ["calibrate"], ["calibrate", "optics"], ["check"], ["reference"]],
    ids=lambda c: " ".join(c) or "top",
)
def test_every_command_has_help_with_an_example(run, command):
    result = run(*command, "--help")
    assert result.exit_code == 0
    assert "Usage:" in result.output
    if command not in ([], ["calibrate"]):
        assert "microdrivers " + " ".join(command) in result.output.replace("main", "microdrivers")


def test_help_imports_nothing_heavy():
    code = (
        "import sys; from microdrivers.cli.main import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'numpy', 'cv2', 'pymodbus', 'can', 'matplotlib', 'pydantic', 'serial', 'yaml'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr


def test_check_says_what_is_there(run):
    assert "no force guard watches gripper_force" in run("check", shipped_rig()).stdout
    result = run("check", shipped_rig("microscope"))
    assert result.exit_code == 0
    assert "sample_stage" in result.output
    assert "pi-gcs-xytheta" in result.output


def test_an_error_is_one_message_with_place_and_remedy_and_no_traceback(run, tmp_path):
    file = tmp_path / "lab.yaml"
    file.write_text(shipped_rig("microscope").read_text().replace("exposure_ms", "exposure_us"))
    result = run("check", file)
    assert result.exit_code == 1
    assert f"{file}:" in result.output
    assert "did you mean 'exposure_ms'" in result.output
    assert "Traceback" not in result.output


def test_debug_shows_the_traceback(run, tmp_path):
    from microdrivers.core.errors import ConfigError

    with pytest.raises(ConfigError):
        run("--debug", "check", tmp_path / "none.yaml")


def test_hardware_that_is_not_there_is_named(run):
    result = run("calibrate", "optics", "--rig", shipped_rig("microscope"))
    assert result.exit_code == 1
    assert "3 of 3 devices could not be opened" in result.output
    assert "/dev/ttyUSB0" in result.output
    assert "--fake" in result.output


def test_the_default_run_writes_result_calibration_and_report(run, tmp_path):
    result = run("calibrate", "optics", "--out", "out")
    assert result.exit_code == 0, result.output
    found = read_result(tmp_path / "out" / "result.json")
    assert found.complete
    assert found.truth is not None
    assert found.zoom_change is not None
    assert found.zoom_change.iterations_to_0p1_px <= 10
    assert abs(found.truth.errors["scale_percent"]) < 0.1
    assert abs(found.truth.errors["angle_deg"]) < 0.03
    assert found.valid_for.camera == "camera_fine"
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "http://" not in report.replace("http://www.w3.org", "")
    assert "https://" not in report


SHORT = ("calibrate", "optics", "--frames", "60", "--no-record", "--out", "out")


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory):
    """A short run with seed 5 in a process of its own: what it printed, and its folder."""
    folder = tmp_path_factory.mktemp("elsewhere")
    ran = subprocess.run(
        [sys.executable, "-m", "microdrivers", *SHORT, "--seed", "5", "--json"],
        cwd=folder, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return ran, folder / "out"


@pytest.mark.xdist_group("a process of its own")
def test_json_goes_to_standard_output_alone(elsewhere):
    ran, _ = elsewhere
    assert ran.returncode == 0, ran.stderr
    assert json.loads(ran.stdout)["kind"] == "optical-calibration"


@pytest.mark.xdist_group("a process of its own")
def test_a_seed_gives_the_same_bits_twice_and_another_seed_others(run, tmp_path, elsewhere):
    def bits(folder):
        data = json.loads((folder / "result.json").read_text())
        data["provenance"].pop("created_utc")
        data["provenance"].pop("command")
        return data

    assert run(*SHORT, "--seed", "5").exit_code == 0
    first = bits(tmp_path / "out")
    assert first == bits(elsewhere[1])
    (tmp_path / "out" / "result.json").unlink()
    assert run(*SHORT, "--seed", "6").exit_code == 0
    assert bits(tmp_path / "out")["projection"] != first["projection"]


def test_reference_on_the_emulated_rig(run):
    result = run("reference", shipped_rig("microscope"), "--axes", "theta,x,y", "--fake")
    assert result.exit_code == 0, result.output
    assert "theta, x, y referenced" in result.output


@pytest.mark.parametrize("axes", ["z", "x,x", ","])
def test_reference_refuses_axes_that_are_not_there(run, axes):
    result = run("reference", shipped_rig("microscope"), "--axes", axes, "--fake")
    assert result.exit_code == 1
    assert "axes to reference" in result.output


def test_ctrl_c_while_modules_are_imported_is_no_failed_import(monkeypatch):
    name = "microdrivers.core.clock.interruption"
    monkeypatch.delitem(sys.modules, name)
    with pytest.raises(KeyboardInterrupt):
        main_module._interrupt(signal.SIGINT, None)
    assert name not in sys.modules  # an import within another one might meet half a module
