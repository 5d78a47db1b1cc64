"""Moving and stopping a daisy chain."""

from __future__ import annotations

import math
import threading

import pytest

from microdrivers.backends.pi_gcs.stage import GcsXYThetaStage
from microdrivers.core.clock.system import SystemClock
from microdrivers.core.errors import (
    DeviceFault,
    LinkLost,
    LinkTimeout,
    MoveCancelled,
    NotReferenced,
    OutOfRange,
)
from tests.backends.scripted_gcs import Rig
from tests.backends.scripted_gcs_chain import STOP, ChainRig

FAR = {"x_um": 100.0, "y_um": 200.0, "theta_deg": 3.0}


def stop_ahead_of(rig: ChainRig | Rig, beginning: bytes) -> None:
    """Send a stop just before a request goes on the line: after all checks, as another thread may."""
    exchange = rig.stage._line.exchange

    def delayed(request: bytes, *arguments: object, **options: object) -> object:
        if request.startswith(beginning):
            rig.stage._line.exchange = exchange  # type: ignore[method-assign]
            rig.stage.stop(by="guard")
        return exchange(request, *arguments, **options)

    rig.stage._line.exchange = delayed  # type: ignore[method-assign, assignment]


# ---------------------------------------------------------------------- moving


def test_each_controller_is_sent_its_own_move() -> None:
    rig = ChainRig.ready()
    rig.stage.start_move_to(x_um=101.0, y_um=101.0, theta_deg=0.45, speed_um_s=500.0, theta_speed_deg_s=0.5)
    assert rig.sent() == [
        b"1 VEL 1 0.3535534\n1 MOV 1 0.101\n1 ERR?\n",
        b"2 VEL 1 0.3535534\n2 MOV 1 0.101\n2 ERR?\n",
        b"3 VEL 1 0.5\n3 MOV 1 0.45\n3 ERR?\n",
    ]
    pose = rig.stage.read()
    assert (pose.x_um, pose.target_y_um, pose.target_theta_deg) == (101.0, 101.0, 0.45)


def test_only_the_controllers_of_the_moved_axes_are_asked() -> None:
    rig = ChainRig.ready()
    rig.stage.start_move_to(y_um=5.0)
    assert [write.split()[0] for write in rig.sent()] == [b"2"]


def test_axes_start_within_a_few_milliseconds_of_each_other() -> None:
    rig = ChainRig.ready()
    started_ns: list[int] = []
    for box in (rig.x, rig.y, rig.theta):
        box.hooks[b"MOV"] = lambda: started_ns.append(rig.bench.clock.now_ns())
    rig.stage.start_move_to(**FAR)
    assert started_ns[2] - started_ns[0] == pytest.approx(2 * 5e6, abs=4e6)


@pytest.mark.parametrize(
    ("late", "kind"),
    [("unreferenced", NotReferenced), ("at fault", DeviceFault), ("no servo", DeviceFault), ("too fast", OutOfRange)],
)
def test_nothing_moves_if_a_later_controller_will_not(late: str, kind: type[Exception]) -> None:
    rig = ChainRig()
    rig.stage.move_to(x_um=1.0, y_um=1.0)
    match late:
        case "unreferenced":
            rig.theta.power_cycle()
        case "at fault":
            rig.stage.move_to(theta_deg=0.1)
            rig.theta.servo["1"] = False
            with pytest.raises(DeviceFault):
                rig.stage.read()
        case "no servo":
            rig.theta.refuse[b"SVO "] = 500
        case "too fast":
            rig.theta.refuse[b"VEL"], rig.theta.velocity["1"] = 8, 0.1
    rig.forget()
    with pytest.raises(kind, match="theta") as caught:
        rig.stage.start_move_to(**FAR)
    assert "address 3" in str(caught.value)
    assert caught.value.moved == "no"
    assert not [request for address in (1, 2, 3) for request in rig.chain.sent_to(address, b"MOV")]


def test_a_power_cycle_since_the_last_pose_stops_those_that_have_begun() -> None:
    rig = ChainRig.ready()
    rig.theta.power_cycle()
    with pytest.raises(MoveCancelled, match=r"address 3: .*reference of axis theta; axis x, y had begun") as caught:
        rig.stage.start_move_to(**FAR)
    assert "reference(['theta'])" in caught.value.remedy
    assert rig.sent()[-1] == STOP
    assert rig.stage.referenced == {"x": True, "y": True, "theta": False}


def test_a_refusal_of_a_later_controller_stops_those_that_have_begun() -> None:
    rig = ChainRig.ready()
    rig.theta.refuse[b"MOV"] = 7
    with pytest.raises(MoveCancelled, match="axis x, y had begun to move and stopped") as caught:
        rig.stage.start_move_to(**FAR)
    assert "axis theta, address 3: the controller reports error 7" in caught.value.what
    assert r"3 MOV 1 3" in caught.value.what
    assert caught.value.moved == "yes"
    assert isinstance(caught.value.__cause__, OutOfRange)
    assert rig.sent()[-1] == STOP
    assert rig.kinds()[-1] == "stopped"
    rig.theta.refuse.clear()
    rig.stage.move_to(**FAR)  # the errors 10 that the stop has left are taken for nobody's


def test_a_refusal_of_the_first_controller_moves_nothing() -> None:
    rig = ChainRig.ready()
    rig.x.refuse[b"MOV"] = 7
    with pytest.raises(OutOfRange, match="axis x, address 1") as caught:
        rig.stage.start_move_to(**FAR)
    assert caught.value.moved == "no"
    assert len(rig.sent()) == 1


def test_a_fault_while_starting_stops_everything() -> None:
    rig = ChainRig.ready()
    rig.y.refuse[b"MOV"] = 504
    with pytest.raises(DeviceFault, match=r"axis y, address 2: .*error 504.*axis x had begun to move") as caught:
        rig.stage.start_move_to(**FAR)
    assert (caught.value.code, caught.value.moved) == (504, "yes")
    assert rig.sent()[-1] == STOP
    assert rig.stage.fault is caught.value


def test_a_move_whose_answer_is_lost_after_another_has_begun_stops_everything() -> None:
    rig = ChainRig.ready()
    rig.chain.off.add(2)
    with pytest.raises(LinkTimeout, match=r"axis y, address 2: .*axis x had begun to move and stopped") as caught:
        rig.stage.start_move_to(**FAR)
    assert caught.value.moved == "yes"
    writes = rig.sent()
    assert writes[-1] == STOP
    assert not [write for write in writes if b"3 MOV" in write]
    assert len([write for write in writes if b"2 MOV" in write]) == 1


def test_a_cable_pulled_between_two_moves_says_what_was_left_moving() -> None:
    rig = ChainRig.ready()
    rig.y.hooks[b"MOV"] = rig.bench.wire.unplug
    with pytest.raises(LinkLost, match="axis x had begun to move and could not be stopped") as caught:
        rig.stage.start_move_to(**FAR)
    assert caught.value.moved == "yes"
    assert "axis y" not in caught.value.what


# ---------------------------------------------------------------------- stop


def test_a_stop_is_one_write_for_all_controllers() -> None:
    rig = ChainRig.ready()
    move = rig.stage.start_move_to(**FAR)
    rig.forget()
    rig.stage.stop(by="guard")
    assert rig.sent() == [STOP]
    with pytest.raises(MoveCancelled):
        move.wait()
    assert math.isnan(rig.stage.read().target_theta_deg)


def test_the_error_of_a_stop_is_read_away_in_every_controller() -> None:
    rig = ChainRig.ready()
    rig.stage.stop()
    rig.forget()
    rig.stage.start_move_to(x_um=5.0)
    rig.stage.start_move_to(y_um=5.0, theta_deg=0.45)
    assert [write for write in rig.sent() if b"MOV" in write] == [
        b"1 ERR?\n1 VEL 1 1\n1 MOV 1 0.005\n1 ERR?\n",
        b"2 ERR?\n2 VEL 1 1\n2 MOV 1 0.005\n2 ERR?\n",
        b"3 ERR?\n3 MOV 1 0.45\n3 ERR?\n",
    ]
    assert [box.error for box in rig.chain.boxes.values()] == [0, 0, 0]


def test_a_stop_between_two_moves_keeps_the_later_ones_from_starting() -> None:
    rig = ChainRig.ready()
    rig.x.hooks[b"ERR?"] = lambda: rig.stage.stop(by="guard")  # x has begun
    with pytest.raises(MoveCancelled) as caught:
        rig.stage.start_move_to(**FAR)
    assert caught.value.moved in ("maybe", "yes")
    writes = rig.sent()
    assert not [write for write in writes if b"2 MOV" in write or b"3 MOV" in write]
    assert writes[-1] == STOP


def test_a_stop_after_a_move_was_answered_keeps_the_later_ones_from_starting() -> None:
    rig = ChainRig.ready()
    x = rig.stage._controllers[0]
    taken = x.state.speeds_taken

    def taken_then_stopped(*arguments: object) -> None:
        taken(*arguments)
        rig.stage.stop(by="guard")

    x.state.speeds_taken = taken_then_stopped  # type: ignore[method-assign]
    with pytest.raises(MoveCancelled, match="axis x had begun to move and stopped"):
        rig.stage.start_move_to(**FAR)
    assert not rig.chain.sent_to(2, b"MOV") + rig.chain.sent_to(3, b"MOV")


@pytest.mark.parametrize("address", [1, 2, 3])
def test_a_stop_that_comes_just_before_a_move_is_sent_again_after_it(address: int) -> None:
    rig = ChainRig.ready()
    stop_ahead_of(rig, b"%d " % address)
    with pytest.raises(MoveCancelled) as caught:
        rig.stage.start_move_to(**FAR)
    begun = ["x", "y", "theta"][: address - 1]
    assert caught.value.moved == ("yes" if begun else "maybe")
    if begun:
        assert f"axis {', '.join(begun)} had begun to move and stopped" in caught.value.what
    writes = rig.sent()
    assert writes[address - 1] == writes[-1] == STOP
    assert b"%d MOV" % address in writes[address]
    assert not [write for write in writes if b"%d MOV" % (address + 1) in write]
    assert [event.by for event in rig.events if event.kind == "stopped"] == ["guard", "driver"]


def test_a_stop_that_comes_just_before_a_move_of_one_controller_is_sent_again_too() -> None:
    rig = Rig()
    rig.stage.move_to(x_um=10.0)
    rig.sent()
    stop_ahead_of(rig, b"MOV")
    with pytest.raises(MoveCancelled):
        rig.stage.start_move_to(x_um=20.0)
    assert rig.sent() == [b"\x18", b"MOV 1 0.02\nERR?\n", b"\x18"]


@pytest.mark.parametrize("beginning", [b"FRF", b"SVO 1"])
def test_a_stop_that_comes_just_before_a_reference_move_is_sent_again(beginning: bytes) -> None:
    rig = Rig()
    stop_ahead_of(rig, beginning)
    with pytest.raises(MoveCancelled):
        rig.stage.reference(["x"])
    writes = rig.sent()
    searched = [index for index, write in enumerate(writes) if b"FRF 1" in write]
    assert (writes[-1] == b"\x18") if searched else True
    assert bool(searched) == (beginning == b"FRF")


def test_a_stop_before_the_search_has_begun_prevents_it() -> None:
    rig = Rig()
    command = rig.stage._controllers[0].gcs.command

    def command_then_stop(*lines: str) -> None:
        command(*lines)
        if lines == ("RON 1 1",):
            rig.stage.stop()

    rig.stage._controllers[0].gcs.command = command_then_stop  # type: ignore[method-assign]
    with pytest.raises(MoveCancelled, match="reference move of axis x"):
        rig.stage.reference(["x"])
    assert not [request for request in rig.controller.requests if request.startswith(b"FRF 1")]


def test_stop_from_another_thread_does_not_wait_for_any_controller() -> None:
    """y withholds its answer until the stop has been sent: a stop that waits would never end."""
    rig = ChainRig.ready()
    rig.stage.close()
    clock = SystemClock()
    rig.bench.wire.clock = clock
    stage = GcsXYThetaStage("stage", rig.stage._settings, clock=clock, bus=rig.bench.bus)
    stage.open()
    asked, stopped = threading.Event(), threading.Event()
    exchange = stage._line.exchange

    def withheld(request: bytes, complete: object, **options: object) -> object:
        def complete_after_stop(received: bytes) -> bool:
            asked.set()
            return stopped.wait(5.0) and complete(received)

        return exchange(request, complete_after_stop if request.startswith(b"2") else complete, **options)

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
    assert [rig.chain.sent_to(address, b"\x18") for address in (1, 2, 3)] == [[b"\x18"]] * 3
