"""Drives that restart or fall silent, and a bus that fails."""

from __future__ import annotations

import pytest

from microdrivers.core.errors import (
    LinkError,
    LinkLost,
    LinkTimeout,
    MicrodriversError,
    MoveCancelled,
    NotReferenced,
    ProtocolError,
    ReferenceLost,
)
from microdrivers.fakes.can import Frame
from tests.backends.cia402_bench import NODES, Bench
from tests.backends.cia402_peer import ENABLED, FAULT

MS = 1_000_000


def _later(bench: Bench, seconds: float, what: object) -> None:
    assert callable(what)

    def do() -> None:
        what()
        bench.medium.refresh()

    bench.clock.call_at(bench.clock.now_ns() + round(seconds * 1e9), do)


def _trip(bench: Bench, axis: str, code: int, *, quietly: bool = False) -> None:
    """A drive trips; its message goes out with its next heartbeat at the latest."""
    bench.peers[axis].fail(bench.clock.now_ns(), code, quietly=quietly)


def _settle(bench: Bench) -> None:
    bench.clock.sleep(0.5)


# ---------------------------------------------------------------------- restarts and silence


def test_a_drive_that_restarts_in_a_move():
    with Bench() as bench:
        bench.referenced()
        move = bench.stage.start_move_to(x_um=600.0, y_um=600.0, speed_um_s=500.0)
        _later(bench, 0.2, lambda: bench.replace("y"))
        with pytest.raises(ReferenceLost):
            move.wait()
        _settle(bench)
        assert bench.truth_um("x") < 300.0
        assert [event.reason for event in bench.events if event.kind == "reference_lost"] == [
            "axis y (node 12) has restarted"
        ]
        assert bench.stage.referenced == {"x": True, "y": False, "z": True}
        with pytest.raises(NotReferenced, match="axis y"):
            bench.stage.move_to(y_um=0.0)
        assert bench.stage.read().y_um == 61.7
        assert bench.peers["y"].number(0x607D, 2) == 12_500
        bench.stage.reference(["y"])
        as_far_um = bench.stage.read().x_um
        assert bench.stage.move_to(x_um=0.0, y_um=-as_far_um, speed_um_s=500.0).on_target
        assert bench.peers["y"].number(0x6083, 0) == 200_000  # it has forgotten what it was told before


def test_drives_that_lose_their_power_together_are_all_named_and_referenced_in_the_order():
    with Bench() as bench:
        bench.referenced()
        for axis in bench.peers:
            bench.medium.detach(bench.peers[axis])
        bench.clock.sleep(0.3)
        with pytest.raises(LinkLost) as lost:
            bench.stage.move_to(x_um=0.0)
        for axis, node in NODES.items():
            assert f"axis {axis} (node {node})" in lost.value.what
        for axis in tuple(bench.peers):
            bench.replace_detached(axis)
        bench.clock.sleep(0.5)
        with pytest.raises(NotReferenced, match="axis y") as caught:
            bench.stage.move_to(y_um=0.0)
        assert "reference(['z', 'x', 'y'])" in caught.value.remedy
        with pytest.raises(NotReferenced, match="axis x") as caught:
            bench.stage.move_to(x_um=0.0)
        assert "reference(['z', 'x'])" in caught.value.remedy
        bench.stage.reference(["z", "x"])
        assert bench.stage.move_to(x_um=0.0).on_target


def test_all_that_have_restarted_are_named_and_are_to_be_referenced():
    with Bench() as bench:
        bench.referenced()
        for axis in ("y", "z"):
            bench.stage._drives.by_axis[axis].forget()
        with pytest.raises(LinkLost, match=r"axis y \(node 12\), axis z \(node 13\) have restarted") as caught:
            bench.stage._guard.refuse()
        assert "reference(['z', 'y'])" in caught.value.remedy


def test_a_restart_is_noticed_without_asking_and_the_stream_goes_on():
    with Bench() as bench:
        bench.referenced()
        with bench.stage.stream(100.0):
            bench.clock.sleep(0.2)
            bench.replace("x")
            bench.clock.sleep(0.5)
            assert bench.kinds == ["reference_lost"]
            newest = bench.samples[-1]
            assert bench.clock.now_ns() - newest.t_ns < 20 * MS
            assert not newest.referenced
            assert newest.x_um == 61.7
        counters = bench.stage.line_counters
        assert 1 <= counters["lost_samples"] + counters["skipped_samples"] <= 12


def test_a_drive_that_falls_silent_in_a_move_is_noticed_within_two_heartbeats():
    with Bench() as bench:
        bench.referenced()
        move = bench.stage.start_move_to(x_um=600.0, y_um=600.0, speed_um_s=200.0)
        bench.clock.sleep(0.33)
        gone_ns = bench.clock.now_ns()
        bench.medium.detach(bench.peers["y"])
        with pytest.raises(LinkError):
            move.wait()
        bench.clock.sleep(0.2)
        noticed = next(event for event in bench.events if event.kind == "link_lost")
        assert noticed.t_ns - gone_ns <= 200 * MS
        assert "axis y (node 12)" in noticed.reason
        assert bench.stage.link == "lost"
        _settle(bench)
        assert bench.truth_um("x") < 200.0
        assert bench.peers["x"].velocity_at(bench.clock.now_ns()) == 0.0
        assert not bench.stage.referenced["y"]
        with pytest.raises(LinkLost):
            bench.stage.move_to(x_um=0.0)
        bench.replace_detached("y")
        bench.clock.sleep(0.3)
        assert bench.stage.link == "open"
        assert bench.kinds[-1] == "link_back"
        with pytest.raises(NotReferenced):
            bench.stage.move_to(y_um=0.0)
        assert bench.stage.move_to(x_um=0.0).on_target


def test_a_cable_that_was_loose_costs_no_reference_that_the_drive_still_knows():
    with Bench() as bench:
        bench.referenced()
        peer = bench.peers["z"]
        bench.medium.detach(peer)
        bench.clock.sleep(1.0)
        assert bench.kinds == ["reference_lost", "link_lost"]
        peer._consumer_ns = 0
        bench.medium.attach(peer)
        bench.clock.sleep(1.5)
        assert bench.kinds[2:] == ["reference_found", "link_back"]
        assert all(bench.stage.referenced.values())
        assert bench.stage.move_to(z_um=5.0).on_target


def test_a_drive_that_another_master_stops_is_set_up_again():
    with Bench() as bench:
        bench.referenced()
        other = bench.medium.open_port()
        other.send(Frame(0x000, bytes([0x02, 11])))
        bench.clock.sleep(1.5)
        assert bench.stage.read().x_um == 0.0
        assert bench.peers["x"].state == 0x05


def test_the_drives_stop_when_our_heartbeat_stops():
    """What the killed host leaves behind; here the adapter's cable is pulled."""
    with Bench() as bench:
        bench.referenced()
        bench.stage.start_move_to(x_um=600.0, speed_um_s=200.0)
        bench.clock.sleep(0.3)
        bench.medium.unplug()
        bench.clock.sleep(0.2)
        assert [peer.word for peer in bench.peers.values()] == [FAULT] * 3
        assert bench.peers["x"].velocity_at(bench.clock.now_ns()) == 0.0
        assert "link_lost" in bench.kinds
        assert bench.stage.link == "lost"
        with pytest.raises(LinkLost):
            bench.stage.stop()
        bench.medium.plug_in()
        bench.stage.open()
        assert bench.stage.fault is not None
        assert bench.stage.fault.code == 0x8130
        bench.stage.clear_fault()
        assert all(bench.stage.referenced.values())
        assert bench.stage.move_to(x_um=0.0).on_target


def test_our_heartbeat_is_heard_while_a_drive_does_not_answer():
    with Bench() as bench:
        bench.referenced()
        bench.stage.move_to(x_um=1.0, y_um=1.0)
        bench.peers["y"].all_silent = True
        for _ in range(5):
            with pytest.raises(LinkTimeout, match=r"axis y \(node 12\), writing 6081h|writing 607Ah\.0"):
                bench.stage.move_to(x_um=2.0, y_um=2.0)
        assert [peer.word for peer in bench.peers.values()] == [ENABLED] * 3
        bench.peers["y"].all_silent = False
        assert bench.stage.move_to(x_um=2.0, y_um=2.0).on_target


# ---------------------------------------------------------------------- the bus


def test_bus_off_is_a_lost_link_with_a_remedy():
    with Bench() as bench:
        bench.referenced()
        bench.medium.bus_off()
        with pytest.raises(LinkLost, match="bus-off"):
            bench.stage.read()
        assert bench.kinds == ["link_lost"]
        bench.stage.open()
        assert bench.stage.read().x_um == 0.0


def test_one_drive_without_pdos_is_named():
    with Bench() as bench:
        bench.opened()
        bench.peers["y"].mute_pdo = True
        with pytest.raises(LinkTimeout, match=r"axis y \(node 12\): no answer to SYNC from 18Ch"):
            bench.stage.read()
        with bench.stage.stream(50.0):
            bench.clock.sleep(2.0)
        assert bench.kinds[-1] == "link_lost"
        counters = bench.stage.line_counters
        assert counters["lost_samples"] + counters["skipped_samples"] >= 99
        assert len(bench.samples) == 0


def test_a_pdo_of_another_length_is_no_position():
    with Bench() as bench:
        bench.opened()
        bench.peers["x"].put(0x1A00, 0, 2)
        with pytest.raises(ProtocolError, match=r"axis x \(node 11\): its status PDO has 6 bytes, not 7"):
            bench.stage.read()
        with bench.stage.stream(50.0):
            bench.clock.sleep(0.2)
        assert not bench.samples


def test_errors_name_the_device():
    with Bench() as bench:
        bench.peers["x"].aborts[0x6098, 0] = 0x06090030
        with pytest.raises(
            MicrodriversError, match=r"probe_stage: axis x \(node 11\) refuses writing 6098h\.0"
        ) as caught:
            bench.stage.open()
        assert caught.value.moved == "no"


def test_a_drive_that_is_moved_by_somebody_else_is_not_opened():
    with Bench() as bench:
        bench.referenced()
        bench.stage.start_move_to(x_um=600.0, speed_um_s=100.0)
        other = Bench.__new__(Bench)
        other.clock, other.channel, other.medium, other.peers = bench.clock, bench.channel, bench.medium, bench.peers
        for drive in bench.stage._drives.all:
            drive.node.detach()  # as if it were another program's
        values = bench.stage._settings.model_dump()
        stage = other.make("probe_stage", values, bench.stage.bus)
        with pytest.raises(MicrodriversError, match=r"axis x \(node 11\) is moving"):
            stage.open()


def test_cancelled_is_cancelled():
    with Bench() as bench:
        bench.referenced()
        move = bench.stage.start_move_to(x_um=600.0)
        bench.clock.sleep(0.1)
        move.cancel()
        with pytest.raises(MoveCancelled):
            move.wait()
        _settle(bench)
        assert bench.truth_um("x") < 300.0
