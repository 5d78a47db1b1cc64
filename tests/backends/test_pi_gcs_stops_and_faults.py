"""A GCS stage that is stopped, drops its servo, is switched off or unplugged."""

from __future__ import annotations

import math
import threading

import pytest

from microdrivers.backends.pi_gcs.stage import GcsXYThetaStage
from microdrivers.core.clock.system import SystemClock
from microdrivers.core.errors import (
    DeviceFault,
    LinkError,
    LinkTimeout,
    MoveCancelled,
    NotReferenced,
)
from tests.backends.scripted_gcs import MOVING_COMMANDS, Rig

# ---------------------------------------------------------------------- stop


def test_stop_is_one_byte_and_cancels_the_move() -> None:
    rig = Rig()
    rig.stage.read()
    move = rig.stage.start_move_to(x_um=10.0)
    rig.sent()
    rig.stage.stop(by="guard")
    assert rig.sent() == [b"\x18"]
    with pytest.raises(MoveCancelled):
        move.wait()
    assert math.isnan(rig.stage.read().target_x_um)
    rig.stage.move_to(x_um=20.0)  # the error 10 of the stop is not taken for the move's


def test_a_stop_during_the_exchange_of_a_move_cancels_it() -> None:
    rig = Rig()
    rig.stage.move_to(x_um=10.0)
    rig.controller.hooks[b"MOV"] = lambda: rig.stage.stop(by="guard")
    with pytest.raises(MoveCancelled):
        rig.stage.move_to(x_um=20.0)
    rig.controller.hooks.clear()
    assert rig.stage.move_to(x_um=30.0).x_um == 30.0


def test_a_stop_while_the_servo_is_switched_on_prevents_the_move() -> None:
    rig = Rig()
    rig.controller.hooks[b"FRF?"] = lambda: rig.stage.stop(by="guard")
    with pytest.raises(MoveCancelled) as caught:
        rig.stage.move_to(x_um=20.0)
    assert caught.value.moved == "no"
    assert not [request for request in rig.controller.requests if request.startswith(b"MOV")]


def test_stop_from_another_thread_does_not_wait_for_the_exchange_under_way() -> None:
    """The controller withholds its reply until it has seen the stop: a stop that waits would never end."""
    rig = Rig()
    rig.stage.close()
    clock = SystemClock()
    rig.bench.wire.clock = clock
    stage = GcsXYThetaStage("stage", rig.stage._settings, clock=clock, bus=rig.bench.bus)
    stage.open()
    stage.read()
    asked, stopped = threading.Event(), threading.Event()
    exchange = stage._line.exchange

    def withheld(request: bytes, complete: object, **options: object) -> object:
        def complete_after_stop(received: bytes) -> bool:
            asked.set()
            return stopped.wait(5.0) and complete(received)

        return exchange(request, complete_after_stop, **options)

    stage._line.exchange = withheld  # type: ignore[method-assign]
    reader = threading.Thread(target=stage.read)
    reader.start()
    assert asked.wait(5.0)
    assert stage._line._lock.locked()
    stage.stop()
    stopped.set()
    reader.join(5.0)
    stage.close()
    assert not reader.is_alive()
    assert b"\x18" in rig.controller.requests


# ---------------------------------------------------------------------- faults and power cycles


def test_a_power_cycle_is_noticed_by_reading() -> None:
    rig = Rig()
    rig.stage.move_to(x_um=10.0, y_um=10.0, theta_deg=1.0)
    rig.controller.power_cycle()
    pose = rig.stage.read()
    assert not pose.referenced
    assert math.isnan(pose.target_x_um)
    assert rig.kinds() == ["opened", "reference_lost"]
    assert not any(rig.stage.referenced.values())
    rig.controller.requests.clear()
    with pytest.raises(NotReferenced):
        rig.stage.move_to(x_um=20.0)
    rig.stage.read()
    assert rig.kinds().count("reference_lost") == 1
    assert not [request for request in rig.controller.requests if request.startswith(MOVING_COMMANDS)]


def test_a_power_cycle_with_servos_off_is_noticed_by_the_move() -> None:
    rig = Rig()
    rig.stage.read()
    rig.controller.power_cycle()
    with pytest.raises(NotReferenced):
        rig.stage.move_to(x_um=20.0)
    assert rig.kinds() == ["opened", "reference_lost"]
    assert not [request for request in rig.controller.requests if request.startswith((b"MOV", b"SVO "))]


def test_a_power_cycle_between_the_last_pose_and_the_move_is_noticed() -> None:
    rig = Rig()
    rig.stage.move_to(x_um=10.0)
    rig.controller.power_cycle()
    with pytest.raises(NotReferenced):
        rig.stage.start_move_to(x_um=20.0)
    assert rig.kinds() == ["opened", "reference_lost"]


def test_silence_makes_the_stage_doubt_the_reference() -> None:
    rig = Rig()
    rig.controller.script[b"*IDN?\n"], identity = None, rig.controller.script[b"*IDN?\n"]
    rig.controller.script[b"POS?\n"] = rig.controller.script[b"\x04"] = None
    with pytest.raises(LinkTimeout):
        rig.stage.read()
    rig.controller.power_cycle()
    rig.controller.script = {b"*IDN?\n": identity}
    assert not rig.stage.read().referenced
    assert "reference_lost" in rig.kinds()


def test_doubt_lasts_until_the_state_is_read_without_interruption() -> None:
    rig = Rig()
    rig.controller.error_flag = True
    velocities = iter([None, b"1=1.0 \n2=1.0 \n3=1.0\n"])
    rig.controller.script[b"VEL?\n"] = lambda: next(velocities)
    rig.stage.read()
    del rig.controller.script[b"VEL?\n"]
    for asked in (True, False):
        rig.controller.requests.clear()
        rig.stage.read()
        assert (b"FRF?\n" in rig.controller.requests) is asked


def test_speeds_are_set_anew_after_a_power_cycle() -> None:
    rig = Rig()
    rig.stage.move_to(x_um=10.0, speed_um_s=100.0)
    rig.controller.power_cycle()
    rig.stage.read()
    rig.stage.reference(["x"])
    rig.stage.move_to(x_um=20.0, speed_um_s=100.0)
    assert rig.controller.velocity["1"] == 0.1


@pytest.mark.parametrize(("code", "match"), [(504, "following error"), (0, "servo of axis x has switched")])
def test_a_servo_that_drops_is_a_fault_until_it_is_cleared(code: int, match: str) -> None:
    rig = Rig()
    rig.stage.move_to(x_um=10.0, y_um=10.0)
    rig.controller.servo["1"], rig.controller.error = False, code
    with pytest.raises(DeviceFault, match=match) as caught:
        rig.stage.read()
    assert caught.value.code == code
    assert rig.kinds() == ["opened", "fault"]
    assert rig.stage.read().flags == {"FAULT"}
    rig.controller.requests.clear()
    with pytest.raises(DeviceFault) as refused:
        rig.stage.move_to(x_um=20.0)
    assert refused.value.moved == "no"
    assert not [request for request in rig.controller.requests if request.startswith(MOVING_COMMANDS)]
    assert rig.stage.move_to(y_um=20.0).y_um == 20.0
    rig.stage.clear_fault()
    assert not rig.controller.servo["1"]
    assert rig.stage.move_to(x_um=20.0).flags == frozenset()


def test_a_servo_that_drops_before_the_move_is_a_fault() -> None:
    rig = Rig()
    rig.stage.move_to(x_um=10.0)
    rig.controller.servo["1"] = False
    with pytest.raises(DeviceFault, match="servo of axis x"):
        rig.stage.start_move_to(x_um=20.0)


def test_an_error_flag_is_looked_into_once() -> None:
    rig = Rig()
    rig.controller.error_flag, rig.controller.error = True, 505
    with pytest.raises(DeviceFault, match="sensor signal invalid"):
        rig.stage.read()
    rig.controller.requests.clear()
    rig.stage.read()
    assert rig.controller.requests == [b"POS?\n", b"\x04"]


def test_a_pulled_cable_is_a_link_error() -> None:
    rig = Rig()
    rig.bench.wire.unplug()
    with pytest.raises(LinkError):
        rig.stage.read()
