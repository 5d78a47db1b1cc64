"""A steady stage is read with little work: what is reported must be what all the work would have given."""

import random

import msgspec
import pytest

from microdrivers.backends.pi_gcs.controller import Controller
from microdrivers.backends.pi_gcs.steady_pose import SteadyPose
from microdrivers.core.errors import MicrodriversError
from tests.backends.scripted_gcs import Rig


def thorough(rig):
    """Let a rig do all the work each time."""
    rig.stage._work_out = _forgetting(rig.stage, rig.stage._work_out)
    return rig


def _forgetting(stage, work_out):
    def call(*arguments):
        try:
            return work_out(*arguments)
        finally:
            stage._steady = None

    return call


def outcome(call):
    """What a call gives or raises, NaN and all; its place on the bus and the devices' clocks are the same anyway."""
    try:
        sample = call()
    except MicrodriversError as error:
        return type(error).__name__, error.what
    return sample if sample is None else msgspec.msgpack.encode(msgspec.structs.replace(sample, order=-1))


def change(rig, what, draw):
    controller, stage = rig.controller, rig.stage
    axis = draw.choice("123")
    match what:
        case "position":
            controller.position[axis] = round(draw.uniform(-5.0, 5.0), 7)
        case "moving":
            controller.moving = not controller.moving
        case "on target":
            controller.on_target = not controller.on_target
        case "error":
            controller.error_flag = not controller.error_flag
            controller.error = draw.choice((0, 7))
        case "servo":
            controller.servo[axis] = not controller.servo[axis]
        case "reference":
            controller.referenced[axis] = not controller.referenced[axis]
        case "power":
            controller.power_cycle()
        case "garbage":
            controller.script[b"POS?\n"] = b"1=oops\n"
        case "sense":
            controller.script.clear()
        case "stop":
            stage.stop()
        case "stop meanwhile":
            controller.hooks[b"POS?"] = stage.stop
            outcome(stage.read)
            controller.hooks.clear()
        case "move":
            return outcome(lambda: stage._start_move({"x": 1000.0 * draw.random()}, {"x": 500.0}))
        case "clear":
            return outcome(stage.clear_fault)
        case "reopen":
            stage.close()
            return outcome(stage.open)
    return None


CHANGES = (
    "position", "position", "moving", "on target", "error", "servo", "reference", "power", "garbage", "sense", "stop",
    "stop meanwhile", "move", "clear", "reopen",
)  # fmt: skip


def history(rig, seed):
    """All that a random life of the stage gives, its events and what was sent included."""
    draw = random.Random(seed)
    told = []
    for _ in range(60):
        what = draw.choice(CHANGES)
        told.append((what, change(rig, what, draw)))
        told += [outcome(rig.stage.read) for _ in range(draw.randrange(1, 5))]
    return told, rig.kinds(), rig.sent()


@pytest.mark.parametrize("seed", range(12))
def test_whatever_happens_a_steady_pose_is_what_all_the_work_would_have_given(seed):
    assert history(Rig(), seed) == history(thorough(Rig()), seed)


def test_little_work_is_done_while_only_positions_change(monkeypatch):
    worked_out = []
    understand = Controller.understand
    monkeypatch.setattr(Controller, "understand", lambda *arguments: worked_out.append(1) or understand(*arguments))
    rig = Rig()
    for step in range(20):
        rig.controller.position["1"] = step / 7
        assert rig.stage.read().x_um == pytest.approx(1000 * step / 7, abs=1e-4)
    assert len(worked_out) == 1


def test_numbers_in_an_unusual_form_are_left_to_all_the_work():
    rig = Rig()
    rig.controller.script[b"POS?\n"] = b"1=1.5 \n2=2E0 \n3=3.5\n"
    for _ in range(4):
        assert rig.stage.read().y_um == 2000.0
    assert rig.stage._steady is None


def test_an_axis_that_the_stage_does_not_have_may_be_anywhere():
    rig = Rig()
    for place in (b"1.5", b"-2.25", b"3.0"):
        rig.controller.script[b"POS?\n"] = b"1=1.5 \n2=2.5 \n3=3.5 \n4=%b\n" % place
        rig.controller.script[b"\x04"] = b"0x9000900090009000\n"
        pose = rig.stage.read()
        assert (pose.x_um, pose.y_um, pose.theta_deg) == (1500.0, 2500.0, 3.5)
    assert isinstance(rig.stage._steady, SteadyPose)
