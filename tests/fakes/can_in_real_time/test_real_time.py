"""The emulated bus in real time: with threads, on a serial port, and on an interface of the operating system."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import can
import pytest

from microdrivers.core.clock import SimulatedClock, SystemClock
from microdrivers.core.errors import RefusedError, UnsupportedError
from microdrivers.devices.drivers import Endpoint, ServeRequest
from microdrivers.fakes.can import Frame, Medium, PortError, serve_medium
from microdrivers.fakes.can.interface_bridge import InterfaceBridge
from microdrivers.fakes.can.serving import HeldUpPort
from tests.fakes.can_bench import PATIENCE_S, SDO_REPLY, SDO_REQUEST, Answering, Listener, Periodic, wait_until

pytestmark = pytest.mark.xdist_group("real_time")

REQUEST = can.Message(arbitration_id=SDO_REQUEST.id, data=SDO_REQUEST.data, is_extended_id=False)


def exchange(bus: can.BusABC) -> None:
    bus.send(REQUEST)
    reply = bus.recv(PATIENCE_S)
    while reply is not None and reply.arbitration_id != SDO_REPLY.id:
        reply = bus.recv(PATIENCE_S)
    assert reply is not None
    assert bytes(reply.data) == SDO_REPLY.data


# ---------------------------------------------------------------------- threads


def test_an_exchange_in_real_time(medium: Medium) -> None:
    medium.attach(Answering({SDO_REQUEST: SDO_REPLY}))
    with can.Bus(interface="microdrivers", channel=medium.name) as bus:
        exchange(bus)


def test_nodes_go_on_while_no_host_is_there(clock: SystemClock, medium: Medium) -> None:
    listener = Listener()
    medium.attach(listener)
    medium.attach(Periodic(0x185, period_ms=2))
    wait_until(clock, lambda: len(listener.heard) > 10)
    times_ns = [t_ns for t_ns, frame in listener.heard if frame.id == 0x185]
    assert times_ns[3] - times_ns[2] == pytest.approx(2_000_000, abs=20_000)  # the bus is exact, threads are not


@pytest.mark.parametrize("break_it", [Medium.unplug, Medium.bus_off, Medium.close])
def test_a_wait_without_end_ends_with_the_bus(
    clock: SystemClock, medium: Medium, break_it: Callable[..., None]
) -> None:
    port = medium.open_port()
    failures: list[PortError] = []

    def wait() -> None:
        try:
            port.receive(None)
        except PortError as error:
            failures.append(error)

    thread = threading.Thread(target=wait)
    thread.start()
    clock.sleep(0.02)
    break_it(medium)
    thread.join(PATIENCE_S)
    assert len(failures) == 1


def test_threads_that_send_at_once_lose_nothing(medium: Medium) -> None:
    reader = medium.open_port()

    def send(identifier: int) -> None:
        port = medium.open_port()
        sent = 0
        while sent < 50:
            try:
                port.send(Frame(identifier, bytes([sent])))
            except PortError:
                continue
            sent += 1

    threads = [threading.Thread(target=send, args=(identifier,)) for identifier in (0x100, 0x200, 0x300)]
    for thread in threads:
        thread.start()
    heard: dict[int, list[int]] = {0x100: [], 0x200: [], 0x300: []}
    for _ in range(150):
        arrival = reader.receive(PATIENCE_S)
        assert arrival is not None
        heard[arrival.frame.id].append(arrival.frame.data[0])
    for thread in threads:
        thread.join(PATIENCE_S)
    assert all(numbers == list(range(50)) for numbers in heard.values())


def test_python_cans_own_threads(medium: Medium) -> None:
    heard: list[can.Message] = []
    enough = threading.Event()

    def note(message: can.Message) -> None:
        heard.append(message)
        if len(heard) >= 5:
            enough.set()

    with (
        can.Bus(interface="microdrivers", channel=medium.name) as one,
        can.Bus(interface="microdrivers", channel=medium.name) as other,
    ):
        notifier = can.Notifier(one, [note], timeout=0.05)
        task = other.send_periodic(can.Message(arbitration_id=0x080, is_extended_id=False), 0.002)
        assert enough.wait(PATIENCE_S)
        task.stop()
        notifier.stop()
    assert {message.arbitration_id for message in heard} == {0x080}


# ---------------------------------------------------------------------- the serial adapter


def request(folder: Path, *, transport: Literal["pty", "tcp"] = "pty", **can_settings: Any) -> ServeRequest:
    return ServeRequest(transport=transport, bind="127.0.0.1", folder=folder, **can_settings)


def open_endpoint(endpoint: Endpoint) -> can.BusABC:
    connection = dict(endpoint.overrides["connection"])
    return can.Bus(**connection.pop("options"), **connection)


@pytest.mark.parametrize("transport", ["pty", "tcp"])
def test_python_cans_adapter_driver(
    clock: SystemClock, medium: Medium, tmp_path: Path, transport: Literal["pty", "tcp"]
) -> None:
    node = Answering({SDO_REQUEST: SDO_REPLY})
    medium.attach(node)
    endpoint = serve_medium("probe_stage", medium, request(tmp_path, transport=transport))
    assert endpoint.overrides["connection"]["interface"] == "slcan"
    with open_endpoint(endpoint) as bus:
        for _ in range(3):
            exchange(bus)
        bus.send(can.Message(arbitration_id=0x18DAF110, data=b"\x01"))
        wait_until(clock, lambda: node.heard[-1][1] == Frame(0x18DAF110, b"\x01", extended=True))
        medium.open_port().send(Frame(0x12345, b"\x02\x03", extended=True))
        message = bus.recv(PATIENCE_S)
        assert message is not None
        assert (message.arbitration_id, message.is_extended_id, bytes(message.data)) == (0x12345, True, b"\x02\x03")
    endpoint.close()


def test_the_devices_of_a_bus_share_its_endpoint(medium: Medium, tmp_path: Path) -> None:
    medium.attach(Answering({SDO_REQUEST: SDO_REPLY}))
    one, other = (serve_medium(name, medium, request(tmp_path)) for name in ("probe_stage", "probe_force"))
    assert one.where == other.where == str(tmp_path / "can-slcan-dev-ttyACM0")
    one.close()
    one.close()
    with open_endpoint(other) as bus:
        exchange(bus)
    other.close()
    assert not Path(other.where).exists()
    again = serve_medium("probe_stage", medium, request(tmp_path))
    with open_endpoint(again) as bus:
        exchange(bus)
    again.close()


def test_an_adapter_that_is_unplugged_comes_back_without_its_settings(medium: Medium, tmp_path: Path) -> None:
    medium.attach(Answering({SDO_REQUEST: SDO_REPLY}))
    endpoint = serve_medium("probe_stage", medium, request(tmp_path))
    bus = open_endpoint(endpoint)
    exchange(bus)
    endpoint.control.unplug()
    assert not Path(endpoint.where).exists()
    with pytest.raises(can.CanOperationError):
        exchange(bus)
    bus._is_shutdown = True  # its own shutdown cannot write any more
    bus.serialPortOrig.close()
    endpoint.control.plug_in()
    with open_endpoint(endpoint) as fresh:
        exchange(fresh)
    endpoint.close()


def test_what_a_host_does_not_take_waits_for_it() -> None:
    class SlowHost:
        taken, room = b"", 10

        def send(self, data: bytes) -> int:
            piece, self.room = data[: self.room], 0
            self.taken += piece
            return len(piece)

        def descriptors(self) -> list[int]:
            return [7]

    host = SlowHost()
    port = HeldUpPort(host)  # type: ignore[arg-type]
    assert port.send(b"t1230\r" * 200) == 1200
    assert (host.taken, port.held_up()) == (b"t1230\rt123", True)
    host.room = 700
    assert port.descriptors() == [7]
    assert (len(host.taken), port.held_up()) == (710, False)
    host.room = 10_000
    port.send(b"z\r")
    assert host.taken == b"t1230\r" * 200 + b"z\r"


# ---------------------------------------------------------------------- an interface of the operating system


@pytest.fixture
def interface(medium: Medium) -> Iterator[can.BusABC]:
    """python-can's `virtual` in place of the kernel's vcan."""
    bridge = InterfaceBridge(medium, channel="test-vcan", interface="virtual")
    with can.Bus(interface="virtual", channel="test-vcan") as bus:
        yield bus
    bridge.close()
    bridge.close()


def test_nodes_on_an_interface(medium: Medium, interface: can.BusABC) -> None:
    medium.attach(Answering({SDO_REQUEST: SDO_REPLY}))
    for _ in range(3):
        exchange(interface)


def test_all_kinds_of_frames_pass_both_ways(medium: Medium, interface: can.BusABC) -> None:
    port = medium.open_port()
    for frame in (
        Frame(0x080),
        Frame(0x185, bytes(range(8))),
        Frame(0x18DAF110, b"\x01", extended=True),
        Frame(0x705, bytes(1), remote=True),
    ):
        port.send(frame)
        message = interface.recv(PATIENCE_S)
        assert message is not None
        assert (message.arbitration_id, message.is_extended_id, message.is_remote_frame, message.dlc) == (
            frame.id, frame.extended, frame.remote, len(frame.data),
        )  # fmt: skip
        interface.send(message)
        arrival = port.receive(PATIENCE_S)
        assert arrival is not None
        assert arrival.frame == frame


def test_errors_pass_to_the_interface_and_the_bridge_recovers(
    clock: SystemClock, medium: Medium, interface: can.BusABC
) -> None:
    medium.attach(Answering({SDO_REQUEST: SDO_REPLY}))
    medium.inject_error_frame()
    for error_class, break_it in ((0x008, None), (0x040, medium.bus_off)):
        if break_it is not None:
            break_it()
        message = interface.recv(PATIENCE_S)
        assert message is not None
        assert (message.is_error_frame, message.arbitration_id) == (True, error_class)
    clock.sleep(0.3)
    exchange(interface)
    medium.unplug()
    interface.send(REQUEST)
    assert interface.recv(0.1) is None
    medium.plug_in()
    clock.sleep(0.3)
    exchange(interface)


def test_what_cannot_be_served_is_refused(clock: SystemClock, medium: Medium, tmp_path: Path) -> None:
    with pytest.raises(RefusedError, match="no-such0") as caught:
        serve_medium("probe_stage", medium, request(tmp_path, can="socketcan", can_channel="no-such0"))
    assert ("ip link add" in caught.value.remedy, caught.value.device) == (True, "probe_stage")
    simulated = Medium("can0", clock=SimulatedClock(), bitrate=500_000, seed=1)
    with pytest.raises(UnsupportedError, match="simulated"):
        serve_medium("probe_stage", simulated, request(tmp_path))
    with pytest.raises(UnsupportedError, match="simulated"):
        InterfaceBridge(simulated, channel="test-vcan", interface="virtual")


def test_without_python_can_there_is_still_slcan(
    medium: Medium, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "microdrivers.fakes.can.interface_bridge", None)
    with pytest.raises(UnsupportedError, match="python-can is not installed"):
        serve_medium("probe_stage", medium, request(tmp_path, can="socketcan"))
    serve_medium("probe_stage", medium, request(tmp_path)).close()


def test_an_interface_carries_one_bus(
    clock: SystemClock, medium: Medium, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []

    def bus(*, interface: str, channel: str, ignore_config: bool) -> can.BusABC:
        opened.append(f"{interface}:{channel}")
        return real(interface="virtual", channel=channel)

    real = can.Bus
    monkeypatch.setattr(can, "Bus", bus)
    on_vcan = request(tmp_path, can="socketcan")
    endpoint = serve_medium("probe_stage", medium, on_vcan)
    other = Medium("can1", clock=clock, bitrate=500_000, seed=1)
    with pytest.raises(RefusedError, match="vcan0 already carries the bus slcan:/dev/ttyACM0"):
        serve_medium("gripper_stage", other, on_vcan)
    other.close()
    assert opened == ["socketcan:vcan0"]
    assert endpoint.where == "vcan0"
    assert endpoint.overrides == {
        "connection": {"interface": "socketcan", "channel": "vcan0", "bitrate": 500_000, "options": {}}
    }
    endpoint.close()
