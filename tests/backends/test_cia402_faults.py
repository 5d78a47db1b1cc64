"""What drives do by themselves: faults, restarts, silence; and what the bus does."""

from __future__ import annotations

from itertools import pairwise

import pytest

from microdrivers.core.errors import DeviceFault, LinkLost, NotReached
from tests.backends.cia402_bench import Bench
from tests.backends.cia402_peer import FAULT, SOD

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


def test_a_fault_in_a_move_names_axis_and_code_and_stops_the_others():
    with Bench() as bench:
        bench.referenced()
        move = bench.stage.start_move_to(x_um=600.0, y_um=600.0)
        _later(bench, 0.1, lambda: _trip(bench, "y", 0x8611))
        with pytest.raises(DeviceFault, match=r"axis y \(node 12\): following error \(error code 8611h\)") as caught:
            move.wait()
        assert (caught.value.code, caught.value.text) == (0x8611, "following error")
        assert bench.stage.fault is caught.value
        _settle(bench)
        assert bench.truth_um("x") < 400.0
        assert bench.kinds.count("fault") == 1
        assert "stopped" in bench.kinds
        pose = bench.stage.read()
        assert pose.flags == {"FAULT"}
        assert not pose.on_target
        with pytest.raises(DeviceFault, match="following error") as again:
            bench.stage.move_to(x_um=0.0)
        assert again.value.moved == "no"
        assert bench.peers["y"].word == FAULT
        bench.stage.clear_fault()
        assert bench.stage.read().flags == frozenset()
        assert (bench.stage.fault, bench.peers["y"].word) == (None, SOD)
        assert bench.stage.move_to(x_um=0.0, y_um=0.0).on_target


def test_a_fault_is_told_at_once_to_those_who_stream():
    with Bench() as bench:
        bench.referenced()
        with bench.stage.stream(50.0):
            _later(bench, 0.1, lambda: _trip(bench, "x", 0x4310))
            bench.clock.sleep(0.5)
        assert bench.kinds == ["fault"]
        assert bench.samples[-1].flags == {"FAULT"}


def test_a_fault_without_a_message_is_found_and_explained():
    with Bench() as bench:
        bench.referenced()
        move = bench.stage.start_move_to(x_um=600.0)
        _later(bench, 0.1, lambda: _trip(bench, "x", 0x7300, quietly=True))
        with pytest.raises(DeviceFault, match=r"axis x \(node 11\): sensor or encoder error \(error code 7300h\)"):
            move.wait()


def test_a_drive_at_fault_when_it_is_opened():
    with Bench() as bench:
        _trip(bench, "z", 0x3220, quietly=True)
        bench.opened()
        assert bench.stage.fault is not None
        assert bench.stage.fault.code == 0x3220
        assert bench.peers["z"].word == FAULT
        with pytest.raises(DeviceFault):
            bench.stage.reference(["z"])
        bench.stage.clear_fault()
        bench.stage.reference(["z"])


def test_a_fault_whose_cause_remains_stays():
    with Bench() as bench:
        bench.referenced()
        peer = bench.peers["x"]
        _trip(bench, "x", 0x2310)
        write = peer.on_write
        peer.on_write = lambda index, sub, data, t_ns: None if index == 0x6040 else write(index, sub, data, t_ns)
        with pytest.raises(DeviceFault, match=r"axis x \(node 11\) cannot be cleared"):
            bench.stage.clear_fault()
        assert bench.stage.fault is not None


def test_a_mere_warning_stops_nothing():
    with Bench() as bench:
        bench.referenced()
        move = bench.stage.start_move_to(x_um=300.0)
        _later(bench, 0.1, lambda: bench.peers["y"].emergency(bench.clock.now_ns(), 0x8120))
        assert move.wait().on_target
        bench.clock.sleep(0.2)
        assert not bench.kinds


def test_a_drive_that_switches_itself_off_is_a_fault():
    with Bench() as bench:
        bench.referenced()
        move = bench.stage.start_move_to(x_um=600.0)

        def switch_off() -> None:
            bench.peers["x"].word = SOD

        _later(bench, 0.1, switch_off)
        with pytest.raises(
            DeviceFault, match=r"axis x .* has left operation enabled by itself: it is in switch on disab"
        ):
            move.wait()
        bench.stage.clear_fault()
        assert bench.stage.move_to(x_um=0.0).on_target


# ---------------------------------------------------------------------- searching the reference


def test_an_emergency_during_the_search():
    with Bench() as bench:
        bench.opened()
        bench.peers["z"].homing_s = 5.0
        _later(bench, 0.5, lambda: _trip(bench, "z", 0x7121))
        with pytest.raises(DeviceFault, match=r"axis z \(node 13\): motor blocked \(error code 7121h\)"):
            bench.stage.reference(["z", "x", "y"])
        assert not any(bench.stage.referenced.values())
        assert bench.kinds.count("fault") == 1


def test_a_homing_error_is_said_with_its_method():
    with Bench() as bench:
        bench.opened()
        bench.peers["z"].homing_error = True
        with pytest.raises(DeviceFault, match=r"axis z \(node 13\) has not found its reference \(homing method 17\)"):
            bench.stage.reference(["z"])
        assert not bench.stage.referenced["z"]
        bench.peers["z"].homing_error = False
        bench.stage.clear_fault()
        bench.stage.reference(["z"])


def test_a_search_that_takes_too_long_is_stopped():
    with Bench(reference_timeout_s=1.0) as bench:
        bench.opened()
        bench.peers["z"].homing_s = 100.0
        with pytest.raises(NotReached, match="has not found its reference in 1 s"):
            bench.stage.reference(["z"])
        _settle(bench)
        assert bench.peers["z"].velocity_at(bench.clock.now_ns()) == 0.0
        assert "stopped" in bench.kinds


def test_a_search_that_the_drive_gives_up():
    with Bench() as bench:
        bench.opened()
        peer = bench.peers["z"]
        peer.homing_s = 100.0

        def give_up() -> None:
            peer._homing_until_ns = None
            peer._bits = 1 << 10

        _later(bench, 0.5, give_up)
        with pytest.raises(DeviceFault, match="the drive has given the search up"):
            bench.stage.reference(["z"])


# ---------------------------------------------------------------------- a busy computer


def test_our_heartbeat_may_be_late_by_three_quarters_of_what_drives_allow():
    with Bench(heartbeat_ms=100) as bench:
        bench.opened()
        begin_ns = bench.clock.now_ns()
        bench.clock.sleep(1.0)
        beats_ns = [t_ns for t_ns, who, frame in bench.medium.log if frame.id == 0x77F and t_ns > begin_ns]
        assert max(after - before for before, after in pairwise(beats_ns)) < 30_000_000


@pytest.mark.parametrize("busy", [True, False])
def test_a_drive_that_missed_our_heartbeat_is_not_blamed_for_a_busy_computer(busy):
    with Bench() as bench:
        bench.referenced()
        if busy:
            bench.stage._line.lateness.note(bench.clock.now_ns(), 180_000_000)
        _trip(bench, "y", 0x8130)
        _settle(bench)
        fault = bench.stage.fault
        assert ("this computer is too busy: our heartbeat was 180 ms late" in fault.what) is busy
        assert ("end other programs" in fault.remedy) is busy
        assert fault.remedy.endswith("then clear_fault()")


def test_a_silent_drive_may_be_one_that_a_busy_computer_did_not_hear():
    with Bench() as bench:
        bench.referenced()
        bench.stage._line.lateness.note(bench.clock.now_ns(), 180_000_000)
        move = bench.stage.start_move_to(x_um=600.0, y_um=600.0, speed_um_s=100.0)
        _later(bench, 0.1, lambda: bench.medium.detach(bench.peers["y"]))
        with pytest.raises(LinkLost, match=r"axis y \(node 12\).*this computer is too busy"):
            move.wait()
        assert "too busy" in next(event.reason for event in bench.events if event.kind == "link_lost")
