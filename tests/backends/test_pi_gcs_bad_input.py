"""What may come over a port instead of an answer: each is a typed error that says what was asked and what to do."""

from __future__ import annotations

import pytest

from microdrivers.core.errors import DeviceFault, LinkError, LinkTimeout, MicrodriversError, ProtocolError
from tests.backends.scripted_gcs import Rig, ScriptedPeer
from tests.backends.scripted_gcs_chain import ChainRig


class Both:
    """A stage on one controller or on a chain, and how the line of either looks for the y axis."""

    def __init__(self, chained: bool) -> None:
        self.rig = ChainRig.ready() if chained else Rig()
        self.stage = self.rig.stage
        if not chained:
            self.stage.move_to(x_um=1.0, y_um=1.0)
        self.rig.sent()
        self.peer: ScriptedPeer = self.rig.chain if isinstance(self.rig, ChainRig) else self.rig.controller
        self.prefix, self.sender = (b"2 ", b"0 2 ") if chained else (b"", b"")
        self.axis = b"1" if chained else b"2"

    def says(self, request: bytes, answer: bytes | None) -> bytes:
        """From now on this is the answer; returns the request as it is sent."""
        sent = self.prefix + request
        self.peer.script[sent] = answer and self.sender + answer
        return sent

    def place(self, error: MicrodriversError) -> str:
        """What the error must name."""
        assert error.device == "stage"
        assert error.remedy
        if self.prefix:
            assert "axis y" in error.what
        return "address 2" if self.prefix else ""


@pytest.fixture(params=[False, True], ids=["one controller", "chain"])
def both(request: pytest.FixtureRequest) -> Both:
    return Both(request.param)


def test_half_a_pose(both: Both) -> None:
    sent = both.says(b"POS?\n", both.axis + b"=1.50")
    both.says(b"\x04\n" if both.prefix else b"\x04", None)
    with pytest.raises(LinkTimeout, match="only a part") as caught:
        both.stage.read()
    assert repr(sent)[2:-1] in caught.value.what
    assert "=1.50" in caught.value.what
    assert both.place(caught.value) in caught.value.what


@pytest.mark.parametrize("garbage", [b"\xfe\x81\x00\n\xff\n", b"\n\n", b"1=nan\n0x9000\n", b"?\n?\n"])
def test_garbage_instead_of_a_pose(both: Both, garbage: bytes) -> None:
    sent = both.says(b"POS?\n", garbage)
    with pytest.raises(ProtocolError, match="unintelligible") as caught:
        both.stage.read()
    assert caught.value.sent.startswith(sent)
    assert caught.value.received
    assert both.place(caught.value) in caught.value.what
    both.peer.script.pop(sent)
    assert both.stage.read().y_um == 1.0


@pytest.mark.parametrize("garbage", [b"\xff\xff\n", b"zero\n", b"0 1\n", b"7"])
def test_garbage_instead_of_the_error_number_of_a_move(both: Both, garbage: bytes) -> None:
    """Nobody knows whether it moves, and it is not sent again."""
    both.says(b"ERR?\n", garbage)
    with pytest.raises(LinkError) as caught:
        both.stage.start_move_to(y_um=5.0)
    assert caught.value.moved == "maybe"
    assert "axis y" in caught.value.what
    assert "MOV" in caught.value.what
    assert both.place(caught.value) in caught.value.what
    assert len([write for write in both.rig.sent() if b"MOV" in write]) == 1


def test_a_late_pose_is_not_taken_for_the_next_one(both: Both) -> None:
    positions = iter([b"111.0", b"1.0", b"1.0"])
    line = both.prefix + b"POS?\n"
    if both.prefix:
        both.peer.script[line] = lambda: b"0 2 1=%s\n" % next(positions)
    else:
        both.peer.script[line] = lambda: b"1=1.0 \n2=%s \n3=1.0\n" % next(positions)
    both.peer.delay_s[line] = 0.15
    assert both.stage.read().y_um == 1000.0


def test_a_controller_in_an_error_state_refuses_the_servo(both: Both) -> None:
    controller = both.rig.y if isinstance(both.rig, ChainRig) else both.rig.controller
    controller.refuse[b"SVO "] = 501
    sent = both.prefix + b"SVO %s 1\n" % both.axis
    with pytest.raises(DeviceFault, match="error 501") as caught:
        both.stage.reference(["y"])
    assert caught.value.code == 501
    assert "axis y" in caught.value.what
    assert repr(sent)[2:-1] in caught.value.what
    assert "emergency stop" in caught.value.remedy
    assert both.stage.fault is caught.value


def test_a_fault_that_is_found_while_reading_names_the_axis_without_servo(both: Both) -> None:
    controller = both.rig.y if isinstance(both.rig, ChainRig) else both.rig.controller
    controller.servo[both.axis.decode()], controller.error = False, 505
    with pytest.raises(DeviceFault, match=r"error 505: sensor signal invalid; the servo of axis y is off") as caught:
        both.stage.read()
    assert both.place(caught.value) in caught.value.what
