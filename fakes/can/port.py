"""A host's CAN controller on an emulated bus."""

from __future__ import annotations

import errno
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from microdrivers.core.clock import ClockError
from microdrivers.core.errors import LinkError
from microdrivers.core.units import NS_PER_S, seconds_to_ns
from microdrivers.fakes.can.frame import Frame, arbitration_rank
from microdrivers.fakes.can.timeline import NEVER_NS

if TYPE_CHECKING:
    from microdrivers.fakes.can.medium import Medium

TRANSMIT_QUEUE = 64
"""Frames that a port holds back for the bus; SocketCAN's default is 10, and 1000 is often set."""

RECEIVE_QUEUE = 8192
"""Frames that a port keeps for a host that does not read."""

_LONGEST_WAIT_NS = 3600 * NS_PER_S
_ERROR_LIMIT = 256
_ERRORS_AN_ATTEMPT = 8

PROTOCOL_ERROR = Frame(0x008, bytes(8))
"""An error frame, as SocketCAN shows it: the class of the error as identifier (linux/can/error.h)."""


class PortError(LinkError):
    """The port cannot send or receive; `number` is the errno with which SocketCAN fails in that case."""

    def __init__(self, what: str, *, number: int, remedy: str) -> None:
        super().__init__(what, remedy=remedy)
        self.number = number


class Arrival(NamedTuple):
    """What a port received.

    Attributes:
        t_ns: when the frame ended on the bus.
        error: it is an error frame; `frame` then tells its class.
        own: the port sent it.
    """

    t_ns: int
    frame: Frame
    error: bool = False
    own: bool = False


class Port:
    """Sends in the order of its calls, as SocketCAN does, and receives what the others send.

    `Medium.open_port` makes ports. Usable from any thread on a real clock.

    Args:
        bitrate: another one than the medium's makes each frame an error, until the port is bus-off.
        receive_own: whether it also receives what it has sent, when that has passed.

    Attributes:
        dropped_frames: frames lost because nobody read.
        transmit_errors: error counter: 8 up for each destroyed frame, 1 down for each other; bus-off at 256.
    """

    def __init__(self, medium: Medium, *, bitrate: int, receive_own: bool) -> None:
        self.medium = medium
        self.readable = bitrate == medium.bitrate
        self.receive_own = receive_own
        self.dropped_frames = 0
        self.transmit_errors = 0
        self._clock = medium.clock
        self._opened_ns = medium.clock.now_ns()
        self._lock = medium.lock
        self._failure: PortError | None = None
        self._to_send: deque[tuple[int, Frame]] = deque()
        self._received: deque[tuple[int, Arrival]] = deque()
        self._filters: tuple[tuple[int, int, bool | None], ...] = ()
        self._accepted: dict[tuple[int, bool], bool] = {}
        self._arrived = medium.clock.event()
        self._waiting = False
        self._exchanging = False
        self._call: Callable[[], None] | None = None

    # ------------------------------------------------------------------ host side

    def send(self, frame: Frame, *, t_ns: int = 0) -> None:
        """Put a frame into the transmit queue; it competes from now on, or from `t_ns`.

        Raises:
            OutOfRange: it is no classic frame.
            PortError: the queue is full, or the port is closed, unplugged or bus-off.
        """
        arbitration_rank(frame)  # raises
        with self._lock:
            self._check()
            at_ns = max(t_ns, self._clock.now_ns())
            if len(self._to_send) >= TRANSMIT_QUEUE:
                self.medium.turn()
            if len(self._to_send) >= TRANSMIT_QUEUE:
                raise PortError("the transmit queue is full", number=errno.ENOBUFS, remedy="send less at once")
            self._to_send.append((at_ns, frame))
            if len(self._to_send) == 1:
                self.medium.offer(self, frame, at_ns)
                self.medium.settle()

    def receive(self, timeout_s: float | None) -> Arrival | None:
        """The oldest frame that has arrived; waits up to `timeout_s` for one.

        Raises:
            PortError: the port is closed, unplugged or bus-off.
            ClockError: without a time-out on a simulated clock.
        """
        clock = self._clock
        if timeout_s == 0:
            return self.poll(clock.now_ns())
        if timeout_s is None and clock.simulated:
            raise ClockError("an emulated CAN port needs a time-out on a simulated clock")
        deadline_ns = NEVER_NS if timeout_s is None else clock.now_ns() + seconds_to_ns(timeout_s)
        if clock.in_transaction:
            return self._receive_in_exchange(deadline_ns)
        while True:
            now_ns = clock.now_ns()
            arrival = self.poll(now_ns)
            if arrival is not None or now_ns >= deadline_ns:
                return arrival
            if clock.simulated and self._received:  # not readable yet
                clock.sleep_until(min(self._received[0][0], deadline_ns))
                continue
            self._waiting = True
            try:
                self._arrived.wait(min(deadline_ns - now_ns, _LONGEST_WAIT_NS) / NS_PER_S)
            finally:
                self._waiting = False

    def poll(self, t_ns: int) -> Arrival | None:
        """The oldest frame that has arrived by `t_ns`, without waiting.

        Raises:
            PortError: the port is closed, unplugged or bus-off.
        """
        with self._lock:
            self._check()
            received = self._received
            if not received and self.medium.next_event_ns() <= t_ns:
                self.medium.turn(t_ns)
                self._check()
            if received and received[0][0] <= t_ns:
                return received.popleft()[1]
            if not received:
                self._arrived.clear()
            return None

    def next_arrival_ns(self) -> int | None:
        """When to look again; None if nothing is under way.

        In real time only what has arrived counts: `on_arrival` tells of the rest.
        """
        with self._lock:
            if self._received:
                return self._received[0][0]
            due_ns = self.medium.next_event_ns() if self._clock.simulated else NEVER_NS
        return None if due_ns == NEVER_NS else due_ns

    def on_arrival(self, call: Callable[[], None] | None) -> None:
        """Call whenever something has arrived; None ends that.

        A simulated clock calls, at the arrival's time. In real time the thread that turns the medium calls, while it
        holds the medium: the call must be short and not wait.
        """
        self._call = call

    def set_filters(self, filters: Sequence[tuple[int, int, bool | None]]) -> None:
        """Receive only frames whose identifier is `id` where `mask` has ones, as (id, mask, extended or either).

        Without any, all are received. Error frames always are.
        """
        with self._lock:
            self._filters = tuple(filters)
            self._accepted.clear()

    def close(self) -> None:
        """Leave the bus; idempotent."""
        self._call = None
        self.fail(PortError("the CAN port is closed", number=errno.EBADF, remedy="open it again"))

    # ------------------------------------------------------------------ bus side

    def sent(self) -> None:
        """The port's oldest frame has passed; the next one competes."""
        self.transmit_errors = max(0, self.transmit_errors - 1)
        self._to_send.popleft()
        self._compete()

    def destroyed(self, *, again: bool) -> None:
        """The port's oldest frame was destroyed; it competes again, if the bus does not see to that."""
        self.transmit_errors += _ERRORS_AN_ATTEMPT
        if self.transmit_errors >= _ERROR_LIMIT:
            self.bus_off()
        elif again:
            self._compete()

    def take(self, arrival: Arrival, start_ns: int, ready_ns: int) -> None:
        """A frame has arrived that began at `start_ns`; the host can read it from `ready_ns` on."""
        if self._failure is not None or start_ns < self._opened_ns or not (arrival.error or self._accepts(arrival)):
            return
        if len(self._received) >= RECEIVE_QUEUE:
            self.dropped_frames += 1
            return
        self._received.append((ready_ns, arrival))
        if not self._clock.simulated:
            self._notify()
        elif (self._waiting or self._call is not None) and not self._exchanging:
            self._clock.call_at(ready_ns, self._notify, name="CAN arrival")

    def bus_off(self) -> None:
        """The controller has taken itself off the bus."""
        remedy = "check the bit rate, the termination and the wiring, then open the bus again"
        self.fail(PortError("the CAN controller is bus-off", number=errno.ENETDOWN, remedy=remedy))

    def fail(self, failure: PortError) -> None:
        """The port is of no use from now on; the first reason stays."""
        with self._lock:
            if self._failure is not None:
                return
            self._failure = failure
            self._to_send.clear()
            self._received.clear()
            self.medium.forget(self)
            if self._clock.simulated:
                self._clock.call_at(self._clock.now_ns(), self._notify, name="CAN port lost")
            else:
                self._notify()

    def _compete(self) -> None:
        if self._to_send:
            at_ns, frame = self._to_send[0]
            self.medium.offer(self, frame, at_ns)

    def _accepts(self, arrival: Arrival) -> bool:
        frame = arrival.frame
        if not self._filters or arrival.own:
            return True
        key = (frame.id, frame.extended)
        accepted = self._accepted.get(key)
        if accepted is None:
            accepted = self._accepted[key] = any(
                not (frame.id ^ wanted) & mask and (extended is None or extended == frame.extended)
                for wanted, mask, extended in self._filters
            )
        return accepted

    def _notify(self) -> None:
        if self._failure is None and self._clock.simulated and not self._readable_now():
            return  # it was read meanwhile
        self._arrived.set()
        if self._call is not None:
            self._call()

    def _readable_now(self) -> bool:
        return bool(self._received) and self._received[0][0] <= self._clock.now_ns()

    def _check(self) -> None:
        failure = self._failure
        if failure is not None:
            raise PortError(failure.what, number=failure.number, remedy=failure.remedy)

    def _receive_in_exchange(self, deadline_ns: int) -> Arrival | None:
        """Nobody else acts meanwhile: the bus is played until something has arrived."""
        clock = self._clock
        self._exchanging = True
        try:
            last_ns = self.medium.turn_until(self._has_news, deadline_ns)
        finally:
            self._exchanging = False
        if self._received:
            ready_ns = self._received[0][0]
            clock.sleep_until(min(ready_ns, deadline_ns))
            if ready_ns > deadline_ns:
                clock.call_at(ready_ns, self._notify, name="CAN arrival")
        else:
            clock.sleep_until(deadline_ns if self._failure is None else last_ns)
        return self.poll(clock.now_ns())

    def _has_news(self) -> bool:
        return bool(self._received) or self._failure is not None
