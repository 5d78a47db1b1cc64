"""The CAN line: who hears what, in which time, and what is said when the adapter fails."""

from __future__ import annotations

import datetime
import errno
import sys
import threading
from typing import cast

import can
import pytest

from microdrivers.backends.lines import can_adapter
from microdrivers.backends.lines.can_adapter import CanAdapter
from microdrivers.backends.lines.can_line import Received, shared_can_line
from microdrivers.backends.lines.can_listeners import CanCounters
from microdrivers.backends.lines.can_load import longest_frame_bits
from microdrivers.backends.lines.settings import CanConnection
from microdrivers.core.clock import Clock, SimulatedClock, SystemClock, utc_now
from microdrivers.core.errors import BusyError, ConfigError, LinkLost, LinkTimeout, UnsupportedError
from microdrivers.fakes.can import Frame, Port, frame_bits
from tests.backends.canopen_bench import LineBench


def _other(bench: LineBench) -> Port:
    """Another host on the bus."""
    return bench.medium.open_port()


def test_one_line_for_all_devices_of_a_bus():
    with LineBench() as bench:
        again = shared_can_line(bench.connection, clock=bench.clock)
        assert again is bench.line
        assert shared_can_line(bench.connection, clock=SimulatedClock()) is not bench.line
        slower = bench.connection.model_copy(update={"bitrate": 125_000})
        with pytest.raises(ConfigError, match="has bitrate 500000, this one 125000") as caught:
            shared_can_line(slower, clock=bench.clock)
        assert caught.value.key == "connection.bitrate"


def test_it_is_open_until_the_last_has_closed_it():
    with LineBench() as bench:
        bench.line.open()
        bench.line.close()
        bench.line.send(0x123)
        bench.line.close()
        with pytest.raises(LinkLost, match="closed"):
            bench.line.send(0x123)
        bench.line.open()


def test_everybody_hears_what_he_listens_for_and_nothing_else():
    with LineBench() as bench:
        first: list[Received] = []
        second: list[Received] = []
        hearing = bench.line.listen(0x181, first.append)
        bench.line.listen(0x181, second.append)
        other = _other(bench)
        for frame in (Frame(0x181, b"\1"), Frame(0x182, b"\2"), Frame(0x181, b"", extended=True), Frame(0x181, b"\3")):
            other.send(frame)
        bench.clock.sleep(0.01)
        hearing.cancel()
        other.send(Frame(0x181, b"\4"))
        bench.clock.sleep(0.01)
        assert [each.data for each in first] == [b"\1", b"\3"]
        assert [each.data for each in second] == [b"\1", b"\3", b"\4"]


def test_frames_are_stamped_when_they_have_arrived_not_when_they_are_read():
    with LineBench() as bench:
        heard: list[Received] = []
        bench.line.listen(0x181, heard.append)
        start_ns = bench.clock.now_ns()
        frame = Frame(0x181, bytes(8))
        _other(bench).send(frame)
        bench.clock.sleep(0.01)
        assert heard[0].t_ns == pytest.approx(start_ns + frame_bits(frame) * 2000, abs=heard[0].dt_ns)
        assert heard[0].dt_ns <= 1000


def test_an_exchange_serves_the_others_meanwhile_and_keeps_their_order():
    """While one waits for its answer, what arrives for others is published at its own time."""
    with LineBench() as bench:
        bench.node.sdo_delay_ns = 20_000_000
        other, heard, published = _other(bench), [], []
        bench.clock.every(0.004, lambda: published.append(("timer", bench.clock.now_ns())))

        def publish(received: Received) -> None:
            heard.append(bench.clock.now_ns())
            bench.clock.deliver(lambda: published.append(("frame", bench.clock.now_ns())))

        bench.line.listen(0x181, publish)
        for delay_ns in (2_000_000, 6_000_000, 10_000_000):
            other.send(Frame(0x181), t_ns=bench.clock.now_ns() + delay_ns)
        bench.sdo.upload(0x1000, 0)
        assert len(heard) == 3
        times = [t_ns for _, t_ns in published]
        assert times == sorted(times)
        assert [what for what, _ in published[:5]] == ["timer", "frame", "timer", "frame", "timer"]


def test_an_error_of_a_listener_reaches_the_main_program_and_stops_no_other():
    with LineBench() as bench:
        heard: list[Received] = []

        def fail(received: Received) -> None:
            raise BusyError("not now")

        bench.line.listen(0x181, fail)
        bench.line.listen(0x181, heard.append)
        other = _other(bench)
        other.send(Frame(0x181))
        with pytest.raises(BusyError, match="not now"):
            bench.clock.sleep(0.01)
        other.send(Frame(0x181))
        with pytest.raises(BusyError, match="not now"):
            bench.clock.sleep(0.01)
        assert len(heard) == 2


def test_waiting_times_out_on_the_clock():
    with LineBench() as bench:
        start_ns = bench.clock.now_ns()
        with pytest.raises(LinkTimeout, match="no reply to 7E5#01 within 50 ms"):
            bench.line.exchange(0x7E5, b"\1", 0x7E4, lambda data: True, 0.05)
        assert bench.clock.now_ns() == start_ns + 50_000_000
        assert bench.line.counters.timeouts == 1


def test_a_wrong_bit_rate_is_suspected_by_name():
    with LineBench() as bench:
        bench.line.close()
        wrong = bench.connection.model_copy(update={"options": {}})
        port = bench.medium.open_port(bitrate=250_000)
        line = shared_can_line(wrong, clock=bench.clock)
        line.open()
        port.send(Frame(0x1, bytes(8)))
        with pytest.raises(LinkTimeout, match=r"error frames and no sound one: is the bit rate right\?"):
            line.exchange(0x7E5, b"\1", 0x7E4, lambda data: True, 0.05)


def test_bus_off_reaches_everybody():
    with LineBench() as bench:
        losses: list[LinkLost] = []
        bench.line.on_loss(losses.append)
        bench.medium.bus_off()
        with pytest.raises(LinkLost, match="bus-off") as caught:
            bench.line.exchange(0x7E5, b"\1", 0x7E4, lambda data: True, 0.05)
        bench.clock.sleep(0.01)
        assert len(losses) == 1
        assert "bit rate, termination" in caught.value.remedy
        bench.line.open()  # once more: the adapter is opened anew
        assert bench.sdo.upload(0x2000, 0) == b"\x2a"
        bench.line.close()


def test_unplugging_is_noticed_without_sending():
    with LineBench() as bench:
        losses: list[LinkLost] = []
        bench.line.on_loss(losses.append)
        bench.medium.unplug()
        bench.clock.sleep(0.01)
        assert "unplugged" in losses[0].what
        assert "no such interface" in losses[0].remedy


def test_load_counts_what_passes():
    with LineBench() as bench:
        bench.line.listen(0x181, lambda received: None)
        other = _other(bench)
        bench.clock.every(0.001, lambda: other.send(Frame(0x181, bytes(8))))
        bench.clock.sleep(2.5)
        assert bench.line.load == pytest.approx(1000 * longest_frame_bits(8) / 500_000, rel=0.02)
        assert longest_frame_bits(8) == 135
        assert longest_frame_bits(0) == 44 + 8 + 3


def test_upkeep_goes_on_during_long_waits_only_where_timers_stand_still():
    with LineBench() as bench:
        calls: list[int] = []

        def upkeep() -> int:
            calls.append(bench.clock.now_ns())
            return bench.clock.now_ns() + 10_000_000

        keeping = bench.line.keep_up(upkeep)
        bench.line.wait(bench.clock.event(), 0.1)
        keeping.cancel()
        bench.line.wait(bench.clock.event(), 0.1)
        assert len(calls) == 10


def test_a_lock_that_cannot_come_free_is_busy_at_once():
    with LineBench() as bench:
        lock = threading.Lock()
        lock.acquire()
        with pytest.raises(BusyError, match="a search is under way"):
            bench.line.acquire(lock, timeout_s=5.0, what="a search")


# ---------------------------------------------------------------------- opening


def _open(clock: Clock | None = None, **settings: object) -> None:
    connection = CanConnection.model_validate({"interface": "socketcan", "channel": "can9"} | settings)
    CanAdapter(connection, clock=clock or SystemClock(), counters=CanCounters())


def test_interfaces_that_are_not_there():
    with pytest.raises(LinkLost, match="CAN bus can9") as caught:
        _open()
    assert caught.value.moved == "no"
    assert "interface" in caught.value.remedy or "kernel knows no CAN" in caught.value.remedy
    with pytest.raises(LinkLost, match="nowhere") as caught:
        _open(interface="slcan", channel="/dev/nowhere", options={"sleep_after_open": 0.0})
    assert "cable" in caught.value.remedy
    uninstalled = CanConnection(interface="virtual", channel="v").model_copy(update={"interface": "telepathy"})
    with pytest.raises(ConfigError, match="cannot use the interface 'telepathy'"):
        CanAdapter(uninstalled, clock=SystemClock(), counters=CanCounters())
    with pytest.raises(ConfigError, match="refuses these settings") as settings:
        _open(interface="slcan", channel="/dev/nowhere@fast")
    assert settings.value.key == "connection"


def test_a_real_bus_does_not_run_on_a_simulated_clock():
    with pytest.raises(UnsupportedError, match="cannot run on a simulated clock"):
        _open(SimulatedClock(), interface="virtual", channel="v")


def test_python_can_is_asked_for_by_the_name_of_the_extra(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "can", None)
    with pytest.raises(UnsupportedError) as caught:
        _open()
    assert "pip install python-can" in caught.value.remedy


class _ScriptedBus:
    """Stands for an adapter: gives out what it was given, errors included."""

    def __init__(self, *script: can.Message | Exception | None) -> None:
        self.script = list(script)
        self.flushed = 0

    def recv(self, timeout: float) -> can.Message | None:
        item = self.script.pop(0) if self.script else None
        if isinstance(item, Exception):
            raise item
        return item

    def flush(self) -> None:
        self.flushed += 1

    def shutdown(self) -> None:
        raise can.CanOperationError("gone")


def _adapter(monkeypatch: pytest.MonkeyPatch, bus: _ScriptedBus, interface: str, clock: Clock) -> CanAdapter:
    monkeypatch.setattr(CanAdapter, "_open", lambda self: bus)
    return CanAdapter(CanConnection(interface=interface, channel="COM9"), clock=clock, counters=CanCounters())


def test_garbage_error_frames_and_a_message(monkeypatch: pytest.MonkeyPatch):
    sound = can.Message(arbitration_id=0x181, is_extended_id=False, data=b"\1")
    trouble = can.Message(arbitration_id=0x08, is_error_frame=True)
    bus = _ScriptedBus(ValueError("no hex"), trouble, sound, can.Message(arbitration_id=0x40, is_error_frame=True))
    adapter = _adapter(monkeypatch, bus, "slcan", SystemClock())
    assert adapter.receive(0.1) is sound
    assert (bus.flushed, adapter._counters.error_frames, adapter._counters.garbled) == (1, 1, 1)
    with pytest.raises(OSError, match="bus-off"):
        adapter.receive(0.1)
    adapter.close()


def test_a_full_queue_is_no_lost_adapter(monkeypatch: pytest.MonkeyPatch):
    adapter = _adapter(monkeypatch, _ScriptedBus(), "socketcan", SystemClock())
    for full in (can.CanOperationError("x", errno.ENOBUFS), can.CanOperationError("Transmit buffer full")):
        assert isinstance(adapter.explain(full), LinkTimeout)
    down = adapter.explain(can.CanOperationError("Network is down", errno.ENETDOWN))
    assert isinstance(down, LinkLost)
    assert "sudo ip link set COM9 up type can bitrate 500000" in down.remedy


def test_kernel_stamps_become_times_of_the_rigs_clock(monkeypatch: pytest.MonkeyPatch):
    clock = SystemClock()
    adapter = _adapter(monkeypatch, _ScriptedBus(), "socketcan", clock)
    aged = can.Message(arbitration_id=1, timestamp=utc_now().timestamp() - 0.010)
    now_ns = clock.now_ns()
    stamp = adapter.stamp(aged)
    assert now_ns - 12_000_000 < stamp.t_ns < now_ns - 7_000_000
    assert stamp.dt_ns == 50_000
    for odd in (utc_now().timestamp() + 3600.0, 0.0):  # the calendar was set meanwhile, or the stamp is none
        stamp = adapter.stamp(can.Message(arbitration_id=1, timestamp=odd))
        assert stamp.t_ns >= now_ns
        assert stamp.dt_ns == 1_000_000


class _TwoClocks:
    """The rig's clock, and a calendar; each reading takes 0.2 µs, but for the `odd` ones, at which others go first."""

    simulated = False

    def __init__(self, *odd: int) -> None:
        self.t_ns = 1_000_000_000
        self.readings = 0
        self.odd = odd

    def now_ns(self) -> int:
        self.readings += 1
        self.t_ns += 3_000_000 if self.readings in self.odd else 200
        return self.t_ns

    def calendar(self) -> datetime.datetime:
        self.now_ns()
        return datetime.datetime.fromtimestamp(0, datetime.UTC) + datetime.timedelta(microseconds=self.t_ns / 1000)


def _stamps(monkeypatch: pytest.MonkeyPatch, clock: _TwoClocks, *ends_ns: int) -> list[tuple[int, int]]:
    adapter = _adapter(monkeypatch, _ScriptedBus(), "socketcan", cast(Clock, clock))
    monkeypatch.setattr(can_adapter, "utc_now", clock.calendar)
    return [tuple(adapter.stamp(can.Message(arbitration_id=1, timestamp=end_ns / 1e9))) for end_ns in ends_ns]  # type: ignore[misc]


def test_a_kernel_stamp_is_not_spoilt_by_what_comes_between_two_readings(monkeypatch: pytest.MonkeyPatch):
    """The thread may lose the processor between reading one clock and the other: they are read again."""
    for odd in range(1, 8):
        (stamp, _) = _stamps(monkeypatch, _TwoClocks(odd), 999_000_000, 999_500_000)
        assert stamp[0] == pytest.approx(999_000_000, abs=stamp[1])
        assert stamp[1] == 50_000
    (unlucky,) = _stamps(monkeypatch, _TwoClocks(*range(1, 20)), 999_000_000)
    assert unlucky[0] == pytest.approx(999_000_000, abs=unlucky[1])
    assert unlucky[1] >= 3_000_000


def test_stamps_of_a_line_never_run_backwards(monkeypatch: pytest.MonkeyPatch):
    """Whatever two clocks say: frames are handed over in the order in which they passed."""
    stamps = _stamps(monkeypatch, _TwoClocks(), 999_000_000, 999_200_000, 999_150_000, 999_150_000, 999_400_000)
    times_ns = [t_ns for t_ns, _ in stamps]
    assert times_ns == sorted(set(times_ns))
    assert times_ns[2:4] == [times_ns[1] + 1, times_ns[1] + 2]
    assert stamps[2][1] == pytest.approx(100_000, abs=5_000)  # what was shifted is no better known
    assert stamps[4] == (pytest.approx(999_400_000, abs=5_000), 50_000)


def test_a_message_has_one_stamp(monkeypatch: pytest.MonkeyPatch):
    adapter = _adapter(monkeypatch, _ScriptedBus(), "slcan", SystemClock())
    message = can.Message(arbitration_id=1)
    assert adapter.stamp(message) == adapter.stamp(message)
