"""The suites on ports of the operating system, in real time; and cables that are pulled."""

import pytest

from microdrivers.core.errors import LinkLost
from tests.conformance import stage_suite, zoom_suite
from tests.conformance.bench import served, served_stage_bench, served_zoom_bench

# One after the other: they run in real time.
pytestmark = pytest.mark.xdist_group("real_time")

STAGE, ZOOM = stage_suite.SUITE.checks, zoom_suite.SUITE.checks


@pytest.mark.parametrize("name", STAGE)
def test_gcs_stage_on_a_pseudo_terminal(name):
    with served_stage_bench("pty") as bench:
        STAGE[name](bench)


@pytest.mark.parametrize("name", ZOOM)
def test_az_zoom_on_a_pseudo_terminal(name):
    with served_zoom_bench("pty") as bench:
        ZOOM[name](bench)


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


def test_both_wires_carry_the_same_requests(tmp_path):
    """What a driver sends does not depend on where the emulator stands."""
    from tests.conformance.bench import stage_bench

    def requests(log):
        return [bytes(data) for _, side, data in log if side == "host" and b"MOV" in data]

    def drive(bench):
        bench.stage.move_to(x_um=7600.0, speed_um_s=1000.0)
        bench.stage.move_to(y_um=7410.0, theta_deg=0.1)

    with stage_bench() as bench:
        drive(bench)
        from microdrivers.fakes.wire import wire_named

        in_process = requests(wire_named("sample_stage").log)
    with served("pty", "sample_stage") as (rig, serving):
        rig.devices["sample_stage"].reference(["x", "y", "theta"])
        rig.devices["sample_stage"].move_to(x_um=7600.0, speed_um_s=1000.0)
        rig.devices["sample_stage"].move_to(y_um=7410.0, theta_deg=0.1)
        on_port = requests(serving.simulation.emulations["sample_stage"].wire_log)
    assert [line for data in on_port for line in data.split(b"\n") if line.startswith(b"MOV")] == [
        line for data in in_process for line in data.split(b"\n") if line.startswith(b"MOV")
    ]


def test_a_served_rig_file_says_that_emulators_stand_behind_its_ports():
    with served("pty", "zoom") as (rig, _):
        assert rig.file.emulated
        assert not rig.fake
