from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

import pytest

from microdrivers.core.clock import Clock, SystemClock
from microdrivers.core.errors import (
    DeviceFault,
    LinkTimeout,
    MoveCancelled,
    NotReached,
    NotReferenced,
)
from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.fakes.wire import Reply
from tests.backends.oriental_az_bench import INPUTS_OFF, STOP_ON, Bench, at_steps, check_honesty, sheet
from tests.backends.oriental_az_peer import SheetDrive

# ---------------------------------------------------------------------- stopping


def test_a_stop_is_taken_back_before_the_next_move() -> None:
    bench = Bench().opened()
    move = bench.motor.start_move_to(zoom=9.0)
    bench.clock.run_for(0.1)
    bench.motor.stop()
    with pytest.raises(MoveCancelled):
        move.wait()
    bench.clock.run_for(0.5)
    for _ in range(3):
        stopped = bench.motor.read()
        bench.clock.run_for(0.1)
    assert (stopped.moving, stopped.on_target) == (False, False)
    assert sheet(bench).input == 0x20
    bench.motor.move_to(zoom=at_steps(2000))
    writes = [data for data in sheet(bench).requests if data[1] in (0x06, 0x10)]
    assert [data[:4].hex() for data in writes] == ["0106007d", "01100058", "0106007d", "0106007d", "01100058"]
    assert (writes[2], writes[3]) == (STOP_ON, INPUTS_OFF)


def test_a_stop_from_a_subscriber_of_the_stream() -> None:
    bench = Bench().opened()
    bench.motor.topic.subscribe(lambda sample: bench.motor.stop() if sample.position_steps > 3000 else None)
    with bench.motor.stream(60.0), pytest.raises(MoveCancelled):
        bench.motor.start_move_to(zoom=9.0).wait()
    bench.clock.run_for(0.5)
    assert 3000 < bench.motor.read().position_steps < 5000


class HeldDrive(SheetDrive):
    """Keeps its replies back while `hold` is set; the wire looks for them every millisecond."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(position=1000)
        self.hold = threading.Event()
        self.asked = threading.Event()
        self._clock = clock
        self._kept: list[bytes] = []
        self._next_ns: int | None = None

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        replies = super().receive(data, start_ns, end_ns)
        if not self.hold.is_set():
            return replies
        self._kept += [reply.data for reply in replies]
        self._next_ns = end_ns
        self.asked.set()
        return ()

    def next_event_ns(self) -> int | None:
        return self._next_ns

    def advance(self, t_ns: int) -> Sequence[Reply]:
        if self.hold.is_set():
            self._next_ns = t_ns + NS_PER_MS
            return ()
        self._next_ns = None
        kept, self._kept = self._kept, []
        return [Reply(t_ns, data) for data in kept]


def test_a_stop_during_an_exchange_of_another_thread() -> None:
    clock = SystemClock()
    drive = HeldDrive(clock)
    bench = Bench(drive, clock=clock, connection={"timeout_s": 20.0}).opened()
    seen = len(bench.wire.log)
    drive.hold.set()
    results: list[int] = []
    reader = threading.Thread(target=lambda: results.append(bench.motor.read().position_steps))
    reader.start()
    assert drive.asked.wait(20)
    bench.motor.stop()  # returns although the other thread's reply is still kept back
    assert results == []
    drive.hold.clear()
    reader.join(20)
    assert results == [1000]
    traffic = [(side, data) for _, side, data in list(bench.wire.log)[seen:]]
    stop_at = traffic.index(("host", STOP_ON))
    assert traffic[stop_at - 1][0] == "device"  # behind the reply, never into it
    assert bench.motor.read().position_steps == 1000  # the STOP's own reply was not taken for this one's
    bench.motor.close()
    clock.close()


class StoppingDrive(SheetDrive):
    """Has stop() called in the middle of the request that begins with `at`."""

    at: bytes = b"none"
    stop: Callable[[], None]

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        if data.startswith(self.at):
            self.at = b"none"
            self.stop()
        return super().receive(data, start_ns, end_ns)


@pytest.mark.parametrize("deaf", [True, False])
def test_a_stop_during_an_exchange_goes_out_also_if_that_fails(deaf: bool) -> None:
    drive = StoppingDrive(position=1000)
    bench = Bench(drive).opened()
    drive.stop, drive.at, drive.deaf = bench.motor.stop, bytes.fromhex("0103"), deaf
    seen = len(drive.requests)
    if deaf:
        with pytest.raises(LinkTimeout):
            bench.motor.read()
    else:
        bench.motor.read()
    assert drive.requests[seen + 1] == STOP_ON


@pytest.mark.parametrize(
    ("at", "cancelled"), [("0106007D0000", True), ("0110", False)], ids=["while STOP is taken back", "with the block"]
)
def test_a_stop_that_crosses_a_new_move(at: str, cancelled: bool) -> None:
    drive = StoppingDrive(position=1000)
    bench = Bench(drive).opened()
    drive.stop, drive.at = bench.motor.stop, bytes.fromhex(at)
    if cancelled:
        with pytest.raises(MoveCancelled) as caught:
            bench.motor.start_move_to(zoom=9.0)
        assert caught.value.moved == "no"
    else:
        bench.motor.start_move_to(zoom=9.0)
    bench.clock.run_for(0.5)
    assert drive.input == 0x20
    assert drive.command(bench.clock.now_ns()) < 2000
    bench.motor.move_to(zoom=at_steps(1800))


def test_a_stop_that_crosses_the_start_of_referencing() -> None:
    drive = StoppingDrive(position=5000)
    bench = Bench(drive).opened()
    drive.stop, drive.at = bench.motor.stop, bytes.fromhex("0106007D0010")
    with pytest.raises(MoveCancelled):
        bench.motor.reference()
    bench.clock.run_for(0.5)
    assert drive.input == 0x20
    assert drive.command(bench.clock.now_ns()) > 4000


# ---------------------------------------------------------------------- referencing


def test_referencing_goes_to_the_home_position() -> None:
    drive = SheetDrive(position=4000, home_end_holds=False)
    drive.at_home = False
    bench = Bench(drive).opened()
    with pytest.raises(NotReferenced, match="reference"):
        bench.motor.move_to(zoom=2.0)
    bench.motor.reference()
    assert drive.settled_at(bench.clock.now_ns()) == 0
    assert bench.kinds == ["opened", "reference_found"]
    writes = [data for data in drive.requests if data[1] != 0x03]
    assert writes == [INPUTS_OFF, bytes.fromhex("0106007D0010181E"), INPUTS_OFF]
    for zoom in (2.0, 3.0):  # HOME-END goes off with the first move; the coordinates stay
        assert bench.motor.move_to(zoom=zoom).referenced
    check_honesty(bench)


def test_referencing_without_coordinates_names_alarm_4a() -> None:
    drive = SheetDrive(position=4000)
    drive.established = False
    bench = Bench(drive).opened()
    with pytest.raises(DeviceFault, match="alarm 4Ah is on: homing incomplete") as caught:
        bench.motor.reference()
    assert "P-PRESET" in caught.value.remedy
    assert drive.command(bench.clock.now_ns()) == 4000
    bench.motor.clear_fault()
    assert bench.motor.fault is None


def test_referencing_has_a_time_limit() -> None:
    drive = SheetDrive(position=4000, home_end_holds=False)
    drive.at_home, drive.stuck = False, True
    bench = Bench(drive, reference_timeout_s=2.0).opened()
    with pytest.raises(NotReached, match="within 2 s"):
        bench.motor.reference()
    assert drive.requests[-1] == STOP_ON


def test_a_stop_ends_referencing() -> None:
    bench = Bench(SheetDrive(position=10_000)).opened()
    bench.clock.call_at(bench.clock.now_ns() + NS_PER_S // 10, bench.motor.stop)
    with pytest.raises(MoveCancelled):
        bench.motor.reference()
    assert sheet(bench).command(bench.clock.now_ns()) > 7000


def test_lost_coordinates_are_noticed_at_rest() -> None:
    bench = Bench().opened()
    bench.motor.move_to(zoom=2.0)
    with bench.motor.stream(20.0):
        bench.clock.run_for(0.3)
        sheet(bench).power_cycle()
        bench.clock.run_for(0.6)
    assert not bench.motor.referenced
    assert bench.kinds[-1] == "reference_lost"
    with pytest.raises(NotReferenced):
        bench.motor.move_to(zoom=3.0)


@pytest.mark.parametrize(("outage_s", "referenced"), [(0.3, True), (3.0, False)])
def test_after_an_outage_long_enough_for_a_power_failure_home_end_decides(outage_s: float, referenced: bool) -> None:
    bench = Bench(SheetDrive(position=1000, home_end_holds=False)).opened()
    bench.motor.move_to(zoom=2.0)
    with bench.motor.stream(20.0):
        bench.clock.run_for(0.2)
        sheet(bench).deaf = True
        bench.clock.run_for(outage_s)
        sheet(bench).deaf = False
        bench.clock.run_for(0.6)
    assert [kind for kind in bench.kinds if kind.startswith("link")] == ["link_lost", "link_back"]
    assert bench.motor.referenced is referenced
