"""The suites on ports of the operating system, in real time; and cables that are pulled."""

import threading

import pytest
import yaml

from microdrivers.backends.oriental_az.zoom import AzZoomMotor
from microdrivers.backends.pi_gcs.stage import GcsXYThetaStage
from microdrivers.configs import shipped_rig
from microdrivers.core.errors import LinkLost
from tests.conformance import live_suite, stage_suite, zoom_suite
from tests.conformance.bench import CHAINED, served, served_stage_bench, served_zoom_bench, stage_bench, zoom_bench

# One after the other: they run in real time.
pytestmark = pytest.mark.xdist_group("real_time")


@pytest.fixture
def modbus_tcp_rig(tmp_path):
    """The workstation with its zoom motor behind a Modbus TCP gateway."""
    data = yaml.safe_load(shipped_rig("microscope").read_text(encoding="utf-8"))
    data["devices"]["zoom"]["connection"] = {"port": "socket://127.0.0.1:502", "framing": "tcp", "timeout_s": 0.5}
    file = tmp_path / "gateway.yaml"
    file.write_text(yaml.safe_dump(data), encoding="utf-8")
    return file


STAGE, ZOOM, LIVE = stage_suite.SUITE.checks, zoom_suite.SUITE.checks, live_suite.SUITE.checks


@pytest.mark.parametrize("name", STAGE)
def test_gcs_stage_on_a_pseudo_terminal(name):
    stage_suite.SUITE.hold_in_real_time(name, lambda: served_stage_bench("pty"))


@pytest.mark.parametrize("name", ZOOM)
def test_az_zoom_on_a_pseudo_terminal(name):
    zoom_suite.SUITE.hold_in_real_time(name, lambda: served_zoom_bench("pty"))


@pytest.mark.parametrize("name", ["moves_each_axis_its_own_way", "a_stop_ends_the_motion_and_the_move"])
def test_gcs_stage_on_tcp(name):
    with served_stage_bench("tcp") as bench:
        STAGE[name](bench)


@pytest.mark.parametrize("name", ["reaches_the_zoom_that_is_asked_for", "a_stop_ends_the_motion_and_the_move"])
def test_az_zoom_on_tcp(name):
    with served_zoom_bench("tcp") as bench:
        ZOOM[name](bench)


def test_a_pulled_cable_is_a_typed_error_and_the_device_is_usable_when_it_is_back():
    with served("pty", "sample_stage") as (rig, serving):
        stage = rig.devices["sample_stage"]
        serial_number = stage.info.serial_number
        cable = serving.endpoints["sample_stage"].control
        cable.unplug()
        with pytest.raises(LinkLost, match="sample_stage") as caught:
            stage.read()
        assert "cable" in caught.value.remedy
        stage.close()
        with pytest.raises(LinkLost, match="cannot open port"):
            stage.open()
        cable.plug_in()
        stage.open()
        assert stage.info.serial_number == serial_number
        assert stage.read().x_um == pytest.approx(0.0, abs=1.0)


def test_a_second_host_is_turned_away():
    with served("pty", "sample_stage") as (rig, _):
        stage = rig.devices["sample_stage"]
        second = type(stage)("second", rig.description.devices["sample_stage"].settings, clock=rig.clock, bus=rig.bus)
        with pytest.raises(LinkLost, match="uses the port"):
            second.open()


@pytest.mark.ports
@pytest.mark.parametrize("name", STAGE)
def test_a_chain_of_three_controllers_on_a_pseudo_terminal(name):
    stage_suite.SUITE.hold_in_real_time(name, lambda: served_stage_bench("pty", file=CHAINED))


@pytest.mark.parametrize("name", ZOOM)
def test_az_zoom_over_modbus_tcp(name, modbus_tcp_rig):
    zoom_suite.SUITE.hold_in_real_time(name, lambda: served_zoom_bench("tcp", file=modbus_tcp_rig))


@pytest.mark.parametrize("file", [None, CHAINED], ids=["one controller", "chain"])
@pytest.mark.parametrize("name", LIVE)
def test_gcs_stage_with_threads(name, file):
    with served_stage_bench("pty", file=file) as bench:
        LIVE[name](bench)


@pytest.mark.parametrize("name", LIVE)
def test_az_zoom_with_threads(name):
    with served_zoom_bench("pty") as bench:
        LIVE[name](bench)


class StopWaitsForALock:
    """Planted: reads and stops take the same lock."""

    _exchange_lock: threading.RLock

    def _read(self):
        with self._exchange_lock:
            return super()._read()

    def _stop(self):
        with self._exchange_lock:
            super()._stop()


class StageWhoseStopWaits(StopWaitsForALock, GcsXYThetaStage):
    _exchange_lock = threading.RLock()


class ZoomWhoseStopWaits(StopWaitsForALock, AzZoomMotor):
    _exchange_lock = threading.RLock()


@pytest.mark.parametrize(
    ("make_bench", "fault"), [(served_stage_bench, StageWhoseStopWaits), (served_zoom_bench, ZoomWhoseStopWaits)]
)
def test_a_stop_that_waits_for_a_lock_is_found_by_name(make_bench, fault):
    with make_bench("pty", fault) as bench, pytest.raises(AssertionError):
        LIVE["a_stop_waits_for_no_exchange"](bench)


def _stage_requests(log):
    """Everything but polls, as lines: those depend on how long a move takes in real time."""
    sent = b"".join(bytes(data) for _, side, data in log if side == "host")
    lines = sent.replace(b"\x04", b"").replace(b"\x07", b"").split(b"\n")
    return [line for line in lines if line not in (b"", b"POS?")]


def _zoom_requests(log):
    """Everything but reads of motion and output, as frames."""
    frames = [bytes(data) for _, side, data in log if side == "host"]
    return [frame for frame in frames if frame[1] != 3 or frame[2:4] not in (b"\x00\xc6", b"\x00\x7e")]


def _drive_stage(bench):
    stage = bench.stage
    stage.move_to(x_um=7600.0, speed_um_s=1000.0)
    stage.move_to(y_um=7410.0, theta_deg=0.1)
    stage.start_move_to(x_um=9000.0)
    stage.stop()
    stage.move_by(dx_um=5.0)


def _drive_zoom(bench):
    bench.zoom.move_to(zoom=1.2)
    bench.zoom.move_to(zoom=0.9)
    bench.zoom.start_move_to(zoom=2.0)
    bench.zoom.stop()
    bench.zoom.move_to(zoom=1.0)


@pytest.mark.parametrize(
    ("name", "in_process", "on_port", "drive", "requests"),
    [
        ("sample_stage", stage_bench, served_stage_bench, _drive_stage, _stage_requests),
        ("zoom", zoom_bench, served_zoom_bench, _drive_zoom, _zoom_requests),
    ],
)
def test_both_wires_carry_the_same_requests(name, in_process, on_port, drive, requests):
    """What a driver sends does not depend on where the emulator stands; where a stop catches a move does."""
    from microdrivers.fakes.wire import wire_named

    sent = []
    for make_bench in (in_process, lambda: on_port("pty")):
        with make_bench() as bench:
            drive(bench)
            sent.append(requests(wire_named(name).log))
    assert len(sent[0]) >= 10
    assert len(sent[0]) == len(sent[1])
    # The move after the stop goes to where the stop has caught the stage, which real time decides.
    different = [pair for pair in zip(*sent, strict=True) if pair[0] != pair[1]]
    assert len(different) <= 2
    assert all(b"MOV" in first or first[1] == 16 for first, _ in different)


def test_a_served_rig_file_says_that_emulators_stand_behind_its_ports():
    with served("pty", "zoom") as (rig, _):
        assert rig.file.emulated
        assert not rig.fake
