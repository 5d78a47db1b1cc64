"""Opening a GCS stage: identity, axes, limits and units."""

from __future__ import annotations

import logging
import math
import subprocess
import sys

import pydantic
import pytest

from microdrivers.backends.pi_gcs import DRIVER
from microdrivers.backends.pi_gcs.axis_map import AxisMap
from microdrivers.backends.pi_gcs.settings import GcsStageSettings, LinearAxis
from microdrivers.core.errors import (
    ConfigError,
    LinkTimeout,
    ProtocolError,
)
from microdrivers.core.units import Range
from tests.backends.scripted_gcs import MOVING_COMMANDS, Bench, Rig, ScriptedController, axis_settings

# ---------------------------------------------------------------------- driver and settings


def test_the_driver_is_announced_without_loading_a_serial_library() -> None:
    assert DRIVER.settings is GcsStageSettings
    script = "import sys, microdrivers.backends.pi_gcs; sys.exit('serial' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0


@pytest.mark.parametrize(
    "change", [{"travel_um": (5.0, 5.0)}, {"travel_um": (10.0, 0.0)}, {"tolerance_um": 0.02}, {"speed": 1.0}]
)
def test_settings_that_make_no_sense_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(pydantic.ValidationError):
        LinearAxis.model_validate(axis_settings("x") | change)


# ---------------------------------------------------------------------- opening


def test_opening_identifies_and_moves_nothing() -> None:
    controller = ScriptedController()
    stage = Bench(controller).stage(serial_number="116012345", x={"stage": "M-111.1DG"})
    stage.open()
    assert not [request for request in controller.requests if request.startswith(MOVING_COMMANDS)]
    assert b"\x18" not in controller.requests
    assert stage.link == "open"
    assert (stage.info.vendor, stage.info.model) == ("Physik Instrumente (PI) GmbH & Co. KG", "C-884.4DC")
    assert (stage.info.serial_number, stage.info.firmware) == ("116012345", "1.2.0.5")
    assert stage.referenced == {"x": False, "y": False, "theta": False}
    assert stage.limits["x"] == Range(0.0, 15000.0)


def test_an_error_of_earlier_use_is_cleared_and_logged(caplog: pytest.LogCaptureFixture) -> None:
    controller = ScriptedController()
    controller.error = 7
    stage = Bench(controller).stage()
    with caplog.at_level(logging.WARNING):
        stage.open()
    assert "error 7" in caplog.text
    assert controller.error == 0


@pytest.mark.parametrize(
    ("identity", "changes", "match"),
    [
        (b"Oriental Motor AZD-KD\n", {}, "another device behind the port"),
        (b"(c)2015 Physik Instrumente(PI) Karlsruhe, C-863.12,0115500620,1.2.0.0\n", {}, "is no C-884"),
        (None, {"serial_number": "999"}, "serial number 116012345, not 999"),
    ],
)
def test_another_device_is_refused(identity: bytes | None, changes: dict[str, object], match: str) -> None:
    controller = ScriptedController()
    if identity:
        controller.script[b"*IDN?\n"] = identity
    stage = Bench(controller).stage(**changes)
    with pytest.raises(ProtocolError, match=match) as caught:
        stage.open()
    assert (stage.link, caught.value.moved, caught.value.device) == ("closed", "no", "stage")


@pytest.mark.parametrize("reply", [None, b"\xfe\x81\x00\n", b"\xfe\x81\x00", b"(c)2016 Physik Instr"])
def test_silence_and_garbage_mention_the_baud_rate(reply: bytes | None) -> None:
    controller = ScriptedController()
    controller.script[b"*IDN?\n"] = reply
    bench = Bench(controller)
    stage = bench.stage()
    with pytest.raises((ProtocolError, LinkTimeout)) as caught:
        stage.open()
    assert "baud" in caught.value.remedy
    assert "115200" in caught.value.remedy
    assert not bench.wire.in_use


def test_what_a_dead_program_left_in_the_controllers_buffer_does_not_matter() -> None:
    controller = ScriptedController()
    bench = Bench(controller)
    controller.receive(b"MOV 1 7", 0, 0)
    bench.stage().open()


def test_a_missing_axis_is_named() -> None:
    stage = Bench(ScriptedController(axes=("1", "2"))).stage()
    with pytest.raises(ConfigError, match=r"no axis '3'; it has 1, 2") as caught:
        stage.open()
    assert caught.value.key == "stage.axes.theta.id"


def test_another_stage_at_the_axis_is_refused() -> None:
    controller = ScriptedController()
    controller.stages["2"] = "NOSTAGE"
    stage = Bench(controller).stage(y={"stage": "M-111.1DG"})
    with pytest.raises(ConfigError, match="'NOSTAGE'"):
        stage.open()


def test_more_axes_than_the_stage_uses_are_allowed() -> None:
    controller = ScriptedController(axes=("4", "3", "2", "1"))
    controller.servo["1"] = True
    controller.position.update({"1": 1.0, "2": 2.0, "3": 3.0, "4": 4.0})
    stage = Bench(controller).stage()
    stage.open()
    pose = stage.read()
    assert (pose.x_um, pose.y_um, pose.theta_deg) == (1000.0, 2000.0, 3.0)
    assert pose.on_target  # axis 1, in servo, is last in the status reply


def test_an_axis_that_sai_leaves_out_keeps_its_place_in_the_status() -> None:
    controller = ScriptedController(axes=("4", "1", "2", "3"))
    controller.script[b"SAI?\n"] = b"1 \n2 \n3\n"
    controller.script[b"SAI? ALL\n"] = b"4 \n1 \n2 \n3\n"
    controller.servo["3"] = True
    stage = Bench(controller).stage()
    stage.open()
    assert stage.read().on_target
    stage.close()
    controller.script[b"SAI? ALL\n"] = controller.script[b"SAI?\n"]
    with pytest.raises(ProtocolError, match="4 registers for the axes 1, 2, 3"):
        stage.open()


# ---------------------------------------------------------------------- limits and units


def test_limits_are_those_of_controller_and_rig_together() -> None:
    rig = Rig(x={"travel_um": (-100.0, 9000.0)}, y={"travel_um": (2000.0, 20000.0)})
    assert rig.stage.limits["x"] == Range(0.0, 9000.0)
    assert rig.stage.limits["y"] == Range(2000.0, 15000.0)


def test_travels_without_overlap_are_refused() -> None:
    stage = Bench(ScriptedController()).stage(x={"travel_um": (16000.0, 31000.0)})
    with pytest.raises(ConfigError, match="no position is allowed by both"):
        stage.open()


@pytest.mark.parametrize("travel_um", [(0.0, 15.0), (0.0, 15_000_000.0), (100.0, 115.0)])
def test_a_factor_of_a_thousand_is_called_a_wrong_unit(travel_um: tuple[float, float]) -> None:
    stage = Bench(ScriptedController()).stage(x={"travel_um": travel_um})
    with pytest.raises(ConfigError, match="unit is probably wrong") as caught:
        stage.open()
    assert caught.value.key == "stage.axes.x"


def test_a_controller_without_travel_is_refused() -> None:
    controller = ScriptedController()
    controller.highest["1"] = 0.0
    with pytest.raises(ConfigError, match="no travel"):
        Bench(controller).stage().open()


def test_the_controllers_slower_acceleration_counts() -> None:
    rig = Rig(x={"acceleration_um_s2": 9000.0}, y={"acceleration_um_s2": 100.0})
    assert (rig.stage.axes["x"].acceleration, rig.stage.axes["y"].acceleration) == (5000.0, 100.0)


def test_positions_are_sent_in_millimetres_and_degrees() -> None:
    rig = Rig()
    pose = rig.stage.move_to(x_um=7500, y_um=0.05, theta_deg=12.5, speed_um_s=200.0, theta_speed_deg_s=0.5)
    moves = [request for request in rig.controller.requests if request.startswith(b"MOV")]
    assert moves == [b"MOV 1 7.5 2 0.00005 3 12.50001\n"]  # θ is a whole number of 4.5e-5 deg counts
    assert rig.controller.velocity["3"] == 0.5
    assert math.hypot(rig.controller.velocity["1"], rig.controller.velocity["2"]) == pytest.approx(0.2, rel=1e-6)
    assert (pose.x_um, pose.target_x_um, pose.target_theta_deg) == (7500.0, 7500.0, 12.5)
    assert pose.referenced
    assert pose.on_target


@pytest.mark.parametrize(
    ("position_um", "text"),
    [(0.07, "0.00005"), (0.08, "0.0001"), (14999.99, "15"), (0.3, "0.0003"), (2.9999999, "0.003"), (-0.02, "0")],
)
def test_targets_are_rounded_to_the_nearest_count(position_um: float, text: str) -> None:
    axis = AxisMap.from_settings(LinearAxis.model_validate(axis_settings("x")))
    assert axis.target_text(position_um) == text


def test_rounding_never_leaves_the_limits() -> None:
    settings = axis_settings("x") | {"travel_um": (0.03, 99.98), "resolution_um": 0.05}
    axis = AxisMap.from_settings(LinearAxis.model_validate(settings))
    assert axis.target_text(99.98) == "0.09995"
    assert axis.target_text(0.03) == "0.00005"


def test_a_reversed_axis_has_its_sign_and_limits_swapped() -> None:
    rig = Rig(x={"direction": -1, "travel_um": (-14000.0, 100.0)})
    rig.controller.position["1"] = 2.5
    assert rig.stage.limits["x"] == Range(-14000.0, 0.0)
    assert rig.stage.read().x_um == -2500.0
    pose = rig.stage.move_to(x_um=-1000.0)
    assert b"MOV 1 1\n" in rig.controller.requests
    assert pose.x_um == pose.target_x_um == -1000.0
