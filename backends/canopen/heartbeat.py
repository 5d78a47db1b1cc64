"""Network management: commands to nodes, our own heartbeat, and theirs watched (CiA 301).

A line has one `Heartbeats`. Nodes that consume ours stop when the host dies; that ours is missed while it merely waits
for an answer must not happen, on a simulated clock either.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from enum import IntEnum

from microdrivers.backends.lines.can_line import CanLine, Listening, Received
from microdrivers.core.clock import Timer
from microdrivers.core.errors import BusyError, LinkError
from microdrivers.core.units import NS_PER_MS, NS_PER_S, seconds_to_ns

HOST_NODE_ID = 127
"""Our own node id, under which our heartbeat goes out; no device may have it."""

NMT_ID, HEARTBEAT_ID = 0x000, 0x700

_NEVER_NS = 1 << 63
_LATE_NS = 40 * NS_PER_MS
"""A heartbeat that is later is worth being told of."""

_OTHER_HOST_NS = 2 * NS_PER_S


class NmtCommand(IntEnum):
    """What a node is told."""

    START = 0x01
    STOP = 0x02
    PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class NmtState(IntEnum):
    """What a heartbeat says; `BOOT_UP` comes once, after a node's power-on or reset."""

    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


class HeartbeatWatch:
    """One node's heartbeat.

    Args:
        on_heartbeat: called with each heartbeat's state, boot-ups included.
        on_silence: called once when the heartbeat has been missed.

    Attributes:
        alive: whether the node was last heard in time, or nothing is expected of it.
    """

    def __init__(
        self, line: CanLine, node_id: int, on_heartbeat: Callable[[int], object], on_silence: Callable[[], object]
    ) -> None:
        self.alive = True
        self._clock = line.clock
        self._on_heartbeat = on_heartbeat
        self._on_silence = on_silence
        self._timeout_ns = 0
        self._heard_ns = 0
        self._listening = line.listen(HEARTBEAT_ID + node_id, self._hear)

    def expect(self, timeout_s: float) -> None:
        """From now on a heartbeat is due every `timeout_s`; 0: none is expected."""
        self._heard_ns = self._clock.now_ns()
        self._timeout_ns = seconds_to_ns(timeout_s)
        self.alive = True

    def check(self, now_ns: int) -> None:
        """Look whether it is overdue."""
        if self._timeout_ns and self.alive and now_ns - self._heard_ns > self._timeout_ns:
            self.alive = False
            self._on_silence()

    def end(self) -> None:
        """Watch no longer."""
        self._timeout_ns = 0
        self._listening.cancel()

    def _hear(self, received: Received) -> None:
        if not received.data:
            return
        # Handed over late is not late: what counts is that it has come.
        self._heard_ns = max(received.t_ns, self._clock.now_ns())
        self.alive = True
        self._on_heartbeat(received.data[0] & 0x7F)


class Heartbeats:
    """All heartbeats of a line, ours and theirs, in the beat of the shortest interval that anybody asked for."""

    def __init__(self, line: CanLine) -> None:
        self._line = line
        self._intervals_ns: list[int] = []
        self._watches: tuple[HeartbeatWatch, ...] = ()
        self._timer: Timer | None = None
        self._upkeep: Listening | None = None
        self._last_ns = -_NEVER_NS
        self._since_ns = self._other_host_ns = -_NEVER_NS
        self._listening = line.listen(HEARTBEAT_ID + HOST_NODE_ID, self._hear_other_host)

    def refuse_other_host(self, interval_s: float) -> None:
        """Let pass only if no other program says that it drives this bus. Only what came since it was opened counts.

        In real time it is awaited for a little more than that interval, which is ours, and so that of a program of the
        same rig file.

        Raises:
            BusyError: one does; nothing was changed in any node.
        """
        line, clock = self._line, self._line.clock
        wait_ns = self._since_ns + seconds_to_ns(1.2 * interval_s) - clock.now_ns()
        if wait_ns > 0 and not clock.simulated:
            line.wait(clock.event(), wait_ns / NS_PER_S)
        if clock.now_ns() - self._other_host_ns < _OTHER_HOST_NS:
            raise BusyError(
                f"another program drives CAN bus {line.connection.channel}: it sends a host's heartbeat",
                moved="no",
                remedy="end it first: two programs would take each other's drives and sensors away",
            )

    def produce(self, interval_s: float) -> Listening:
        """Send our heartbeat at least so often, until cancelled; watches are looked at in the same beat."""
        interval_ns = seconds_to_ns(interval_s)
        if not self._intervals_ns:
            self._since_ns = self._line.clock.now_ns()
        self._intervals_ns.append(interval_ns)
        self._restart()

        def end() -> None:
            self._intervals_ns.remove(interval_ns)
            self._restart()

        return Listening(end)

    def watch(
        self, node_id: int, *, on_heartbeat: Callable[[int], object], on_silence: Callable[[], object]
    ) -> HeartbeatWatch:
        """Listen to a node's heartbeat; see `HeartbeatWatch`."""
        watch = HeartbeatWatch(self._line, node_id, on_heartbeat, on_silence)
        self._watches = (*self._watches, watch)
        return watch

    def unwatch(self, watch: HeartbeatWatch) -> None:
        """End a watch."""
        watch.end()
        self._watches = tuple(each for each in self._watches if each is not watch)

    def _hear_other_host(self, _received: Received) -> None:
        self._other_host_ns = self._line.clock.now_ns()

    def _restart(self) -> None:
        timer, self._timer = self._timer, None
        upkeep, self._upkeep = self._upkeep, None
        if timer is not None:
            timer.cancel()
        if upkeep is not None:
            upkeep.cancel()
        self._last_ns = -_NEVER_NS
        if self._intervals_ns:
            clock, interval_s = self._line.clock, min(self._intervals_ns) / NS_PER_S
            self._timer = clock.every(interval_s, self._beat, name=f"CAN {self._line.connection.channel} heartbeat")
            self._upkeep = self._line.keep_up(self._beat)

    def _beat(self) -> int:
        """Send and look, if it is time; returns when it is time again, ns."""
        now_ns, interval_ns = self._line.clock.now_ns(), min(self._intervals_ns, default=_NEVER_NS)
        since_ns = now_ns - self._last_ns
        if self._line.clock.simulated and since_ns < interval_ns * 3 // 4:
            return self._last_ns + interval_ns  # an exchange that waited has seen to it
        self._last_ns = now_ns
        with contextlib.suppress(LinkError):  # the line itself tells who uses it
            self._line.send(HEARTBEAT_ID + HOST_NODE_ID, bytes([NmtState.OPERATIONAL]))
        # After a beat that was late the receiver may not have had its turn either: look at the next one.
        if since_ns < interval_ns * 3 // 2:
            for watch in self._watches:
                watch.check(now_ns)
        elif _LATE_NS < since_ns - interval_ns < _NEVER_NS // 2:
            self._line.lateness.note(now_ns, since_ns - interval_ns)
        return now_ns + interval_ns
