"""The drive stops by itself when the host falls silent, and not before."""

from __future__ import annotations

import itertools

import pydantic
import pytest

from microdrivers.core.clock import SystemClock
from microdrivers.core.errors import DeviceFault, LinkLost, LinkTimeout, RefusedError
from microdrivers.core.units import NS_PER_S
from tests.backends.oriental_az_bench import Bench, at_steps, sheet
from tests.backends.oriental_az_peer import SheetDrive, with_crc

ONE_SECOND = with_crc(bytes.fromhex("0110138A000204000003E8"))
OFF = with_crc(bytes.fromhex("0110138A00020400000000"))


def guarded(drive: SheetDrive | None = None, *, timeout_s: float = 1.0, **changes: object) -> Bench:
    return Bench(drive, communication_timeout_s=timeout_s, **changes)


def longest_silence_s(bench: Bench) -> float:
    heard = [t_ns for t_ns, side, _ in bench.wire.log if side == "host"]
    return max(b - a for a, b in itertools.pairwise([*heard, bench.clock.now_ns()])) / NS_PER_S


# ---------------------------------------------------------------------- settings


@pytest.mark.parametrize(("timeout_s", "reply_s"), [(0.05, 0.01), (10.5, 0.2), (0.45, 0.2), (2.0, 1.0)])
def test_a_time_out_that_the_drive_or_a_lost_reply_does_not_allow(timeout_s: float, reply_s: float) -> None:
    with pytest.raises(pydantic.ValidationError, match="communication_timeout_s"):
        Bench(communication_timeout_s=timeout_s, connection={"timeout_s": reply_s})


# ---------------------------------------------------------------------- setting it


def test_it_is_set_at_opening_and_taken_back_at_closing() -> None:
    bench = guarded().opened()
    drive = sheet(bench)
    assert drive.communication_timeout_ms == 1000
    bench.clock.run_for(2.0)
    bench.motor.close()
    assert [data for data in drive.requests if data[1] not in (0x03, 0x08)] == [ONE_SECOND, OFF]
    seen = len(drive.requests)
    bench.clock.run_for(10.0)
    assert (len(drive.requests), drive.alarm) == (seen, 0)
    assert bench.kinds == ["opened", "closed"]


def test_without_the_setting_the_drive_keeps_its_own_and_is_kept_alive() -> None:
    drive = SheetDrive(position=1000)
    drive.communication_timeout_ms = 400
    bench = Bench(drive).opened()
    bench.clock.run_for(5.0)
    assert drive.alarm == 0
    bench.motor.close()
    assert {data[1] for data in drive.requests} == {0x03}
    assert drive.communication_timeout_ms == 400


def test_without_a_time_out_nothing_is_asked() -> None:
    bench = Bench().opened()
    seen = len(sheet(bench).requests)
    bench.clock.run_for(10.0)
    assert len(sheet(bench).requests) == seen


def test_a_drive_that_does_not_take_it() -> None:
    drive = SheetDrive(position=1000)
    drive.takes_parameters = False
    bench = guarded(drive)
    with pytest.raises(RefusedError, match="zoom: the drive was given a communication time-out of 1000 ms and has 0"):
        bench.motor.open()
    assert bench.motor.link == "closed"


# ---------------------------------------------------------------------- keeping the drive alive


@pytest.mark.parametrize("timeout_s", [0.5, 1.0, 10.0])
def test_an_idle_host_speaks_at_less_than_half_the_time_out(timeout_s: float) -> None:
    bench = guarded(timeout_s=timeout_s).opened()
    bench.clock.run_for(20 * timeout_s)
    assert longest_silence_s(bench) < timeout_s / 2
    assert (sheet(bench).alarm, bench.motor.link) == (0, "open")
    bench.motor.move_to(zoom=3.0)


def test_a_stream_is_enough() -> None:
    alone, guarding = Bench().opened(), guarded().opened()
    counts = []
    for bench in (alone, guarding):
        with bench.motor.stream(20.0):
            seen = len(sheet(bench).requests)
            bench.clock.run_for(3.0)
            counts.append(len(sheet(bench).requests) - seen)
    assert counts[0] == counts[1]


def test_a_lost_reply_costs_nothing() -> None:
    bench = guarded(timeout_s=0.5).opened()
    for _ in range(10):
        bench.clock.run_for(0.3)
        sheet(bench).spoil = [lambda reply: b""]
    assert (sheet(bench).alarm, bench.motor.link, bench.kinds) == (0, "open", ["opened"])


def test_a_move_of_a_host_that_dies_ends_with_the_alarm() -> None:
    bench = guarded(timeout_s=0.5, speed_steps_s=2000).opened()
    bench.motor.start_move_to(zoom=9.0)
    bench.motor._guard._timer.cancel()  # type: ignore[union-attr]
    bench.clock.run_for(1.0)
    assert sheet(bench).alarm == 0x85
    stopped = sheet(bench).command(bench.clock.now_ns())
    assert stopped < 1000 + 2000 * 0.6


def test_a_power_failure_does_not_leave_the_drive_unwatched() -> None:
    bench = guarded().opened()
    bench.clock.run_for(1.0)
    sheet(bench).deaf = True
    sheet(bench).power_cycle()
    bench.clock.run_for(3.0)
    sheet(bench).deaf = False

    def lost(_reply: bytes) -> bytes:
        assert sheet(bench).requests[-1] == ONE_SECOND
        sheet(bench).communication_timeout_ms = 0
        return b""

    sheet(bench).spoil = [lambda reply: reply] * 2 + [lost]
    bench.clock.run_for(3.0)
    assert not sheet(bench).spoil
    assert sheet(bench).communication_timeout_ms == 1000
    assert [kind for kind in bench.kinds if kind.startswith("link")][-1] == "link_back"


# ---------------------------------------------------------------------- links and threads


def test_an_unplugged_cable_is_reported_once() -> None:
    bench = guarded().opened()
    bench.clock.run_for(1.0)
    bench.wire.unplug()
    bench.clock.run_for(5.0)
    assert (bench.kinds, bench.motor.link) == (["opened", "link_lost"], "lost")
    with pytest.raises(LinkLost, match="lost"):
        bench.motor.read()
    bench.wire.plug_in()
    bench.motor.open()
    assert bench.motor.link == "open"
    assert sheet(bench).communication_timeout_ms == 1000


def test_opened_again_it_speaks_as_often_as_before() -> None:
    bench = guarded()
    counts = []
    for _ in range(2):
        bench.motor.open()
        seen = len(sheet(bench).requests)
        bench.clock.run_for(5.0)
        counts.append(len(sheet(bench).requests) - seen)
        bench.motor.close()
    assert counts[0] == counts[1] > 0


def test_closing_a_device_whose_link_is_lost() -> None:
    bench = guarded().opened()
    bench.wire.unplug()
    bench.motor.close()
    assert bench.motor.link == "closed"
    bench.clock.run_for(3.0)
    assert bench.kinds == ["opened", "closed"]


def test_closing_from_a_subscriber_of_the_keep_alive() -> None:
    bench = guarded().opened()
    bench.motor.topic.subscribe(lambda sample: bench.motor.close())
    bench.clock.run_for(3.0)
    assert bench.motor.link == "closed"
    assert sheet(bench).requests[-1] == OFF


def test_an_opening_that_fails_behind_the_setting_takes_it_back() -> None:
    drive = SheetDrive(position=1000)
    bench = guarded(drive)
    drive.spoil = [lambda reply: reply] * 4 + [lambda reply: b""] * 2
    with pytest.raises(LinkTimeout):
        bench.motor.open()
    assert drive.communication_timeout_ms == 0
    bench.clock.run_for(3.0)
    assert drive.alarm == 0


@pytest.mark.xdist_group("real_time")
def test_closing_in_real_time_waits_for_a_beat_under_way() -> None:
    clock = SystemClock()
    bench = guarded(timeout_s=0.5, clock=clock).opened()
    beat = clock.event()
    bench.motor.topic.subscribe(lambda sample: beat.set())
    assert beat.wait(20)
    bench.motor.close()
    seen = len(sheet(bench).requests)
    assert sheet(bench).requests[-1] == OFF
    clock.sleep(0.5)
    assert len(sheet(bench).requests) == seen
    clock.close()


# ---------------------------------------------------------------------- the alarms


def dead_host(timeout_ms: int = 800) -> SheetDrive:
    """A drive whose host has died."""
    drive = SheetDrive(position=1000)
    drive.communication_timeout_ms, drive.alarm = timeout_ms, 0x85
    return drive


def test_opening_after_the_host_died_tells_so_and_leaves_the_device_open() -> None:
    bench = Bench(dead_host()).opened()
    assert (bench.motor.link, bench.kinds) == ("open", ["fault", "opened"])
    fault = bench.motor.fault
    assert fault is not None
    assert (fault.code, fault.device) == (0x85, "zoom")
    assert "heard nothing from the host for longer than its communication time-out (0.8 s)" in fault.what
    assert "host was stopped or suspended, or the cable pulled" in fault.remedy
    assert "clear_fault()" in fault.remedy
    with pytest.raises(DeviceFault, match=r"does not move: alarm 85h .*\(0.8 s\)"):
        bench.motor.move_to(zoom=2.0)
    bench.motor.clear_fault()
    assert bench.motor.fault is None
    assert bench.motor.move_to(zoom=2.0).on_target


def test_an_alarm_while_the_device_is_open_is_noticed_by_the_keep_alive() -> None:
    bench = guarded().opened()
    sheet(bench).alarm = 0x84
    bench.clock.run_for(1.0)
    assert bench.kinds == ["opened", "fault"]
    fault = bench.motor.fault
    assert fault is not None
    assert "alarm 84h is on: too many bad frames" in fault.what
    assert "wiring, termination, baud rate and parity" in fault.remedy
    bench.motor.clear_fault()
    bench.clock.run_for(3.0)
    assert bench.motor.fault is None


def test_a_suspended_host_finds_the_alarm() -> None:
    bench = guarded().opened()
    drive = sheet(bench)
    drive.deaf = True  # as good as silent
    bench.clock.run_for(2.0)
    drive.deaf = False
    bench.clock.run_for(2.0)
    assert drive.alarm == 0x85
    assert sorted(bench.kinds) == ["fault", "link_back", "link_lost", "opened"]
    bench.motor.clear_fault()
    assert bench.motor.move_to(zoom=at_steps(1100)).position_steps == 1100
