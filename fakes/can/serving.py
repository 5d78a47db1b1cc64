"""Puts an emulated bus where other programs find it: on a serial adapter's port, or on a SocketCAN interface."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

from microdrivers.core.errors import RefusedError, UnsupportedError
from microdrivers.devices.drivers import Endpoint, ServeRequest
from microdrivers.devices.wire_tap import CanTap
from microdrivers.fakes.can.frame import Frame
from microdrivers.fakes.can.medium import Medium
from microdrivers.fakes.can.slcan import SlcanAdapter
from microdrivers.fakes.wire import Cable, Temper, Wire
from microdrivers.fakes.wire.bridge import Bridge, HostPort, PtyPort, TcpPort

_BAUDRATE = 3_000_000
"""Of the adapter's serial line, as of a fast USB converter; 1000 frames of 8 bytes a second take 7 % of it."""

_HELD_BYTES = 32 * 22
"""What waits in the adapter at most: 32 frames of 8 bytes."""

_TEMPER = Temper(max_fragments=2, max_pause_s=0.0001)


class _Served:
    """A medium's endpoint and how many devices use it."""

    def __init__(self, endpoint: Endpoint, place: str) -> None:
        self.endpoint = endpoint
        self.place = place
        self.users = 0


class HeldUpPort:
    """A port with flow control, as USB adapters have: what the host does not take at once waits for it."""

    def __init__(self, port: HostPort) -> None:
        self._port = port
        self._backlog = bytearray()

    def held_up(self) -> bool:
        """Whether as much waits as the adapter can hold."""
        return len(self._backlog) >= _HELD_BYTES

    def open(self) -> None:
        """See `HostPort`."""
        self._port.open()

    def descriptors(self) -> list[int]:
        """See `HostPort`; also looks whether the host takes more by now."""
        self._flush()
        return self._port.descriptors()

    def receive(self, ready: Sequence[int]) -> bytes:
        """See `HostPort`."""
        return self._port.receive(ready)

    def send(self, data: bytes) -> int:
        """See `HostPort`; takes everything."""
        self._backlog += data
        self._flush()
        return len(data)

    def close(self) -> None:
        """See `HostPort`."""
        self._backlog.clear()
        self._port.close()

    def _flush(self) -> None:
        if self._backlog:
            del self._backlog[: self._port.send(bytes(self._backlog))]


_served: dict[Medium, _Served] = {}


def serve_medium(name: str, medium: Medium, request: ServeRequest) -> Endpoint:
    """The endpoint of a device's bus: made for its first device, shared by the others, ended with the last one's.

    Args:
        name: the device's.
        medium: on a real clock.
        request: `can` decides between `slcan`, on a pseudo-terminal or a TCP port, and `socketcan` on `can_channel`.

    Raises:
        RefusedError: the port or interface cannot be opened, or carries another bus of the rig.
    """
    served = _served.get(medium)
    if served is None:
        served = _served[medium] = _serve(name, medium, request)
        if request.tap is not None:
            medium.on_passed = _teller(request.tap.of_bus(medium.name))
    served.users += 1
    closed = False

    def close() -> None:
        nonlocal closed
        if closed:
            return
        closed = True
        served.users -= 1
        if not served.users:
            del _served[medium]
            medium.on_passed = None
            served.endpoint.close()

    endpoint = served.endpoint
    return Endpoint(overrides=endpoint.overrides, where=endpoint.where, close=close, control=endpoint.control)


def _teller(tap: CanTap) -> Callable[[int, str, Frame], None]:
    """Tells a tap what passes on the bus, if somebody listens there: directions are the host's."""

    def tell(t_ns: int, who: str, frame: Frame) -> None:
        if not tap.heard:
            return
        if who == "error":
            tap.error_frame(t_ns, frame.id, frame.data)
            return
        direction: Literal["sent", "received"] = "sent" if who == "host" else "received"
        tap.frame(t_ns, direction, frame.id, frame.data, extended=frame.extended, remote=frame.remote)

    return tell


def _serve(name: str, medium: Medium, request: ServeRequest) -> _Served:
    if request.can == "socketcan":
        place = f"socketcan:{request.can_channel}"
        taken = [other.name for other, served in _served.items() if served.place == place]
        if taken:
            raise RefusedError(
                f"{request.can_channel} already carries the bus {taken[0]}, not also {medium.name}",
                device=name,
                remedy="serve rigs with several CAN buses on slcan",
            )
        return _Served(_serve_on_interface(name, medium, request.can_channel), place)
    link = re.sub(r"[^\w.-]+", "-", f"can-{medium.name}")
    try:
        endpoint = _serve_adapter(link, medium, request)
    except OSError as error:
        raise RefusedError(
            f"no {request.transport} port can be opened: {error}", device=name, remedy="choose another --bind address"
        ) from error
    return _Served(endpoint, link)


def _serve_on_interface(name: str, medium: Medium, channel: str) -> Endpoint:
    try:
        from microdrivers.fakes.can.interface_bridge import InterfaceBridge
    except ModuleNotFoundError as error:
        raise UnsupportedError(
            "python-can is not installed", device=name, remedy="pip install python-can, or serve on slcan"
        ) from error
    bridge = InterfaceBridge(medium, channel=channel, device=name)
    return Endpoint(
        overrides=_overrides("socketcan", channel, medium), where=channel, close=bridge.close, control=medium
    )


def _serve_adapter(link: str, medium: Medium, request: ServeRequest) -> Endpoint:
    adapter = SlcanAdapter(medium, byte_ns=10_000_000_000 // _BAUDRATE)
    wire = Wire(adapter, clock=medium.clock, seed=medium.seed, baudrate=_BAUDRATE, temper=_TEMPER)
    host_port, where = _open_port(link, wire, request)
    port = HeldUpPort(host_port)
    adapter.held_up = port.held_up
    bridge = Bridge(wire, medium.clock, port, name=link)
    adapter.wake = bridge.wake
    adapter.turn_medium(True)
    bridge.wake()

    def close() -> None:
        adapter.turn_medium(False)
        with medium.lock:
            adapter.wake = None
        bridge.close()
        adapter.switch_off()

    options = {"sleep_after_open": 0.05}  # python-can's default, 2 s, is for adapters that start when opened
    return Endpoint(
        overrides=_overrides("slcan", where, medium, options),
        where=where,
        close=close,
        control=AdapterCable(adapter, Cable(wire, port, bridge)),
    )


def _open_port(link: str, wire: Wire, request: ServeRequest) -> tuple[HostPort, str]:
    if request.transport == "pty":
        return PtyPort(request.folder / link), str(request.folder / link)
    port = TcpPort(request.bind, wire.connect)
    return port, f"socket://{request.host}:{port.address[1]}"


def _overrides(
    interface: str, channel: str, medium: Medium, options: Mapping[str, Any] | None = None
) -> Mapping[str, Any]:
    connection = {"interface": interface, "channel": channel, "bitrate": medium.bitrate, "options": options or {}}
    return {"connection": connection}


class AdapterCable(NamedTuple):
    """Pulls and puts back the adapter's USB cable, which also supplies it."""

    adapter: SlcanAdapter
    cable: Cable

    def unplug(self) -> None:
        """The port goes away; the adapter forgets its settings."""
        self.cable.unplug()
        self.adapter.switch_off()

    def plug_in(self) -> None:
        """The port comes back under the same name."""
        self.cable.plug_in()
