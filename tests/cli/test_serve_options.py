"""What `serve` refuses before anything is served, and what it writes."""

import socket
import sys

import pytest
import yaml

import microdrivers.rig.serving
from microdrivers.configs import shipped_rig
from microdrivers.devices.drivers import ServeRequest
from microdrivers.rig import load_rig_file
from microdrivers.rig.serving import ServedRig, check_writable

RIG = shipped_rig("microscope")


@pytest.fixture
def own(tmp_path):
    file = tmp_path / "lab.yaml"
    file.write_text(RIG.read_text(encoding="utf-8"), encoding="utf-8")
    return file


@pytest.fixture
def nothing_served(monkeypatch):
    def refuse(*_, **__):
        pytest.fail("something is served")

    monkeypatch.setattr(microdrivers.rig.serving, "ServedRig", refuse)


@pytest.mark.usefixtures("nothing_served")
@pytest.mark.parametrize("emulated", [False, True])
def test_the_served_rig_is_never_overwritten(run, own, emulated):
    own.write_text(own.read_text(encoding="utf-8") + f"emulated: {str(emulated).lower()}\n", encoding="utf-8")
    before = own.read_bytes()
    result = run("serve", own, "--write", own, "--for", 0)
    assert result.exit_code == 1
    assert "this is the rig file that is to be served" in result.output
    assert own.read_bytes() == before


@pytest.mark.usefixtures("nothing_served")
@pytest.mark.parametrize(
    "text", ["notes", "emulated: true\n", "# x, served on the endpoints below\nemulated: true\n", "\tno: yaml: {"]
)
def test_a_file_of_somebody_else_is_not_overwritten(run, own, tmp_path, text):
    other = tmp_path / "other.yaml"
    other.write_text(text, encoding="utf-8")
    result = run("serve", own, "--write", other, "--for", 0)
    assert result.exit_code == 1
    assert "was not written by `microdrivers serve`" in result.output
    assert other.read_text(encoding="utf-8") == text


@pytest.mark.usefixtures("nothing_served")
def test_a_missing_folder_is_one_clear_message(run, own):
    result = run("serve", own, "--write", "none/served.yaml", "--for", 0)
    assert result.exit_code == 1
    assert "none/served.yaml: the folder does not exist" in result.output


@pytest.mark.parametrize("seconds", ["nan", "inf", "-1"])
@pytest.mark.usefixtures("nothing_served")
def test_a_duration_is_a_number_of_seconds(run, own, seconds):
    result = run("serve", own, "--for", seconds)
    assert result.exit_code == 2
    assert "--for" in result.output


@pytest.mark.xdist_group("real_time")
def test_what_serve_wrote_is_overwritten_and_names_a_host_that_others_reach(own, tmp_path):
    file = tmp_path / "served.yaml"
    for _ in range(2):
        with ServedRig(load_rig_file(own), transport="tcp", bind="0.0.0.0") as serving:
            serving.write(file)
    text = file.read_text(encoding="utf-8")
    assert "0.0.0.0" not in text
    host = ServeRequest(transport="tcp", bind="0.0.0.0", folder=tmp_path).host
    ports = [yaml.safe_load(text)["devices"][name]["connection"]["port"] for name in ("sample_stage", "zoom")]
    assert all(port.startswith(f"socket://{host}:") for port in ports)
    assert f"mjpeg+http://{host}:" in text
    check_writable(file, load_rig_file(own))


def test_a_machine_without_a_resolvable_name_gives_an_address(tmp_path, monkeypatch):
    def unknown(*_):
        raise socket.gaierror("unknown")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    for bind in ("0.0.0.0", "::", ""):
        host = ServeRequest(transport="tcp", bind=bind, folder=tmp_path).host
        assert host not in ("", "0.0.0.0", "::")
    assert ServeRequest(transport="tcp", bind="127.0.0.1", folder=tmp_path).host == "127.0.0.1"


@pytest.mark.xdist_group("real_time")
def test_what_is_served_has_patience_with_a_busy_computer_and_says_so(tmp_path):
    data = yaml.safe_load(shipped_rig().read_text(encoding="utf-8"))
    data["devices"]["gripper_stage"] |= {"heartbeat_ms": 2000}
    data["devices"]["gripper_stage"]["connection"] |= {"timeout_s": 3.0}
    lab, file = tmp_path / "lab.yaml", tmp_path / "served.yaml"
    lab.write_text(yaml.safe_dump(data), encoding="utf-8")
    before = load_rig_file(lab).rig
    with ServedRig(load_rig_file(lab)) as serving:
        serving.write(file)
    served = load_rig_file(file)
    assert [guard.stale_after_ms for guard in before.safety.force_guards] == [50.0]  # hardware keeps its own
    assert [guard.stale_after_ms for guard in served.rig.safety.force_guards] == [500.0]
    probe, gripper, force = [served.devices[name].settings for name in ("probe_stage", "gripper_stage", "probe_force")]
    assert (probe.heartbeat_ms, probe.connection.timeout_s) == (500, 1.0)
    assert (gripper.heartbeat_ms, gripper.connection.timeout_s) == (2000, 3.0)  # nobody is made less patient
    assert force.connection.timeout_s == 1.0
    comment = [line for line in file.read_text(encoding="utf-8").splitlines() if line.startswith("#")]
    assert "heartbeat_ms, timeout_s and stale_after_ms allow for a computer" in comment[1]


@pytest.mark.xdist_group("real_time")
@pytest.mark.parametrize("emulated", [True, False])
def test_whoever_loses_an_emulated_device_is_told_to_look_at_the_server(run, own, tmp_path, emulated):
    file = tmp_path / "served.yaml"
    with ServedRig(load_rig_file(own)) as serving:
        serving.write(file)
    text = file.read_text(encoding="utf-8").replace("emulated: true", f"emulated: {str(emulated).lower()}")
    file.write_text(text, encoding="utf-8")
    result = run("move", file, "zoom", "--zoom", 1.0)
    assert result.exit_code == 1
    assert ("see that `microdrivers serve` runs, and that this computer is not too busy" in result.stderr) is emulated


@pytest.mark.xdist_group("real_time")
def test_threads_that_draw_pictures_keep_no_bus_waiting(run, own, monkeypatch):
    usual_s, while_served_s = sys.getswitchinterval(), []
    build = ServedRig.__init__

    def note(self, *arguments, **options):
        while_served_s.append(sys.getswitchinterval())
        build(self, *arguments, **options)

    monkeypatch.setattr(ServedRig, "__init__", note)
    result = run("serve", own, "--for", 0)
    assert result.exit_code == 0, result.output
    assert while_served_s == [pytest.approx(0.0005)]
    assert sys.getswitchinterval() == usual_s
