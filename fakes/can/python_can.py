"""python-can's interface `microdrivers`: `can.Bus(interface="microdrivers", channel=NAME)` opens an emulated bus."""

from __future__ import annotations

import errno
from collections.abc import Callable, Sequence

import can

from microdrivers.core.errors import OutOfRange
from microdrivers.core.units import NS_PER_S
from microdrivers.fakes.can.arrival import Arrival
from microdrivers.fakes.can.frame import Frame
from microdrivers.fakes.can.port import PortError
from microdrivers.fakes.can.registry import medium_named


class MediumBus(can.BusABC):
    """A port of an emulated bus. All waiting, and all time stamps, are on the medium's clock.

    Beyond python-can's interface there are `on_arrival`, and for a host in the same process and on a simulated clock
    `send_data`, `deliver_to` and `receive_until`: the same port, without messages and threads.

    Classic frames only. Further settings, which belong to real adapters, are accepted and have no effect.

    Args:
        channel: the medium's name.
        can_filters: as python-can's; the port applies them.
        bitrate: bit/s; another one than the medium's makes each frame an error, as on a real bus.
        receive_own_messages: whether `recv` also returns what was sent, once it has passed.

    Raises:
        can.CanInitializationError: there is no such medium, or it is unplugged.
    """

    def __init__(
        self,
        channel: str,
        can_filters: can.typechecking.CanFilters | None = None,
        *,
        bitrate: int | None = None,
        receive_own_messages: bool = False,
        **_: object,
    ) -> None:
        medium = medium_named(channel)
        if medium is None:
            raise can.CanInitializationError(f"there is no emulated CAN bus {channel!r}", errno.ENODEV)
        try:
            self._port = medium.open_port(bitrate=bitrate, receive_own=receive_own_messages)
        except PortError as error:
            raise can.CanInitializationError(error.what, error.number) from error
        self._clock = medium.clock
        self._channel = channel
        self.channel_info = f"emulated CAN bus {channel}"
        super().__init__(channel, can_filters)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Put a message into the transmit queue; never waits, so that `timeout` has no effect.

        Raises:
            can.CanOperationError: the queue is full (ENOBUFS), the cable unplugged (ENODEV), the controller bus-off
                (ENETDOWN), the bus closed (EBADF), or the message is no classic data or remote frame (EINVAL).
        """
        del timeout
        if msg.is_fd or msg.is_error_frame:
            raise can.CanOperationError("an emulated bus carries classic data and remote frames", errno.EINVAL)
        data = bytes(msg.dlc) if msg.is_remote_frame else bytes(msg.data)
        try:
            self._port.send(Frame(msg.arbitration_id, data, msg.is_extended_id, msg.is_remote_frame))
        except (PortError, OutOfRange) as error:
            raise _operation_error(error) from error

    def send_data(self, identifier: int, data: bytes) -> None:
        """Put a data frame with an identifier of 11 bits into the transmit queue; errors as `send`."""
        try:
            self._port.send(Frame(identifier, data))
        except (PortError, OutOfRange) as error:
            raise _operation_error(error) from error

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The oldest message that has arrived; waits up to `timeout` seconds on the medium's clock.

        Its `timestamp` is when the frame ended on the bus, in s on that clock.

        Raises:
            can.CanOperationError: the cable is unplugged (ENODEV), the controller bus-off (ENETDOWN) or the bus closed
                (EBADF).
            ClockError: without a time-out on a simulated clock.
        """
        try:
            arrival = self._port.receive(timeout)
        except PortError as error:
            raise _operation_error(error) from error
        return None if arrival is None else self._message(arrival)

    def on_arrival(self, call: Callable[[], None] | None) -> None:
        """Call whenever a message has arrived or the bus has failed, so that no thread is needed; None ends that.

        A simulated clock calls, at that time. In real time the thread that turns the medium calls: it must not wait.
        """
        self._port.on_arrival(call)

    def deliver_to(
        self, take: Callable[[int, bytes, int], object], lost: Callable[[can.CanOperationError], object]
    ) -> None:
        """On a simulated clock, have it call `take` with everything that arrives, and `lost` when the bus has failed.

        `take` is given the identifier, with SocketCAN's flags for extended, remote and error frames, the data, and when
        the frame ended, ns. In an exchange, where the clock calls nobody, `receive_until` does so.
        """
        self._port.deliver_to(take, lambda error: lost(_operation_error(error)))

    def receive_until(self, enough: Callable[[], bool], deadline_ns: int) -> None:
        """In an exchange, let time pass and hand over what arrives until `enough()`, or until the deadline.

        Raises:
            can.CanOperationError: see `recv`.
        """
        try:
            self._port.receive_until(enough, deadline_ns)
        except PortError as error:
            raise _operation_error(error) from error

    def shutdown(self) -> None:
        """Leave the bus; idempotent."""
        super().shutdown()
        self._port.close()

    def _apply_filters(self, filters: can.typechecking.CanFilters | None) -> None:
        self._port.set_filters([(each["can_id"], each["can_mask"], each.get("extended")) for each in filters or ()])

    def _send_periodic_internal(
        self,
        msgs: Sequence[can.Message] | can.Message,
        period: float,
        duration: float | None = None,
        autostart: bool = True,
        modifier_callback: Callable[[can.Message], None] | None = None,
    ) -> can.broadcastmanager.CyclicSendTaskABC:
        if self._clock.simulated:
            raise can.CanOperationError("a simulated clock knows no threads: send from a clock's periodic call")
        return super()._send_periodic_internal(msgs, period, duration, autostart, modifier_callback)

    def _message(self, arrival: Arrival) -> can.Message:
        frame = arrival.frame
        return can.Message(
            timestamp=arrival.t_ns / NS_PER_S,
            arbitration_id=frame.id,
            is_extended_id=frame.extended,
            is_remote_frame=frame.remote,
            is_error_frame=arrival.error,
            channel=self._channel,
            dlc=len(frame.data),
            data=frame.data,
            is_rx=not arrival.own,
        )


def _operation_error(error: PortError | OutOfRange) -> can.CanOperationError:
    return can.CanOperationError(error.what, error.number if isinstance(error, PortError) else errno.EINVAL)
