"""The stage and the zoom motor on a real serial port, with its parity and baud rate.

The guest is slow and its pace uneven: nothing here depends on how long something takes.
"""

import pytest

from microdrivers.core.errors import LinkLost, LinkTimeout, MoveCancelled

pytestmark = pytest.mark.vm

NOISE_UM = 0.1


@pytest.fixture
def on_the_uart():
    from tests.vm.uart_bench import on_the_uart

    return on_the_uart


def test_the_gcs_stage_identifies_references_moves_and_stops(on_the_uart):
    with on_the_uart("sample_stage") as bench:
        stage, axis = bench.device, bench.world.stage_axes["x"]
        stage.open()
        assert "C-884" in stage.info.model
        assert stage.info.serial_number
        assert not stage.read().referenced

        stage.reference(["x", "y", "theta"])
        pose = stage.move_to(x_um=7530.0, theta_deg=0.2)
        assert pose.on_target
        assert not pose.moving
        assert pose.x_um == pytest.approx(7530.0, abs=stage.axes["x"].tolerance + NOISE_UM)
        assert pose.theta_deg == pytest.approx(0.2, abs=1e-3)
        assert axis.position_at(bench.clock.now_ns()) == pytest.approx(pose.x_um, abs=0.5 + NOISE_UM)

        move = stage.start_move_to(x_um=14_000.0, speed_um_s=100.0)
        stage.stop()
        with pytest.raises(MoveCancelled):
            move.wait()
        at_rest_um = stage.read().x_um
        assert at_rest_um < 13_000.0
        bench.clock.sleep(0.5)
        assert stage.read().x_um == pytest.approx(at_rest_um, abs=2 * NOISE_UM)


def test_the_az_zoom_identifies_moves_and_stops_with_even_parity(on_the_uart):
    from tests.vm.uart_bench import HOST_PORT, parity_of

    with on_the_uart("zoom", speed_steps_s=500) as bench:
        zoom = bench.device
        zoom.open()
        assert parity_of(HOST_PORT) == "E"
        zoom.reference()
        sample = zoom.move_to(zoom=1.0)
        assert sample.on_target
        assert sample.zoom == pytest.approx(1.0, rel=1e-3)
        steps = bench.world.zoom_axis.position_at(bench.clock.now_ns())
        assert steps == pytest.approx(zoom.curve.steps_at(1.0), abs=2)

        move = zoom.start_move_to(zoom=11.0)
        zoom.stop()
        bench.clock.sleep(0.5)  # it awaits no reply, and the other end tells requests apart by 0.1 s of silence
        with pytest.raises(MoveCancelled):
            move.wait()
        at_rest_steps = zoom.read().position_steps
        assert at_rest_steps < zoom.curve.steps_at(9.0)
        bench.clock.sleep(0.5)
        assert zoom.read().position_steps == pytest.approx(at_rest_steps, abs=1)


def test_the_wrong_parity_is_a_typed_error_that_names_it(on_the_uart):
    with on_the_uart("zoom", host_parity="N", timeout_s=1.0) as bench:
        with pytest.raises(LinkTimeout, match="parity N") as caught:
            bench.device.open()
        assert "parity" in caught.value.remedy
        assert bench.device.link == "closed"


def test_a_port_in_use_is_refused_and_free_again_after_closing(on_the_uart):
    with on_the_uart("sample_stage") as bench:
        bench.device.open()
        with pytest.raises(LinkLost, match="second: cannot open port /dev/ttyS1") as caught:
            bench.second.open()
        assert "close it first" in caught.value.remedy
        assert bench.device.read().x_um == pytest.approx(bench.device.read().x_um, abs=2 * NOISE_UM)
        bench.device.close()
        bench.second.open()
