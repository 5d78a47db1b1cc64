"""Referencing a daisy chain; faults and power cycles of one of its controllers."""

from __future__ import annotations

import math

import pytest

from microdrivers.core.errors import DeviceFault, LinkTimeout, NotReached, NotReferenced, UnsupportedError
from tests.backends.scripted_gcs import MOVING_COMMANDS, Rig
from tests.backends.scripted_gcs_chain import STOP, ChainRig

# ---------------------------------------------------------------------- referencing


def test_each_axis_is_referenced_by_its_own_mode() -> None:
    rig = ChainRig(referenced=False, y={"reference": "FNL"}, theta={"reference": "FPL"})
    rig.stage.reference(["theta", "y", "x"])
    sent = [request for request in rig.chain.requests if request[2:5] in (b"SVO", b"RON", b"FRF", b"FNL", b"FPL")]
    assert [request for request in sent if b"?" not in request] == [
        b"3 SVO 1 1\n", b"3 RON 1 1\n", b"3 FPL 1\n", b"2 SVO 1 1\n", b"2 RON 1 1\n", b"2 FNL 1\n",
        b"1 SVO 1 1\n", b"1 RON 1 1\n", b"1 FRF 1\n",
    ]  # fmt: skip
    assert rig.stage.referenced == {"x": True, "y": True, "theta": True}
    assert rig.kinds() == ["opened", *["reference_found"] * 3]


@pytest.mark.parametrize(
    ("mode", "code", "text", "others"),
    [("FRF", 31, "no reference switch", "FNL or FPL"), ("FNL", 32, "no limit switches", "FRF or FPL")],
)
@pytest.mark.parametrize("chained", [True, False])
def test_a_switch_that_is_not_there_is_named_with_its_axis_and_a_remedy(
    mode: str, code: int, text: str, others: str, chained: bool
) -> None:
    rig: ChainRig | Rig = (ChainRig if chained else Rig)(referenced=False, y={"reference": mode})
    controller = rig.y if isinstance(rig, ChainRig) else rig.controller
    controller.refuse[mode.encode()] = code
    with pytest.raises(UnsupportedError, match=f"axis y.*: .*error {code}.*{mode}.*{text}") as caught:
        rig.stage.reference(["y"])
    assert caught.value.moved == "no"
    assert "axis y" in caught.value.remedy
    assert others in caught.value.remedy
    assert ("address 2" in caught.value.what) is chained


def test_after_a_reference_move_its_axis_is_watched_again() -> None:
    rig = ChainRig.ready()
    rig.stage.reference(["y"])
    rig.y.servo["1"] = False
    with pytest.raises(DeviceFault, match="servo of axis y"):
        rig.stage.read()


def test_a_failed_reference_names_axis_and_address() -> None:
    rig = ChainRig(referenced=False)
    rig.y.refuse[b"FRF"] = 45
    with pytest.raises(DeviceFault, match=r"axis y, address 2: .*error 45") as caught:
        rig.stage.reference(["x", "y", "theta"])
    assert "address 2" in caught.value.what
    assert rig.stage.referenced == {"x": True, "y": False, "theta": False}


def test_a_reference_without_end_stops_all() -> None:
    rig = ChainRig()
    rig.y.script[b"\x07"] = b"\xb0\n"
    with pytest.raises(NotReached, match="axis y has not found its reference in 1 s"):
        rig.stage.reference(["y"])
    assert rig.sent()[-1] == STOP
    assert rig.stage.referenced == {"x": True, "y": False, "theta": True}


# ---------------------------------------------------------------------- faults and power cycles


def test_a_power_cycle_of_one_controller_makes_only_its_axis_unreferenced() -> None:
    rig = ChainRig.ready()
    rig.y.power_cycle()
    pose = rig.stage.read()
    assert rig.stage.referenced == {"x": True, "y": False, "theta": True}
    assert not pose.referenced
    assert math.isnan(pose.target_y_um)
    assert pose.target_x_um == 1.0
    lost = [event for event in rig.events if event.kind == "reference_lost"]
    assert [event.reason for event in lost] == [
        "the controller at address 2 no longer knows the reference of axis y: was it switched off?"
    ]
    rig.stage.read()
    assert rig.kinds().count("reference_lost") == 1
    rig.stage.move_to(x_um=50.0, theta_deg=0.2)
    rig.forget()
    with pytest.raises(NotReferenced, match="axis y"):
        rig.stage.move_to(x_um=60.0, y_um=60.0)
    assert not [request for request in rig.chain.requests if request[2:].startswith(MOVING_COMMANDS)]
    rig.stage.reference(["y"])
    assert rig.stage.move_to(x_um=60.0, y_um=60.0).y_um == 60.0


def test_a_power_cycle_just_before_a_move_moves_nothing() -> None:
    rig = ChainRig.ready()
    rig.stage.read()
    rig.x.power_cycle()
    with pytest.raises(NotReferenced, match="address 1"):
        rig.stage.start_move_to(x_um=100.0, y_um=200.0)
    assert rig.stage.referenced == {"x": False, "y": True, "theta": True}
    assert not [request for request in rig.chain.requests if b"MOV" in request and not request.startswith(b"1")]


@pytest.mark.parametrize(("code", "match"), [(504, "following error"), (0, "servo of axis y has switched")])
def test_a_servo_that_drops_is_a_fault_of_its_axis(code: int, match: str) -> None:
    rig = ChainRig.ready()
    rig.y.servo["1"], rig.y.error = False, code
    with pytest.raises(DeviceFault, match=match) as caught:
        rig.stage.read()
    assert "axis y" in caught.value.what
    assert "address 2" in caught.value.what
    assert rig.stage.read().flags == {"FAULT"}
    assert rig.stage.move_to(x_um=20.0).x_um == 20.0
    with pytest.raises(DeviceFault, match="axis y"):
        rig.stage.move_to(y_um=20.0)
    rig.stage.clear_fault()
    assert rig.stage.move_to(y_um=20.0).flags == frozenset()


def test_faults_of_several_controllers_are_told_at_once() -> None:
    rig = ChainRig.ready()
    for box in (rig.x, rig.theta):
        box.servo["1"], box.error = False, 500
    with pytest.raises(DeviceFault, match=r"address 1: .*emergency.*axis x is off; address 3: .*axis theta is off"):
        rig.stage.read()
    assert rig.stage.read().flags == {"FAULT"}


def test_silence_makes_only_the_silent_controller_doubtful() -> None:
    rig = ChainRig.ready()
    rig.chain.off.add(2)
    with pytest.raises(LinkTimeout):
        rig.stage.read()
    rig.chain.off.clear()
    rig.y.power_cycle()
    rig.forget()
    assert not rig.stage.read().referenced
    assert rig.chain.sent_to(2, b"FRF?")
    assert not rig.chain.sent_to(1, b"FRF?") + rig.chain.sent_to(3, b"FRF?")


def test_after_silence_a_move_asks_for_the_reference_before_any_axis_moves() -> None:
    rig = ChainRig.ready()
    pose = rig.stage.read()
    rig.chain.off.add(2)
    with pytest.raises(LinkTimeout):
        rig.stage.read()
    rig.chain.off.clear()
    rig.y.referenced["1"] = False  # its servo is on again: only the doubt makes the driver ask
    rig.stage._recent_pose = lambda: pose  # type: ignore[method-assign]
    rig.forget()
    with pytest.raises(NotReferenced, match="axis y"):
        rig.stage.start_move_to(x_um=5.0, y_um=5.0)
    assert not [request for request in rig.chain.requests if b"MOV" in request]


def test_an_emergency_stop_refuses_the_servo_by_name() -> None:
    rig = ChainRig()
    rig.theta.refuse[b"SVO "] = 500
    with pytest.raises(
        DeviceFault, match=r"axis theta, address 3: .*error 500 to b'3 SVO 1 1.*emergency stop"
    ) as caught:
        rig.stage.move_to(theta_deg=1.0)
    assert "emergency stop" in caught.value.remedy
