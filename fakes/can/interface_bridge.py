"""Connects a medium with a CAN interface of the operating system, such as the kernel's vcan0, in real time."""

from __future__ import annotations

import can

from microdrivers.core.clock import Clock
from microdrivers.core.errors import RefusedError, UnsupportedError
from microdrivers.fakes.can.arrival import Arrival
from microdrivers.fakes.can.frame import Frame
from microdrivers.fakes.can.medium import Medium
from microdrivers.fakes.can.port import PortError

BUS_OFF_ERROR = 0x040
"""Class of the error frame by which SocketCAN tells of bus-off (linux/can/error.h)."""

_LOOK_S = 0.2
_RETRY_S = 0.1


class InterfaceBridge:
    """Passes frames both ways, with a thread for each; a node on the medium is then one on the interface.

    Error frames pass from the medium to the interface. When the port is bus-off, an error frame tells so and the
    bridge opens it again after 0.1 s; while the medium is unplugged, nothing passes.

    Args:
        medium: on a real clock.
        channel: as python-can's, an interface that exists.
        interface: python-can's name of the kind of interface.
        device: whom errors name.

    Attributes:
        lost_frames: frames that could not be passed on: full queues, bus-off, unplugged, CAN FD.

    Raises:
        RefusedError: the interface cannot be opened.
    """

    def __init__(self, medium: Medium, *, channel: str, interface: str = "socketcan", device: str = "") -> None:
        clock: Clock = medium.clock
        if clock.simulated:
            raise UnsupportedError("a simulated clock cannot serve other programs", remedy="serve on SystemClock")
        self.lost_frames = 0
        self._medium = medium
        try:
            self._bus = can.Bus(interface=interface, channel=channel, ignore_config=True)
        except (can.CanError, OSError) as error:
            raise RefusedError(
                f"the CAN interface {interface} {channel} cannot be opened: {error}",
                device=device,
                remedy=f"make it (ip link add dev {channel} type vcan && ip link set {channel} up), or serve on slcan",
            ) from error
        self._closing = clock.event()
        self._port = medium.open_port()
        self._timers = [
            clock.call_at(clock.now_ns(), run, name=f"{channel} {way}")
            for way, run in (("out", self._run_out), ("in", self._run_in))
        ]

    def close(self) -> None:
        """End the threads and leave the interface; idempotent."""
        if self._closing.is_set():
            return
        self._closing.set()
        self._port.close()
        for timer in self._timers:
            timer.cancel()
        self._port.close()  # one that was opened meanwhile
        self._bus.shutdown()

    def _run_out(self) -> None:
        while not self._closing.is_set():
            try:
                arrival = self._port.receive(None)
            except PortError:
                if not self._closing.is_set():
                    self._reopen()
                continue
            if arrival is not None:
                self._put(_message(arrival))

    def _reopen(self) -> None:
        if self._medium.plugged:
            self._put(_message(Arrival(0, Frame(BUS_OFF_ERROR, bytes(8)), error=True)))
        while not self._closing.wait(_RETRY_S):
            try:
                self._port = self._medium.open_port()
            except PortError:
                continue
            return

    def _run_in(self) -> None:
        while not self._closing.is_set():
            try:
                message = self._bus.recv(_LOOK_S)
            except can.CanOperationError:  # the interface is down
                self._closing.wait(_RETRY_S)
                continue
            if message is not None and not message.is_error_frame:
                self._pass_in(message)

    def _pass_in(self, message: can.Message) -> None:
        if message.is_fd:
            self.lost_frames += 1
            return
        data = bytes(message.dlc) if message.is_remote_frame else bytes(message.data)
        try:
            self._port.send(Frame(message.arbitration_id, data, message.is_extended_id, message.is_remote_frame))
        except PortError:
            self.lost_frames += 1

    def _put(self, message: can.Message) -> None:
        try:
            self._bus.send(message)
        except can.CanOperationError:
            self.lost_frames += 1


def _message(arrival: Arrival) -> can.Message:
    frame = arrival.frame
    return can.Message(
        arbitration_id=frame.id,
        is_extended_id=frame.extended,
        is_remote_frame=frame.remote,
        is_error_frame=arrival.error,
        dlc=len(frame.data),
        data=frame.data,
    )
