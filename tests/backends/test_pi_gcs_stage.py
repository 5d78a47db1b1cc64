"""The XYθ stage on a scripted GCS controller: stamps, moves, references."""

from __future__ import annotations

import math

import pytest

from microdrivers.core.errors import (
    DeviceFault,
    LinkTimeout,
    MoveCancelled,
    NotReached,
    NotReferenced,
    OutOfRange,
    ProtocolError,
)
from tests.backends.scripted_gcs import Rig

# ---------------------------------------------------------------------- reading


def test_a_pose_is_one_exchange_stamped_where_the_controller_latches() -> None:
    rig = Rig(latch={"delay_ms": 0.2, "uncertainty_ms": 0.03})
    rig.sent()
    start_ns = rig.bench.clock.now_ns()
    pose = rig.stage.read()
    assert rig.sent() == [b"POS?\n\x04"]
    assert pose.t_ns == pytest.approx(start_ns + 5 * rig.bench.wire.byte_ns + 200_000, abs=5)
    assert (pose.dt_ns, pose.t_source) == (30_000, "request")


def test_a_port_that_is_faster_than_its_baud_rate_gives_an_honest_interval() -> None:
    rig = Rig()
    rig.bench.wire.byte_ns = 100  # USB: the baud rate is only a number
    rig.controller.delay_s[b"POS?\n"] = 0.0
    start_ns = rig.bench.clock.now_ns()
    pose = rig.stage.read()
    assert pose.t_source == "midpoint"
    assert pose.t_ns - pose.dt_ns == pytest.approx(start_ns, abs=2)
    assert pose.dt_ns < 50_000


def test_a_stage_that_moves_or_references_is_moving() -> None:
    rig = Rig()
    assert not rig.stage.read().moving
    rig.controller.moving = True
    assert rig.stage.read().moving
    rig.controller.script[b"\x04"] = b"0x000040000000\n"
    assert rig.stage.read().moving


def test_axes_without_servo_do_not_keep_the_others_from_being_on_target() -> None:
    rig = Rig()
    assert not rig.stage.read().on_target
    rig.stage.move_to(y_um=100.0)
    assert rig.stage.read().on_target
    rig.controller.on_target = False
    assert not rig.stage.read().on_target


@pytest.mark.parametrize(
    ("request_bytes", "reply"),
    [(b"\x04", b"0x0000\n"), (b"POS?\n", b"1=1.0 \n2=1.0\n"), (b"POS?\n", b"1=1.0 \n2=1.0 \n3=#\n"), (b"\x04", b"7\n")],
)
def test_a_malformed_pose_is_a_protocol_error(request_bytes: bytes, reply: bytes) -> None:
    rig = Rig()
    rig.controller.script[request_bytes] = reply
    with pytest.raises(ProtocolError) as caught:
        rig.stage.read()
    assert caught.value.remedy
    assert caught.value.device == "stage"


def test_a_stream_and_moves_share_the_line() -> None:
    rig = Rig()
    poses = []
    rig.stage.topic.subscribe(poses.append)
    with rig.stage.stream(200.0):
        for target_um in (100.0, 200.0, 300.0):
            rig.stage.move_to(x_um=target_um)
        rig.bench.clock.sleep(0.1)
    assert len(poses) > 20
    assert rig.stage.link == "open"


# ---------------------------------------------------------------------- moving


def test_nothing_is_sent_for_a_refused_move() -> None:
    rig = Rig()
    rig.sent()
    for refused in ({"x_um": 15000.1}, {"y_um": math.nan}, {}):
        with pytest.raises(OutOfRange):
            rig.stage.move_to(**refused)
    assert rig.sent() == []


def test_streamed_targets_take_one_short_write_each() -> None:
    rig = Rig()
    rig.stage.move_to(x_um=100.0, y_um=100.0)
    rig.stage.read()
    rig.sent()
    rig.stage.start_move_to(x_um=110.0, y_um=110.0)
    rig.stage.start_move_to(x_um=120.0, y_um=110.0, speed_um_s=500.0)
    assert rig.sent() == [b"MOV 1 0.11 2 0.11\nERR?\n", b"VEL 1 0.4472136 2 0.2236068\nMOV 1 0.12 2 0.11\nERR?\n"]


def test_a_speed_above_the_accepted_one_is_asked_before_the_move() -> None:
    rig = Rig(x={"max_speed_um_s": 2000.0})
    rig.controller.refuse[b"VEL"] = 8
    with pytest.raises(OutOfRange, match="velocity") as caught:
        rig.stage.start_move_to(x_um=100.0, speed_um_s=1600.0)
    assert caught.value.moved == "no"
    assert not [request for request in rig.controller.requests if request.startswith(b"MOV")]


def test_a_refused_speed_beside_a_move_stops_the_stage() -> None:
    rig = Rig()
    rig.controller.refuse[b"VEL"] = 17
    with pytest.raises(DeviceFault) as caught:
        rig.stage.start_move_to(x_um=100.0, speed_um_s=10.0)
    assert (caught.value.code, caught.value.moved) == (17, "maybe")
    assert rig.controller.requests[-1] == b"\x18"
    del rig.controller.refuse[b"VEL"]
    rig.stage.clear_fault()
    rig.stage.move_to(x_um=100.0, speed_um_s=10.0)
    assert rig.controller.velocity["1"] == 0.01


def test_a_speed_whose_reply_was_lost_is_sent_again() -> None:
    rig = Rig()
    rig.stage.move_to(x_um=1.0, speed_um_s=20.0)
    rig.controller.hooks[b"MOV"] = lambda: rig.stage.stop()
    with pytest.raises(MoveCancelled):
        rig.stage.start_move_to(x_um=2.0, speed_um_s=10.0)
    rig.controller.hooks.clear()
    rig.stage.move_to(x_um=3.0, speed_um_s=20.0)
    assert rig.controller.velocity["1"] == 0.02


def test_a_position_that_the_controller_refuses_is_out_of_range() -> None:
    rig = Rig()
    rig.controller.refuse[b"MOV"] = 7
    with pytest.raises(OutOfRange) as caught:
        rig.stage.move_to(x_um=10.0)
    assert caught.value.moved == "no"
    assert math.isnan(rig.stage.read().target_x_um)


def test_the_servo_is_switched_on_by_the_first_move_only() -> None:
    rig = Rig()
    rig.stage.move_to(x_um=10.0)
    rig.stage.move_to(x_um=20.0, y_um=5.0)
    switched = [request for request in rig.controller.requests if request.startswith(b"SVO ")]
    assert switched == [b"SVO 1 1\n", b"SVO 2 1\n"]


def test_a_move_whose_reply_is_lost_is_not_repeated() -> None:
    rig = Rig()
    rig.stage.move_to(x_um=10.0)
    rig.controller.requests.clear()
    rig.controller.script[b"ERR?\n"] = None
    with pytest.raises(LinkTimeout) as caught:
        rig.stage.start_move_to(x_um=20.0)
    assert caught.value.moved == "maybe"
    assert rig.controller.requests.count(b"MOV 1 0.02\n") == 1


# ---------------------------------------------------------------------- referencing


def test_referencing_switches_servo_and_mode_and_waits_until_ready() -> None:
    rig = Rig(referenced=False, y={"reference": "FNL"})
    ready = iter([b"\xb0\n", b"\xb0\n", b"\xb1\n", b"\xb1\n"])
    rig.controller.script[b"\x07"] = lambda: next(ready)
    before_ns = rig.bench.clock.now_ns()
    rig.stage.reference(["x", "y"])
    sent = [request for request in rig.controller.requests if request[:3] in (b"SVO", b"RON", b"FRF", b"FNL")]
    assert [request for request in sent if b"?" not in request] == [
        b"SVO 1 1\n", b"RON 1 1\n", b"FRF 1\n", b"SVO 2 1\n", b"RON 2 1\n", b"FNL 2\n",
    ]  # fmt: skip
    assert rig.bench.clock.now_ns() - before_ns > 2 * 50_000_000
    assert rig.stage.referenced == {"x": True, "y": True, "theta": False}
    assert rig.kinds() == ["opened", "reference_found", "reference_found"]
    rig.stage.move_to(x_um=10.0)


@pytest.mark.parametrize(("command", "code"), [(b"FRF", 45), (b"FRF", 5), (b"SVO", 555)])
def test_a_reference_that_the_controller_refuses_is_a_fault(command: bytes, code: int) -> None:
    rig = Rig(referenced=False)
    rig.controller.refuse[command] = code
    with pytest.raises(DeviceFault) as caught:
        rig.stage.reference(["x"])
    assert caught.value.code == code
    assert rig.stage.fault is caught.value
    assert not rig.stage.referenced["x"]


def test_a_reference_that_is_not_found_is_a_fault() -> None:
    rig = Rig(referenced=False)
    rig.controller.script[b"FRF 1\n"] = None
    with pytest.raises(DeviceFault, match="has not found its reference"):
        rig.stage.reference(["x"])
    assert rig.kinds() == ["opened", "fault"]


def test_a_reference_without_end_is_stopped() -> None:
    rig = Rig()
    rig.controller.script[b"\x07"] = b"\xb0\n"
    with pytest.raises(NotReached, match="1 s"):
        rig.stage.reference(["x"])
    assert rig.controller.requests[-1] == b"\x18"
    assert not rig.stage.referenced["x"]
    with pytest.raises(NotReferenced):
        rig.stage.move_to(x_um=1.0)


def test_a_stop_ends_a_reference_move() -> None:
    rig = Rig(referenced=False)
    rig.controller.script[b"\x07"] = b"\xb0\n"
    rig.bench.clock.call_at(rig.bench.clock.now_ns() + 200_000_000, rig.stage.stop)
    with pytest.raises(MoveCancelled, match="reference move"):
        rig.stage.reference(["x"])
    assert rig.bench.clock.now_ns() < 1_000_000_000


def test_a_stream_does_not_disturb_referencing() -> None:
    rig = Rig(referenced=False)
    rig.controller.error_flag = True
    ready = iter([b"\xb0\n"] * 5 + [b"\xb1\n"])
    rig.controller.script[b"\x07"] = lambda: next(ready)
    with rig.stage.stream(100.0):
        rig.stage.reference(["x"])
    assert rig.kinds() == ["opened", "reference_found"]


def test_what_the_servo_does_while_referencing_is_no_fault() -> None:
    rig = Rig()
    rig.stage.move_to(x_um=10.0)

    def search() -> None:
        rig.controller.servo["1"], rig.controller.error_flag = False, True

    def found() -> bytes:
        rig.controller.servo["1"] = True
        return b"\xb1\n"

    ready = iter([lambda: b"\xb0\n"] * 5 + [found])
    rig.controller.hooks[b"FRF "] = search
    rig.controller.script[b"\x07"] = lambda: next(ready)()
    rig.controller.requests.clear()
    with rig.stage.stream(100.0):
        rig.stage.reference(["x"])
    assert rig.kinds() == ["opened", "reference_found"]
    assert rig.controller.requests.count(b"SVO?\n") == 2  # for the new error flag, and at the end
    assert rig.stage.read().flags == frozenset()
