"""One emulated CAN bus on a clock: nodes on one side, hosts' ports on the other."""

from __future__ import annotations

import errno
import random
import threading
from collections import deque
from collections.abc import Callable
from typing import Literal, NamedTuple

from microdrivers.core.clock import Clock, SimulatedClock
from microdrivers.core.errors import OutOfRange
from microdrivers.core.units import NS_PER_MS, seconds_to_ns
from microdrivers.fakes.can.arrival import PROTOCOL_ERROR
from microdrivers.fakes.can.frame import Frame
from microdrivers.fakes.can.pacing import Pacer, RealTimePacer, SimulatedPacer
from microdrivers.fakes.can.port import Port, PortError
from microdrivers.fakes.can.timeline import BusTimeline, CanNode

LOG_LENGTH = 20_000
"""Frames that a medium keeps: the newest."""

BITRATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)
"""Bit rates of CiA 301, and 100 kbit/s."""


_LATE_NS = 5 * NS_PER_MS
"""In real time: when something happens so much too late, the computer had other things to do."""

_CATCHING_UP_NS = 20 * NS_PER_MS
"""After that, others have their turn as well."""

_Passed = tuple[int, Literal["host", "node", "error"], Frame]


class Temper(NamedTuple):
    """How impolite hosts' ports are: a frame can be read up to `max_delay_s` after it has arrived.

    On a simulated clock only; an operating system brings its own delays.
    """

    max_delay_s: float = 0.00005


class Medium:
    """An emulated bus; see `BusTimeline` for the rules by which frames pass.

    On a simulated clock nothing happens by itself outside the clock's calls; on a real one a thread turns the medium,
    and everything here may be called from any thread. Close it at the end.

    Args:
        name: what python-can calls its channel.
        bitrate: bit/s.
        seed: of the ports' delays.

    Attributes:
        log: what passed, as (end of the frame in ns, who sent it, frame); the newest `LOG_LENGTH`. An error frame is
            logged as `PROTOCOL_ERROR` by "error". Take `list(log)` while the medium is in use.
        error_frames: error frames so far.
        on_passed: is told what `log` is told, while the medium is held; it must be short and not wait.
    """

    def __init__(self, name: str, *, clock: Clock, bitrate: int, seed: int, temper: Temper | None = None) -> None:
        if bitrate not in BITRATES:
            raise OutOfRange(
                f"{name}: a CAN bus cannot be set to {bitrate} bit/s",
                remedy=f"use one of {', '.join(map(str, BITRATES))} bit/s",
            )
        self.name = name
        self.clock = clock
        self.bitrate = bitrate
        self.seed = seed
        self.lock = threading.RLock()
        self.log: deque[_Passed] = deque(maxlen=LOG_LENGTH)
        self.error_frames = 0
        self.on_passed: Callable[[int, Literal["host", "node", "error"], Frame], object] | None = None
        self.plugged = True
        self._timeline = BusTimeline(bitrate=bitrate, on_passed=self._deliver)
        self._ports: list[Port] = []
        self._excused_ns = 0
        self._draw = random.Random(seed).random
        self._max_delay_ns = seconds_to_ns((temper or Temper()).max_delay_s) if clock.simulated else 0
        self._pacer: Pacer
        if isinstance(clock, SimulatedClock):
            self._pacer = SimulatedPacer(clock, self._timeline.play)
        else:
            with self.lock:  # its thread turns the medium at once
                self._pacer = RealTimePacer(clock, self.turn, lock=self.lock, name=name)

    # ------------------------------------------------------------------ who is there

    def attach(self, node: CanNode) -> None:
        """Switch a node on, now: it is advanced to the present and may send its boot-up."""
        with self.lock:
            self._timeline.play(self.clock.now_ns())
            self._timeline.attach(node, self.clock.now_ns())
            self._plan()

    def detach(self, node: CanNode) -> None:
        """Switch a node off, now; a frame that it is sending is gone."""
        with self.lock:
            self._timeline.play(self.clock.now_ns())
            self._timeline.detach(node, self.clock.now_ns())
            self._plan()

    def refresh(self) -> None:
        """Ask the nodes for their next events again: one has been changed other than over the bus."""
        with self.lock:
            self._timeline.play(self.clock.now_ns())
            self._timeline.ask_nodes()
            self._plan()

    def open_port(self, *, bitrate: int | None = None, receive_own: bool = False) -> Port:
        """A host's controller on the bus, at the medium's bit rate if none is given.

        Raises:
            PortError: the host's side is unplugged.
        """
        with self.lock:
            if not self.plugged:
                raise _unplugged(self.name)
            port = Port(self, self._timeline, self._pacer, bitrate=bitrate or self.bitrate, receive_own=receive_own)
            self._ports.append(port)
            return port

    # ------------------------------------------------------------------ what can go wrong

    def unplug(self) -> None:
        """Pull the hosts' cable: all ports fail until they are opened anew; the nodes stay among themselves."""
        with self.lock:
            self._timeline.play(self.clock.now_ns())
            self.plugged = False
            for port in tuple(self._ports):
                port.fail(_unplugged(self.name))

    def plug_in(self) -> None:
        """Put the cable back; hosts have to open their ports again."""
        with self.lock:
            self.plugged = True

    def bus_off(self) -> None:
        """All ports take themselves off the bus, as after 32 destroyed frames; open them anew."""
        with self.lock:
            self._timeline.play(self.clock.now_ns())
            for port in tuple(self._ports):
                port.bus_off()

    def inject_error_frame(self) -> None:
        """Disturb the bus now; a frame that is destroyed is sent again."""
        with self.lock:
            self._timeline.play(self.clock.now_ns())
            sender = self._timeline.disturb(self.clock.now_ns())
            if isinstance(sender, Port):
                sender.destroyed(self.clock.now_ns(), again=False)
            self._plan()

    # ------------------------------------------------------------------ time

    def turn(self, t_ns: int | None = None) -> int:
        """Let happen what is due by `t_ns`, or by now; returns when something happens next, `NEVER_NS` if nothing.

        In real time nodes do not blame hosts for as long as the computer did not let the bus go on.
        """
        with self.lock:
            now_ns = self.clock.now_ns()
            if not self.clock.simulated:
                self._excuse_hosts(now_ns)
            due_ns = self._timeline.play(now_ns if t_ns is None else t_ns)
            self._pacer.plan(due_ns)
            return due_ns

    def turned_by(self, tell: Callable[[], object] | None) -> None:
        """In real time: somebody else calls `turn` from now on, and is told when it is to be earlier; None ends this.

        It saves a thread that would have to be woken for each frame, and to wake another one.
        """
        if isinstance(self._pacer, RealTimePacer):
            self._pacer.leave_to(tell)

    def next_event_ns(self) -> int:
        """When something happens next on the bus; `NEVER_NS` if all is quiet."""
        with self.lock:
            return self._timeline.next_event_ns()

    def load(self, window_s: float = 1.0) -> float:
        """Share of the last `window_s` in which the bus was not free, 0 to 1; interframe spaces count as taken.

        Only frames that are in the log are looked at.
        """
        with self.lock:
            end_ns = self.clock.now_ns()
            begin_ns = end_ns - seconds_to_ns(window_s)
            self.turn(end_ns)
            busy_ns = 0
            for passed_ns, who, frame in reversed(self.log):
                free_ns = passed_ns + self._timeline.interframe_ns
                if free_ns <= begin_ns:
                    break
                start_ns = passed_ns - self._timeline.duration_ns(None if who == "error" else frame)
                busy_ns += max(0, min(free_ns, end_ns) - max(start_ns, begin_ns))
            return busy_ns / (end_ns - begin_ns)

    def close(self) -> None:
        """End the medium and its ports; idempotent."""
        for port in tuple(self._ports):
            port.close()
        self._pacer.close()

    # ------------------------------------------------------------------ for ports

    def forget(self, port: Port) -> None:
        """A port leaves, and its frames with it."""
        if port in self._ports:
            self._ports.remove(port)
        self._timeline.withdraw(port, self.clock.now_ns())
        self._plan()

    def _excuse_hosts(self, now_ns: int) -> None:
        """What hosts have sent may wait unread for as long as what was due here: nobody has let it happen."""
        late_ns = now_ns - max(self._timeline.next_event_ns(), self._excused_ns)
        if late_ns > _LATE_NS:
            self._excused_ns = now_ns
            self._timeline.excuse_hosts(late_ns, now_ns + _CATCHING_UP_NS)

    def _plan(self) -> None:
        self._pacer.plan(self._timeline.next_event_ns())

    def _deliver(self, sender: object, frame: Frame, start_ns: int, end_ns: int, intact: bool) -> None:
        who: Literal["host", "node", "error"] = "host" if isinstance(sender, Port) else "node"
        passed: _Passed = (end_ns, who, frame) if intact else (end_ns, "error", PROTOCOL_ERROR)
        self.log.append(passed)
        if self.on_passed is not None:
            self.on_passed(*passed)
        ready_ns = end_ns
        if self._max_delay_ns:
            ready_ns += round(self._draw() * self._max_delay_ns)
        if not intact:
            self._deliver_error(sender, start_ns, end_ns, ready_ns)
            return
        for port in self._ports:
            if port is not sender:
                port.take(frame, start_ns, end_ns, ready_ns)
            elif port.receive_own:
                port.take(frame, start_ns, end_ns, ready_ns, own=True)
        if isinstance(sender, Port):
            sender.sent()

    def _deliver_error(self, sender: object, start_ns: int, end_ns: int, ready_ns: int) -> None:
        self.error_frames += 1
        for port in self._ports:
            port.take(PROTOCOL_ERROR, start_ns, end_ns, ready_ns, error=True)
        if isinstance(sender, Port):
            sender.destroyed(end_ns, again=True)


def _unplugged(name: str) -> PortError:
    return PortError(
        f"the emulated CAN cable of {name} is unplugged",
        number=errno.ENODEV,
        remedy="plug it in and open the bus again",
    )
