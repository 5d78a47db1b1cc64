"""The CAN line and the fine stage in real time: one receiving thread, and others that call."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import can
import pytest

from microdrivers.backends.canopen.sdo import SdoClient
from microdrivers.backends.lines.can_line import Received, shared_can_line
from microdrivers.backends.lines.settings import CanConnection
from microdrivers.core.clock import SystemClock
from microdrivers.core.errors import LinkError, LinkTimeout, MoveCancelled
from microdrivers.core.samples import FineStageSample
from tests.backends.canopen_bench import LineBench
from tests.backends.canopen_peer import PeerNode
from tests.backends.cia402_bench import Bench

pytestmark = pytest.mark.ports  # with the machine to themselves: threads, drives and heartbeats in real time


@pytest.fixture
def bench() -> Iterator[Bench]:
    clock = SystemClock()
    with Bench(clock=clock, channel="real time", heartbeat_ms=1000) as bench:
        yield bench
    clock.close()


def test_a_session(bench: Bench):
    bench.opened()
    for peer in bench.peers.values():
        peer.homing_s = 0.05
    bench.stage.reference(["z", "x", "y"])
    with bench.stage.stream(50.0):
        assert bench.stage.move_to(x_um=30.0, y_um=-20.0, z_um=10.0).on_target
    assert abs(bench.truth_um("x") - 30.0) <= 0.05
    times = [sample.t_ns for sample in bench.samples]
    assert len(times) > 3
    assert len(set(times)) == len(times)
    assert all(sample.dt_ns < 100_000_000 for sample in bench.samples)


def test_a_stop_waits_for_nobody(bench: Bench):
    bench.opened()
    order: list[str] = []
    asked = threading.Event()

    def ask() -> None:
        asked.set()
        try:
            bench.stage.read()
        except LinkError:
            order.append("gave up")

    for peer in bench.peers.values():
        peer.mute_pdo = True
    reader = threading.Thread(target=ask)
    reader.start()
    asked.wait()
    bench.clock.sleep(0.03)
    bench.stage.stop()
    order.append("stopped")
    reader.join()
    assert order == ["stopped", "gave up"]


def test_a_subscriber_in_the_receiving_thread_may_ask_and_stop(bench: Bench):
    """It receives its own answers meanwhile: nothing hangs, for nobody."""
    bench.opened()
    answers: list[FineStageSample] = []
    asked = threading.Event()

    def ask(sample: FineStageSample) -> None:
        if not asked.is_set():
            asked.set()
            answers.append(bench.stage.read())
            bench.stage._drives.by_axis["x"].node.sdo.upload(0x1008, 0)
            bench.stage.stop()
            answers.append(bench.stage.read())

    subscription = bench.stage.topic.subscribe(ask)
    with bench.stage.stream(50.0):
        for _ in range(10):
            bench.clock.sleep(0.02)
            bench.stage.read()
    assert len(answers) == 2
    assert subscription.error_count == 0


def test_many_threads_ask_at_once(bench: Bench):
    bench.opened()
    failures: list[Exception] = []

    def ask(axis: str) -> None:
        sdo = bench.stage._drives.by_axis[axis].node.sdo
        try:
            for _ in range(20):
                assert sdo.upload(0x1008, 0) == b"FAKE-DRIVE-402"
                assert int.from_bytes(sdo.upload(0x1018, 4), "little") == 1000 + bench.peers[axis].id
                bench.stage.read()
        except Exception as error:  # noqa: BLE001 - told to the main thread
            failures.append(error)

    threads = [threading.Thread(target=ask, args=(axis,)) for axis in "xxyz"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures


def test_a_stop_from_another_thread_ends_a_move(bench: Bench):
    bench.opened()
    for peer in bench.peers.values():
        peer.homing_s = 0.05
    bench.stage.reference(["z", "x"])
    stopper = threading.Timer(0.1, bench.stage.stop)
    stopper.start()
    with pytest.raises(MoveCancelled):
        bench.stage.move_to(x_um=600.0)
    stopper.join()
    assert bench.truth_um("x") < 590.0


def test_closing_ends_the_thread():
    before = threading.active_count()
    clock = SystemClock()
    with LineBench(clock=clock, channel="thread") as bench:
        assert bench.sdo.upload(0x1000, 0)
        assert threading.active_count() > before
        bench.line.open()
        bench.line.close()
        assert bench.sdo.upload(0x1000, 0)
    clock.close()
    assert threading.active_count() == before


def test_one_node_that_is_silent_delays_no_other():
    clock = SystemClock()
    with LineBench(clock=clock, channel="two nodes", timeout_s=0.5) as bench:
        bench.medium.attach(PeerNode(6, {(0x1000, 0): b"\1\0\0\0"}))
        other = SdoClient(bench.line, 6, timeout_s=0.5, name="node 6")
        bench.node.all_silent = True
        order: list[str] = []

        def ask() -> None:
            with pytest.raises(LinkTimeout):
                bench.sdo.upload(0x1000, 0)
            order.append("the silent one")

        waiting = threading.Thread(target=ask)
        waiting.start()
        clock.sleep(0.02)
        assert other.upload(0x1000, 0) == b"\1\0\0\0"
        order.append("the other one")
        waiting.join()
        assert order == ["the other one", "the silent one"]
    clock.close()


def test_any_interface_of_python_can_will_do():
    """`virtual` stamps in calendar time of its own, which counts for nothing: frames are stamped as they arrive."""
    clock = SystemClock()
    line = shared_can_line(CanConnection(interface="virtual", channel="any"), clock=clock)
    line.open()
    heard: list[Received] = []
    line.listen(0x181, heard.append)
    with can.Bus(interface="virtual", channel="any", ignore_config=True) as other:
        begun_ns = clock.now_ns()
        other.send(can.Message(arbitration_id=0x181, data=b"\1\2", is_extended_id=False))
        line.send(0x201, b"\6\0")
        message = other.recv(1.0)
        assert message is not None
        assert bytes(message.data) == b"\6\0"
        deadline = time.monotonic() + 2.0
        while not heard and time.monotonic() < deadline:
            clock.sleep(0.01)
    line.close()
    clock.close()
    assert heard[0].data == b"\1\2"
    assert heard[0].t_ns >= begun_ns
    assert heard[0].dt_ns == 1_000_000
