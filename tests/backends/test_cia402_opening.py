"""The fine stage on three scripted drives: opening, reading, referencing."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any

import pytest

from microdrivers.backends.lines.can_line import CanLine
from microdrivers.core.bus import Bus
from microdrivers.core.clock import ClockEvent
from microdrivers.core.errors import (
    BusyError,
    ConfigError,
    LinkTimeout,
    NotReferenced,
    OutOfRange,
    ProtocolError,
    UnsafeError,
)
from microdrivers.core.units import Range
from microdrivers.fakes.can import Frame
from tests.backends.cia402_bench import COUNTS, Bench
from tests.backends.cia402_peer import ENABLED, SOD

COUNT_UM = 1 / COUNTS


def test_opening_identifies_sets_up_and_switches_nothing_on():
    with Bench() as bench:
        bench.opened()
        stage = bench.stage
        assert stage.info.model == "FAKE-DRIVE-402"
        assert stage.info.serial_number == "1011/1012/1013"
        assert stage.referenced == {"x": False, "y": False, "z": False}
        assert stage.limits["x"] == Range(-625.0, 625.0)
        assert bench.kinds == ["opened"]
        for axis, peer in bench.peers.items():
            assert peer.word == SOD
            assert not any(index == 0x6040 for index, _, _ in peer.written), axis
            assert (peer.number(0x607D, 1, signed=True), peer.number(0x607D, 2, signed=True)) == (-12_500, 12_500)
            assert peer.number(0x1016, 1) == 127 << 16 | 100
            assert peer.number(0x1017, 0) == 100
            assert peer.number(0x605A, 0) == 6
            assert peer.number(0x6067, 0) == 3
            assert [peer.number(0x1801 + n, 1) >> 31 for n in range(3)] == [1, 1, 1]
        pose = stage.read()
        assert pose.x_um == 61.7
        assert (pose.moving, pose.on_target, pose.referenced) == (False, False, False)
        assert math.isnan(pose.target_x_um)


def test_the_pose_is_that_of_its_stamp():
    with Bench() as bench:
        bench.referenced()
        move = bench.stage.start_move_to(x_um=500.0, speed_um_s=1000.0)
        for _ in range(30):
            bench.clock.sleep(0.011)
            pose = bench.stage.read()
            slack_um = COUNT_UM / 2 + 1000e-9 * pose.dt_ns
            assert abs(pose.x_um - bench.truth_um("x", pose.t_ns)) <= slack_um
            assert pose.dt_ns < 100_000
        move.wait()


def test_limits_consider_the_home_offset_and_are_checked():
    with Bench(axes={"x": {"travel_um": Range(100.0, 600.0)}}) as bench:
        bench.peers["x"].put(0x607C, 0, 400)
        bench.peers["x"].put(0x607D, 2, 50)
        bench.opened()
        peer = bench.peers["x"]
        assert (peer.number(0x607D, 1), peer.number(0x607D, 2)) == (2400, 12_400)
        limits = [sub for index, sub, _ in peer.written if index == 0x607D]
        assert limits == [2, 1]  # the lower one is never above the higher one


def test_a_drive_that_does_not_take_its_limits_is_not_trusted():
    with Bench() as bench:
        peer = bench.peers["y"]

        def refuse(index: int, sub: int, data: bytes, t_ns: int) -> None:
            if (index, sub) == (0x607D, 2):
                peer.put(0x607D, 2, 0)

        peer.on_write = refuse
        with pytest.raises(ProtocolError, match=r"axis y \(node 12\) has taken 0 for 607Dh\.2.*not 12500"):
            bench.stage.open()
        assert bench.stage.link == "closed"


def test_a_missing_node_is_named_with_axis_and_remedy():
    with Bench() as bench:
        bench.medium.detach(bench.peers["y"])
        bench.medium.detach(bench.peers["z"])
        with pytest.raises(LinkTimeout, match=r"^[^;]*y \(node 12\), axis z \(node 13\) do not answer") as caught:
            bench.stage.open()
        for word in ("power", "node id", "bit rate", "termination"):
            assert word in caught.value.remedy
        assert caught.value.device == "probe_stage"
        bench.medium.attach(bench.peers["y"])
        bench.medium.attach(bench.peers["z"])
        bench.opened().stage.read()


def test_another_device_in_the_place_of_a_drive():
    with Bench() as bench:
        bench.peers["z"].put(0x1000, 0, 0x00020194)
        with pytest.raises(ProtocolError, match=r"axis z \(node 13\) is another device.*profile 404, not 402"):
            bench.stage.open()


def test_a_drive_without_homing_mode_or_fast_enough_is_refused():
    with Bench() as bench:
        bench.peers["x"].put(0x6502, 0, 0x01)
        with pytest.raises(ProtocolError, match="has no homing mode"):
            bench.stage.open()
        bench.peers["x"].put(0x6502, 0, 0x21)
        bench.peers["x"].put(0x607F, 0, 4000)
        with pytest.raises(ConfigError, match=r"allows 200 µm/s.*the rig file 1000 µm/s") as caught:
            bench.stage.open()
        assert caught.value.key == "probe_stage.axes.x.max_speed_um_s"


def test_two_stages_share_a_bus_and_no_node():
    with Bench() as bench:
        values: dict[str, Any] = {
            "connection": {"interface": "microdrivers", "channel": bench.channel},
            "axes": {
                axis: bench.stage._settings.axes.x.model_dump() | {"node_id": node_id}
                for axis, node_id in (("x", 21), ("y", 22), ("z", 13))
            },
            "reference_order": ("z", "x", "y"),
        }
        other = bench.make("gripper_stage", values, Bus())
        bench.opened()
        with pytest.raises(ConfigError, match=r"node 13 .* belongs to probe_stage already, not to gripper_stage"):
            other.open()
        assert bench.stage.read().x_um == 61.7


def test_a_stage_that_is_open_already_remembers_its_reference():
    with Bench() as bench:
        bench.referenced()
        bench.stage.move_to(x_um=10.0, y_um=20.0, z_um=30.0)
        bench.stage.close()
        assert all(peer.word == SOD for peer in bench.peers.values())
        assert all(peer.number(0x1016, 1) & 0xFFFF == 0 for peer in bench.peers.values())
        bench.clock.sleep(1.0)
        assert all(peer.word == SOD for peer in bench.peers.values())
        bench.stage.open()
        assert bench.stage.referenced == {"x": True, "y": True, "z": True}
        bench.stage.move_to(x_um=11.0)
        assert bench.truth_um("x") == 11.0


def test_closing_stops_what_moves():
    with Bench() as bench:
        bench.referenced()
        bench.stage.start_move_to(x_um=600.0)
        bench.clock.sleep(0.2)
        bench.stage.close()
        bench.clock.sleep(1.0)
        assert bench.truth_um("x") < 400
        assert bench.peers["x"].word == SOD


# ---------------------------------------------------------------------- referencing


def test_referencing_runs_in_the_callers_order_unless_the_rig_file_forbids_it():
    with Bench() as bench:
        bench.opened()
        for wrong in (["x"], ["x", "z"], ["z", "y", "x"], ["y", "z", "x"]):
            with pytest.raises(UnsafeError, match="reference_order is z, x, y") as caught:
                bench.stage.reference(wrong)
            assert "reference(['z', 'x'" in caught.value.remedy
        assert not any(bench.stage.referenced.values())
        with pytest.raises(OutOfRange):
            bench.stage.reference(["q"])
        bench.stage.reference(["z"])
        bench.stage.reference(["x", "y"])
        assert [event.reason for event in bench.events if event.kind == "reference_found"] == [
            "axis z", "axis x", "axis y",
        ]  # fmt: skip
        bench.stage.reference(["x"])
        assert bench.stage.referenced == {"x": True, "y": True, "z": True}


def test_a_search_moves_only_its_axis_and_takes_its_start_bit_back():
    with Bench() as bench:
        bench.opened()
        bench.stage.reference(["z"])
        bench.clock.sleep(0.001)
        assert [peer.word for peer in bench.peers.values()] == [SOD, SOD, ENABLED]
        assert bench.peers["z"].control == 0x0F
        pose = bench.stage.read()
        assert (pose.z_um, pose.moving) == (0.0, False)
        bench.stage.reference(["z"])
        assert bench.peers["z"].homed


def test_a_method_that_ends_at_once_ends():
    with Bench() as bench:
        bench.opened()
        for peer in bench.peers.values():
            peer.homing_s = 0.0
        bench.stage.reference(["z", "x", "y"])
        assert all(bench.stage.referenced.values())


def test_moves_before_the_reference_are_refused():
    with Bench() as bench:
        bench.opened()
        bench.stage.reference(["z"])
        with pytest.raises(NotReferenced, match="axis x"):
            bench.stage.move_to(x_um=1.0, z_um=1.0)
        assert bench.stage.move_to(z_um=1.0).on_target


def test_a_bus_that_another_program_drives_is_left_alone():
    """Where the interface can be shared, as SocketCAN's, two hosts would take each other's drives away."""
    with Bench() as bench:
        other = bench.medium.open_port()
        beats = bench.clock.every(0.025, lambda: other.send(Frame(0x77F, b"\5")))
        with pytest.raises(BusyError, match="another program drives CAN bus bench") as caught:
            bench.stage.open()
        assert caught.value.moved == "no"
        assert bench.stage.link != "open"
        written = [frame for _, who, frame in bench.medium.log if frame.id in (0x60B, 0x60C, 0x60D)]
        assert {frame.data[0] & 0xE0 for frame in written} <= {0x40, 0x60}  # nothing but questions
        assert not [frame for _, who, frame in bench.medium.log if frame.id in (0x000, 0x080)]
        bench.stage.stop()  # at any time
        beats.cancel()
        bench.clock.sleep(2.5)
        bench.opened()


def test_an_interrupted_opening_is_no_fault_of_the_drives(monkeypatch, caplog):
    """Wherever Ctrl-C comes: nobody is told of silent drives, and none takes the end of our heartbeat for a fault."""
    turn = last = 0
    wait = CanLine.wait

    def interrupted(line: CanLine, flag: ClockEvent, timeout_s: float) -> bool:
        nonlocal turn
        turn += 1
        if turn == last:
            raise KeyboardInterrupt
        return wait(line, flag, timeout_s)

    monkeypatch.setattr(CanLine, "wait", interrupted)
    with Bench() as bench:
        while bench.stage.link == "closed":
            turn, last = 0, last + 3
            with suppress(KeyboardInterrupt):
                bench.stage.open()
            assert not caplog.messages, last
            if bench.stage.link == "closed":
                assert not [axis for axis, peer in bench.peers.items() if peer.number(0x1016, 1) & 0xFFFF], last
                assert all(peer.word == SOD for peer in bench.peers.values()), last
        last = 0
