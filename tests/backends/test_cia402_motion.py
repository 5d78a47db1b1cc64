"""The fine stage on three scripted drives: moving, stopping, streaming."""

from __future__ import annotations

import math
from functools import partial

import pytest

from microdrivers.backends.cia402 import FineStageSettings
from microdrivers.core.bus import Bus
from microdrivers.core.errors import (
    MoveCancelled,
    MoveSuperseded,
    OutOfRange,
    ProtocolError,
)
from microdrivers.core.samples import FineStageSample
from microdrivers.core.units import Range
from tests.backends.cia402_bench import COUNTS, NODES, Bench
from tests.backends.cia402_peer import READY, SOD

COUNT_UM = 1 / COUNTS


# ---------------------------------------------------------------------- moving


def test_a_move_in_three_axes_is_straight_and_ends_to_the_count():
    with Bench() as bench:
        bench.referenced()
        bench.stage.move_to(x_um=-400.0, y_um=300.0, z_um=-100.0)
        start = (-400.0, 300.0, -100.0)
        target = (400.0, -300.0, -93.0)
        length = math.dist(start, target)
        move = bench.stage.start_move_to(x_um=target[0], y_um=target[1], z_um=target[2])
        worst_um = 0.0
        while any(peer.velocity_at(bench.clock.now_ns()) for peer in bench.peers.values()):
            bench.clock.sleep(0.003)
            here = tuple(bench.truth_um(axis) for axis in "xyz")
            along = sum((p - s) * (t - s) for p, s, t in zip(here, start, target, strict=True)) / length
            off_um = math.sqrt(max(0.0, math.dist(here, start) ** 2 - along**2))
            worst_um = max(worst_um, off_um)
        pose = move.wait()
        assert length > 1000.0
        assert worst_um <= 0.5
        assert all(abs(bench.truth_um(axis) - end) <= COUNT_UM for axis, end in zip("xyz", target, strict=True))
        assert pose.on_target
        starts = [peer.starts[-1][0] for peer in bench.peers.values()]
        assert max(starts) - min(starts) <= 300_000


@pytest.mark.parametrize("direction", [1, -1])
def test_signs_and_counts(direction: int):
    with Bench(axes={"x": {"direction": direction, "travel_um": Range(-100.0, 600.0)}}) as bench:
        bench.referenced()
        bench.stage.move_to(x_um=500.03)
        assert bench.peers["x"].exact == direction * 10_001
        assert bench.stage.read().x_um == pytest.approx(500.05)
        bench.stage.move_by(dx_um=-599.9)
        assert bench.truth_um("x") == pytest.approx(direction * -99.85, abs=COUNT_UM)


def test_on_target_is_never_early():
    with Bench() as bench:
        bench.referenced()
        errors_um: list[float] = []

        def hold_against_the_truth(sample: FineStageSample) -> None:
            if sample.on_target:
                errors_um.append(abs(bench.truth_um("x", sample.t_ns) - sample.target_x_um))

        bench.stage.topic.subscribe(hold_against_the_truth)
        with bench.stage.stream(500.0):
            for target in (300.0, 300.05, 250.0, 250.0):
                bench.stage.move_to(x_um=target)
                assert abs(bench.truth_um("x") - target) <= 0.15
        assert len(errors_um) > 10
        assert max(errors_um) <= 0.15


def test_targets_are_checked_before_the_drive():
    with Bench() as bench:
        bench.referenced()
        before = {axis: len(peer.requests) for axis, peer in bench.peers.items()}
        for bad in ({"x_um": 625.01}, {"y_um": math.nan}, {"x_um": 10.0, "z_um": -1e9}):
            with pytest.raises(OutOfRange):
                bench.stage.move_to(**bad)
        with pytest.raises(OutOfRange):
            bench.stage.move_to(x_um=1.0, speed_um_s=1001.0)
        assert before == {axis: len(peer.requests) for axis, peer in bench.peers.items()}
        assert bench.stage.move_to(x_um=625.0, y_um=-625.0).on_target


def test_only_what_has_changed_is_written():
    with Bench() as bench:
        bench.referenced()
        bench.stage.move_to(x_um=100.0)
        bench.peers["x"].written.clear()
        bench.stage.move_to(x_um=200.0)
        profile = [index for index, _, _ in bench.peers["x"].written if index in range(0x6080, 0x6085)]
        assert profile == []
        assert not bench.peers["y"].starts


def test_a_newer_move_replaces_an_older_one_on_the_way():
    with Bench() as bench:
        bench.referenced()
        older = bench.stage.start_move_to(x_um=600.0)
        bench.clock.sleep(0.1)
        bench.stage.move_to(x_um=-100.0)
        with pytest.raises(MoveSuperseded):
            older.wait()
        assert bench.truth_um("x") == -100.0


def test_an_axis_that_has_to_turn_round_brakes_as_hard_as_it_may():
    """It has a hundredth of the new way to go: with its share of the acceleration it would run on for half a metre."""
    with Bench() as bench:
        bench.referenced()
        bench.stage.start_move_to(z_um=500.0)
        bench.clock.sleep(0.3)
        assert bench.peers["z"].velocity_at(bench.clock.now_ns()) == 20_000
        pose = bench.stage.move_to(x_um=600.0, z_um=bench.truth_um("z") - 6.0)
        assert pose.on_target


def test_retracting_goes_where_the_rig_file_says():
    with Bench() as bench:
        bench.referenced()
        bench.stage.move_to(z_um=-600.0)
        bench.stage.retract().wait()
        assert bench.truth_um("z") == -100.0


def test_a_set_point_that_is_not_acknowledged_is_no_move():
    with Bench() as bench:
        bench.referenced()
        bench.peers["y"].no_acknowledge = True
        with pytest.raises(ProtocolError, match=r"axis y \(node 12\) does not acknowledge its set-point"):
            bench.stage.move_to(x_um=100.0, y_um=100.0)
        bench.clock.sleep(0.5)
        at_rest = bench.truth_um("x")
        bench.clock.sleep(0.5)
        assert bench.truth_um("x") == at_rest < 100.0 + COUNT_UM
        assert "stopped" in bench.kinds
        bench.peers["y"].no_acknowledge = False
        assert bench.stage.move_to(x_um=50.0, y_um=50.0).on_target


def test_a_refused_parameter_starts_nothing():
    with Bench() as bench:
        bench.referenced()
        bench.peers["y"].aborts[0x607A, 0] = 0x06090031
        with pytest.raises(Exception, match=r"axis y \(node 12\) refuses writing 607Ah\.0: value too high") as caught:
            bench.stage.move_to(x_um=100.0, y_um=100.0)
        assert caught.value.moved == "no"  # type: ignore[attr-defined]
        assert not bench.peers["x"].starts


# ---------------------------------------------------------------------- stopping


@pytest.mark.parametrize("option", [6, 2])
def test_a_stop_ends_the_move_and_a_new_one_works(option: int):
    with Bench() as bench:
        for peer in bench.peers.values():
            peer.quick_stop_options = (option,)
        bench.referenced()
        move = bench.stage.start_move_to(x_um=600.0, y_um=600.0)
        bench.clock.sleep(0.2)
        bench.stage.stop(reason="test")
        sent = [(frame.id, frame.data) for _, who, frame in bench.medium.log if who == "host"]
        bench.clock.sleep(0.3)
        sent = [(frame.id, frame.data) for _, who, frame in bench.medium.log if who == "host" and frame.id >> 8 == 2]
        assert sent[-3:] == [(0x200 + node_id, b"\2\0") for node_id in NODES.values()]
        at_rest = bench.truth_um("x")
        pose = bench.stage.read()
        assert (pose.moving, pose.on_target) == (False, False)
        assert math.isnan(pose.target_x_um)
        with pytest.raises(MoveCancelled):
            move.wait()
        assert bench.truth_um("x") == at_rest < 300.0
        bench.stage.move_to(x_um=0.0, y_um=5.0)
        assert bench.truth_um("x") == 0.0
        assert all(bench.stage.referenced.values())


def test_a_stop_before_anybody_knows_who_is_there():
    """`microdrivers stop` only connects: nothing is known of the drives' PDOs."""
    with Bench() as bench:
        bench.referenced()
        bench.stage.start_move_to(x_um=600.0)
        bench.clock.sleep(0.2)
        own = {axis: getattr(bench.stage._settings.axes, axis).model_dump() for axis in NODES}
        settings = {"connection": {"interface": "microdrivers", "channel": bench.channel, "timeout_s": 0.1}}
        values = FineStageSettings.model_validate(
            settings | {"axes": own, "reference_order": ("z", "x", "y")}
        ).model_dump()
        other = bench.make("probe_stage", values, Bus())
        other.connect()
        other.stop()
        bench.clock.sleep(0.3)
        assert bench.truth_um("x") < 400.0
        assert bench.peers["x"].velocity_at(bench.clock.now_ns()) == 0.0
        other.close()


def test_a_stop_during_the_handshake_stops():
    with Bench() as bench:
        bench.referenced()
        peer = bench.peers["y"]
        write = peer.on_write

        def stop_then_write(index: int, sub: int, data: bytes, t_ns: int) -> None:
            if index == 0x6083:
                bench.stage.stop()
            write(index, sub, data, t_ns)

        peer.on_write = stop_then_write
        with pytest.raises(MoveCancelled):
            bench.stage.move_to(x_um=100.0, y_um=100.0)
        bench.clock.sleep(0.5)
        assert bench.truth_um("x") == 0.0
        assert not peer.starts


@pytest.mark.parametrize("what", ["a move", "a search"])
def test_a_stop_just_before_the_start_bit_is_sent_again(what: str, monkeypatch: pytest.MonkeyPatch):
    """Another thread's stop may reach the drive before the word that starts it."""
    with Bench() as bench:
        bench.referenced()
        bench.stage.move_to(z_um=50.0)
        drive = bench.stage._drives.by_axis["z"]
        send = drive.control

        def stop_then_send(word: int) -> None:
            if word & 0x10:
                drive.quick_stop()
                bench.stage._drives.stops += 2
            send(word)

        monkeypatch.setattr(drive, "control", stop_then_send)
        bench.peers["z"].homing_s = 5.0
        start = partial(bench.stage.move_to, z_um=600.0) if what == "a move" else partial(bench.stage.reference, ["z"])
        with pytest.raises(MoveCancelled):
            start()
        bench.clock.sleep(0.3)
        assert bench.peers["z"].control == 0x02
        assert bench.peers["z"].velocity_at(bench.clock.now_ns()) == 0.0


def test_a_stop_while_searching_the_reference():
    with Bench() as bench:
        bench.opened()
        for peer in bench.peers.values():
            peer.homing_s = 5.0
        bench.clock.call_at(bench.clock.now_ns() + 500_000_000, bench.stage.stop)
        with pytest.raises(MoveCancelled, match=r"reference search of axis z \(node 13\) was stopped"):
            bench.stage.reference(["z", "x", "y"])
        assert not any(bench.stage.referenced.values())
        assert bench.peers["x"].word == SOD
        assert READY not in [peer.word for peer in bench.peers.values()]


# ---------------------------------------------------------------------- streaming


def test_a_stream_publishes_each_sync_once_in_order():
    with Bench() as bench:
        bench.referenced()
        first = len(bench.samples)
        begun = bench.clock.now_ns()
        with bench.stage.stream(100.0):
            assert bench.stage.streaming
            bench.stage.start_move_to(x_um=500.0)
            bench.clock.sleep(3.0)
        samples = bench.samples[first + 1 :]
        assert len(samples) == pytest.approx(300, abs=3)
        assert [sample.seq for sample in samples] == list(range(samples[0].seq, samples[0].seq + len(samples)))
        times = [sample.t_ns for sample in samples]
        assert times == sorted(set(times))
        assert times[0] >= begun
        counters = bench.stage.line_counters
        assert counters["lost_samples"] == counters["skipped_samples"] == 0
        assert not bench.stage.streaming
        assert 0.05 < bench.stage.bus_load < 0.3
        with pytest.raises(OutOfRange, match="stream rate"), bench.stage.stream(2000.0):
            pass


def test_moves_are_supervised_beside_a_stream():
    with Bench() as bench:
        bench.referenced()
        with bench.stage.stream(100.0):
            for target in (100.0, -100.0, 33.0):
                assert bench.stage.move_to(x_um=target, y_um=target).on_target
        counters = bench.stage.line_counters
        assert counters["lost_samples"] == counters["skipped_samples"] == 0
        times = [sample.t_ns for sample in bench.samples]
        assert times == sorted(times)
