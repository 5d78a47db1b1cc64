"""A host's CAN controller on an emulated bus."""

from __future__ import annotations

import errno
import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Protocol

from microdrivers.core.clock import Clock, ClockError
from microdrivers.core.errors import LinkError
from microdrivers.core.units import NS_PER_S, seconds_to_ns
from microdrivers.fakes.can.arrival import ERROR_FLAG, EXTENDED_FLAG, PROTOCOL_ERROR, REMOTE_FLAG, Arrival, Filter
from microdrivers.fakes.can.frame import Frame, frame_shape
from microdrivers.fakes.can.pacing import Pacer
from microdrivers.fakes.can.timeline import NEVER_NS, BusTimeline

TRANSMIT_QUEUE = 64
"""Frames that a port holds back for the bus; SocketCAN's default is 10, and 1000 is often set."""

RECEIVE_QUEUE = 8192
"""Frames that a port keeps for a host that does not read."""

_LONGEST_WAIT_NS = 3600 * NS_PER_S
_ERROR_LIMIT = 256
_ERRORS_AN_ATTEMPT = 8


class PortError(LinkError):
    """The port cannot send or receive; `number` is the errno with which SocketCAN fails in that case."""

    def __init__(self, what: str, *, number: int, remedy: str) -> None:
        super().__init__(what, remedy=remedy)
        self.number = number


# From when on the host can read it, and the fields of an `Arrival`. A plain tuple: one is made for each frame.
_Received = tuple[int, int, Frame, bool, bool]


class SharedMedium(Protocol):
    """What a port needs of the bus that it is on; see `Medium`."""

    bitrate: int
    clock: Clock
    lock: threading.RLock

    def turn(self, t_ns: int | None = None) -> int:
        """Let happen what is due."""

    def next_event_ns(self) -> int:
        """When something happens next."""

    def forget(self, port: Port) -> None:
        """A port leaves, and its frames with it."""


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

    def __init__(
        self, medium: SharedMedium, timeline: BusTimeline, pacer: Pacer, *, bitrate: int, receive_own: bool
    ) -> None:
        self.medium = medium
        self._timeline = timeline
        self._pacer = pacer
        self.readable = bitrate == medium.bitrate
        self.receive_own = receive_own
        self.dropped_frames = 0
        self.transmit_errors = 0
        self._clock = medium.clock
        self._opened_ns = medium.clock.now_ns()
        self._lock = medium.lock
        self._failure: PortError | None = None
        self._to_send: deque[tuple[int, Frame]] = deque()
        self._received: deque[_Received] = deque()
        self._filter = Filter(())
        self._arrived = medium.clock.event()
        self._waiting = False
        self._exchanging = False
        self._call: Callable[[], None] | None = None
        self._take: Callable[[int, bytes, int], object] | None = None
        self._lost: Callable[[PortError], object] = lambda _: None
        self._tell: Callable[[int], None] | None = None
        self._choose_call()

    # ------------------------------------------------------------------ host side

    def send(self, frame: Frame, *, t_ns: int = 0) -> None:
        """Put a frame into the transmit queue; it competes from now on, or from `t_ns`.

        Raises:
            OutOfRange: it is no classic frame.
            PortError: the queue is full, or the port is closed, unplugged or bus-off.
        """
        with self._lock:
            if self._failure is not None:
                self._check()
            now_ns, queue = self._clock.now_ns(), self._to_send
            at_ns = t_ns if t_ns > now_ns else now_ns
            if queue:
                frame_shape(frame)  # raises
                if len(queue) >= TRANSMIT_QUEUE:
                    self.medium.turn()
                if len(queue) >= TRANSMIT_QUEUE:
                    raise PortError("the transmit queue is full", number=errno.ENOBUFS, remedy="send less at once")
            if queue:
                queue.append((at_ns, frame))
                return
            self._timeline.offer(self, frame, at_ns, self.readable)
            queue.append((at_ns, frame))
            if self._clock.simulated:
                self._pacer.plan(self._timeline.next_event_ns())  # it starts when all who offer one now have done so
            else:
                self.medium.turn()

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
            received = self._await_in_exchange(deadline_ns)
            return None if received is None else _arrival(received)
        while True:
            now_ns = clock.now_ns()
            arrival = self.poll(now_ns)
            if arrival is not None or now_ns >= deadline_ns:
                return arrival
            if clock.simulated and self._received:  # not readable yet
                clock.sleep_until(min(self._received[0][0], deadline_ns))
                continue
            self._waiting = True
            self._choose_call()
            try:
                self._arrived.wait(min(deadline_ns - now_ns, _LONGEST_WAIT_NS) / NS_PER_S)
            finally:
                self._waiting = False
                self._choose_call()

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
                return _arrival(received.popleft())
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
        self._call, self._take = call, None
        self._choose_call()

    def deliver_to(self, take: Callable[[int, bytes, int], object], lost: Callable[[PortError], object]) -> None:
        """On a simulated clock, have `take` called with everything that arrives, and `lost` when the port fails.

        `take` is given identifier, data and the end of the frame. The identifier has SocketCAN's flags, such as
        `EXTENDED_FLAG`. In an exchange, where the clock calls nobody, `receive_until` does so.
        """
        self._take, self._lost = take, lost
        self._choose_call()
        if self._received:
            self._pacer.call_at(max(self._received[0][0], self._clock.now_ns()), self._hand_over)

    def receive_until(self, enough: Callable[[], bool], deadline_ns: int) -> None:
        """In an exchange, hand over what arrives to whom `deliver_to` has named, until `enough()` or the deadline.

        Raises:
            PortError: the port is closed, unplugged or bus-off.
        """
        while not enough() and (received := self._await_in_exchange(deadline_ns)) is not None:
            self._give(received)

    def set_filters(self, filters: Sequence[tuple[int, int, bool | None]]) -> None:
        """Receive only frames whose identifier is `id` where `mask` has ones, as (id, mask, extended or either).

        Without any, all are received. Error frames always are.
        """
        self._filter = Filter(filters)

    def close(self) -> None:
        """Leave the bus; idempotent."""
        self._call = self._take = None
        self._choose_call()
        self.fail(PortError("the CAN port is closed", number=errno.EBADF, remedy="open it again"))

    # ------------------------------------------------------------------ bus side

    def sent(self) -> None:
        """The port's oldest frame has passed; the next one competes."""
        self.transmit_errors = max(0, self.transmit_errors - 1)
        self._to_send.popleft()
        self._compete()

    def destroyed(self, t_ns: int, *, again: bool) -> None:
        """The port's oldest frame was destroyed; it competes again, if the bus does not see to that."""
        self.transmit_errors += _ERRORS_AN_ATTEMPT
        if self.transmit_errors >= _ERROR_LIMIT:
            self.bus_off(t_ns)
        elif again:
            self._compete()

    def take(
        self, frame: Frame, start_ns: int, end_ns: int, ready_ns: int, error: bool = False, own: bool = False
    ) -> None:
        """A frame has arrived, from `start_ns` to `end_ns`; the host can read it from `ready_ns` on."""
        if not self.readable and not error:
            frame, error, own = PROTOCOL_ERROR, True, False
        if start_ns < self._opened_ns or self._failure is not None:
            return
        if not (error or own or self._filter.accepts(frame)):
            return
        if len(self._received) >= RECEIVE_QUEUE:
            self.dropped_frames += 1
            return
        self._received.append((ready_ns, end_ns, frame, error, own))
        if self._tell is not None and not self._exchanging:
            self._pacer.call_at(ready_ns, self._tell)

    def bus_off(self, t_ns: int = 0) -> None:
        """The controller has taken itself off the bus, now or at `t_ns`."""
        remedy = "check the bit rate, the termination and the wiring, then open the bus again"
        self.fail(PortError("the CAN controller is bus-off", number=errno.ENETDOWN, remedy=remedy), t_ns)

    def fail(self, failure: PortError, t_ns: int = 0) -> None:
        """The port is of no use from now on, or from `t_ns` on; the first reason stays."""
        with self._lock:
            if self._failure is not None:
                return
            self._failure = failure
            self._to_send.clear()
            self._received.clear()
            self.medium.forget(self)
            self._pacer.call_at(max(t_ns, self._clock.now_ns()), self._tell or self._notify)

    def _compete(self) -> None:
        if self._to_send:
            at_ns, frame = self._to_send[0]
            self._timeline.offer(self, frame, at_ns, self.readable)

    def _choose_call(self) -> None:
        """What the pacer calls when something can be read: nothing if nobody wants to know."""
        if self._take is not None:
            self._tell = self._hand_over
        else:
            wanted = self._call is not None or self._waiting or not self._clock.simulated
            self._tell = self._notify if wanted else None

    def _notify(self, now_ns: int) -> None:
        """Something can be read, or the port has failed: tell whoever waits."""
        if self._failure is None and not (self._received and self._received[0][0] <= now_ns):
            return  # it was read meanwhile
        self._arrived.set()
        if self._call is not None:
            self._call()

    def _hand_over(self, now_ns: int) -> None:
        """The same for the one to whom everything is delivered; what nobody takes stays to be read."""
        if self._take is None:
            return
        received = self._received
        while received and received[0][0] <= now_ns:
            self._give(received.popleft())
        if self._failure is not None:
            self._lost(self._failure)

    def _give(self, received: _Received) -> None:
        _, t_ns, frame, error, _ = received
        identifier = frame.id
        if error or frame.extended or frame.remote:
            identifier |= frame.extended * EXTENDED_FLAG | frame.remote * REMOTE_FLAG | error * ERROR_FLAG
        if self._take is not None:
            self._take(identifier, frame.data, t_ns)

    def _check(self) -> None:
        failure = self._failure
        if failure is not None:
            raise PortError(failure.what, number=failure.number, remedy=failure.remedy)

    def _await_in_exchange(self, deadline_ns: int) -> _Received | None:
        """Nobody else acts meanwhile: the bus is played until something has arrived."""
        clock, received = self._clock, self._received
        if self._failure is not None:
            self._check()
        if not received:
            self._exchanging = True
            try:
                self._pacer.plan(self._timeline.play(deadline_ns, self._has_news))
            finally:
                self._exchanging = False
            if self._failure is not None:
                clock.sleep_until(self._timeline.last_event_ns)
                self._check()
        if not received or received[0][0] > deadline_ns:
            clock.sleep_until(deadline_ns)
            if received and self._tell is not None:
                self._pacer.call_at(received[0][0], self._tell)
            return None
        clock.sleep_until(received[0][0])
        return received.popleft()

    def _has_news(self) -> bool:
        return bool(self._received) or self._failure is not None


def _arrival(received: _Received) -> Arrival:
    return Arrival(*received[1:])
