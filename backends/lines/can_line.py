"""A CAN bus that many devices share: frames out from any thread, frames in to whoever listens, all on the clock.

In real time one thread receives. On a simulated clock there is none: the clock calls when something has arrived, and
whoever waits for an answer receives meanwhile, for everybody. So does the receiving thread when one of its listeners
waits for an answer: no listener can make the line deaf (docs/decisions/0014).
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

from microdrivers.backends.lines.can_adapter import CanAdapter
from microdrivers.backends.lines.can_in_process import InProcessAdapter, InProcessReceiver
from microdrivers.backends.lines.can_listeners import (
    SILENCE_REMEDY,
    Awaited,
    CanCounters,
    Lateness,
    Listener,
    Listeners,
    Listening,
    LossListener,
    Received,
    Upkeep,
)
from microdrivers.backends.lines.can_load import LoadMeter
from microdrivers.backends.lines.can_receiving import Receiver, ThreadReceiver
from microdrivers.backends.lines.settings import CanConnection
from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock, ClockEvent
from microdrivers.core.errors import BusyError, ConfigError, LinkError, LinkLost, LinkTimeout
from microdrivers.core.units import NS_PER_S
from microdrivers.devices.shared_bus import BusFacts
from microdrivers.devices.wire_tap import CanTap

ServiceT = TypeVar("ServiceT")

_SHORTEST_FRAME_BITS = 44
_MOST_BYTES = 64  # of CAN FD

__all__ = ["CanLine", "Listening", "Received", "SILENCE_REMEDY", "shared_can_line"]


class CanLine:
    """One bus; see the module. Get it with `shared_can_line`.

    `send` takes no lock that anybody holds while waiting, so a stop can be sent at any time.

    Attributes:
        counters: what has happened since it was opened.
        lost: why the adapter is gone, if it is.
        newest_ns: stamp of the newest frame received, ns.
        shortest_ns: by number of bytes, the shortest time that a data frame can take on the bus.
        tap: is told every frame that passes, if somebody listens there.
        lateness: of this computer, as far as somebody has noted it.
    """

    def __init__(self, connection: CanConnection, *, clock: Clock) -> None:
        self.connection = connection
        self.clock = clock
        self.counters = CanCounters()
        self.lateness = Lateness()
        self.newest_ns = -1
        self.tap: CanTap | None = None
        self._load = LoadMeter(connection.bitrate)
        self.shortest_ns: Sequence[int] = [
            (_SHORTEST_FRAME_BITS + 8 * length) * NS_PER_S // connection.bitrate for length in range(_MOST_BYTES + 1)
        ]
        self._adapter: CanAdapter | None = None
        self.lost: LinkLost | None = None
        self._users = 0
        self._life = threading.RLock()
        self._sending = threading.Lock()
        self._failing = threading.Lock()
        self._listeners = Listeners(clock)
        self._waiting: set[ClockEvent] = set()
        self._services: dict[object, Any] = {}
        self._upkeep = Upkeep(needed=clock.simulated)
        self._receiver: Receiver | None = None

    # ------------------------------------------------------------------ life

    def open(self) -> None:
        """Open the adapter for the first who asks, and again if it was lost; `close` as often.

        Raises:
            LinkLost, ConfigError, UnsupportedError: it cannot be opened; the remedy says what to do.
        """
        with self._life:
            if self.lost is not None:
                self._end()
            if self._adapter is None:
                self.counters = CanCounters()
                self._begin()
            self._users += 1

    def close(self) -> None:
        """Give the adapter up with the last who has opened it."""
        with self._life:
            self._users = max(0, self._users - 1)
            if not self._users:
                self._end()

    def _begin(self) -> None:
        adapter: CanAdapter
        if self.clock.simulated:
            adapter = InProcessAdapter(self.connection, clock=self.clock, counters=self.counters, tap=self.tap)
            self._receiver = InProcessReceiver(self, adapter, upkeep=self._upkeep)
        else:
            adapter = CanAdapter(self.connection, clock=self.clock, counters=self.counters, tap=self.tap)
        self._adapter, self.lost = adapter, None
        adapter.accept(self._listeners.cob_ids)
        if self._receiver is None:
            self._receiver = ThreadReceiver(self, adapter, name=f"CAN {self.connection.channel}")

    def _end(self) -> None:
        adapter, self._adapter = self._adapter, None
        receiver, self._receiver = self._receiver, None
        if receiver is not None:
            receiver.end()
        if adapter is not None:
            adapter.close()
        self.lost = None

    # ------------------------------------------------------------------ traffic

    def send(self, cob_id: int, data: bytes = b"") -> None:
        """Send a frame, from any thread; nothing is awaited.

        Raises:
            LinkTimeout: nobody acknowledges frames. LinkLost: the adapter is gone, or off the bus.
        """
        adapter = self._require_adapter()
        try:
            with self._sending:
                adapter.send(cob_id, data)
        except adapter.failures as error:
            raise self.fail(adapter, error) from error
        self.counters.sent += 1
        self._load.add(self.clock.now_ns(), len(data))

    def listen(self, cob_id: int, call: Listener) -> Listening:
        """Call with every data frame of that identifier, in the thread that receives it."""
        self._begin_listening(cob_id, call)
        return Listening(lambda: self._listeners.remove(cob_id, call))

    def _begin_listening(self, cob_id: int, call: Listener) -> None:
        is_new, adapter = self._listeners.add(cob_id, call), self._adapter
        if is_new and adapter is not None:
            adapter.accept(self._listeners.cob_ids)

    def exchange(
        self, cob_id: int, data: bytes, reply_id: int, accept: Callable[[bytes], bool], timeout_s: float
    ) -> Received:
        """Send a frame and wait for the first one of `reply_id` that is accepted.

        Raises:
            LinkTimeout: none came. LinkLost: the adapter is gone, or off the bus.
        """
        awaited = Awaited(accept, self.clock.event())
        self._begin_listening(reply_id, awaited.hear)
        try:
            self.send(cob_id, data)
            self.wait(awaited.flag, timeout_s)
        finally:
            self._listeners.remove(reply_id, awaited.hear)
        found = awaited.found
        if found is None:
            self.counters.timeouts += 1
            raise self.silence(f"no reply to {cob_id:03X}#{data.hex().upper()}", timeout_s)
        self.counters.exchanges += 1
        return found

    def silence(self, what: str, timeout_s: float) -> LinkTimeout:
        """The error for something that has not come; it says so if bit rate or this computer are to be suspected."""
        where = f"within {1000 * timeout_s:.0f} ms on CAN bus {self.connection.channel}"
        remedy = self.lateness.REMEDY if self.lateness.hint(self.clock.now_ns()) else SILENCE_REMEDY
        return LinkTimeout(f"{what} {where}{self.doubts}", remedy=remedy)

    @property
    def doubts(self) -> str:
        """What else may be to blame if somebody is silent: the adapter, the bit rate, this computer."""
        return f"{self.counters.hint()}{self.lateness.hint(self.clock.now_ns())}"

    def on_loss(self, call: LossListener) -> Listening:
        """Call when the adapter is gone or off the bus, in whichever thread notices; not when the line is closed."""
        self._listeners.add_loss(call)
        return Listening(lambda: self._listeners.remove_loss(call))

    # ------------------------------------------------------------------ waiting

    def wait(self, flag: ClockEvent, timeout_s: float) -> bool:
        """Wait until a listener has raised the flag; tells whether it is up.

        Raises:
            LinkLost: the adapter is gone, or off the bus.
        """
        receiver = self._receiver
        if receiver is not None:
            self._waiting.add(flag)
            try:
                receiver.wait(flag, timeout_s)
            finally:
                self._waiting.discard(flag)
        self._require_adapter()
        return flag.is_set()

    def acquire(self, lock: threading.Lock, *, timeout_s: float, what: str) -> None:
        """Take a lock that others hold while they wait for frames; the receiving thread receives meanwhile.

        Raises:
            BusyError: it did not become free; `what` is under way.
        """
        if lock.acquire(blocking=False):
            return
        receiver = self._receiver
        if receiver is None or not receiver.acquire(lock, timeout_s):
            raise BusyError(f"{what} is under way", remedy="wait until it has ended, or stop the device")

    @contextmanager
    def holding(self, lock: threading.Lock, *, timeout_s: float, what: str) -> Iterator[None]:
        """Hold a lock; see `acquire`."""
        self.acquire(lock, timeout_s=timeout_s, what=what)
        try:
            yield
        finally:
            lock.release()

    def keep_up(self, upkeep: Callable[[], int]) -> Listening:
        """Have something done in time also while an exchange waits on a simulated clock, where timers then stand still.

        `upkeep` does what is due and returns when to be called again, ns. In real time it is never called.
        """
        self._upkeep.add(upkeep)
        return Listening(lambda: self._upkeep.remove(upkeep))

    # ------------------------------------------------------------------ facts

    @property
    def load(self) -> float:
        """Share of the bus' time that the frames of this line took of late, 0 to 1: sent, and listened for.

        Stuff bits are counted at their most. Frames that nobody on this line listens for may be left out.
        """
        return self._load.share(self.clock.now_ns())

    @property
    def facts(self) -> BusFacts:
        """The bus at present, for whoever examines a rig."""
        connection = self.connection
        return BusFacts(
            name=f"CAN {connection.channel}", bitrate=connection.bitrate, load=self.load, counters=vars(self.counters)
        )

    @property
    def stamps_frames(self) -> bool:
        """Whether frames are stamped as they pass, and not when they are handed over."""
        return self._adapter is not None and self._adapter.stamps_frames

    def service(self, kind: Callable[[CanLine], ServiceT]) -> ServiceT:
        """The one object of that kind which all users of the line share, made for the first who asks."""
        with self._life:
            if kind not in self._services:
                self._services[kind] = kind(self)
            found: ServiceT = self._services[kind]
            return found

    # ------------------------------------------------------------------ for the receiver

    def hear(self, cob_id: int, data: bytes, t_ns: int, dt_ns: int) -> None:
        """A data frame with 11 bits of identifier has arrived at `t_ns` ± `dt_ns`."""
        self.counters.received += 1
        self._load.add(t_ns, len(data))
        calls = self._listeners.by_id.get(cob_id)
        if not calls:
            return
        if t_ns > self.newest_ns:
            self.newest_ns = t_ns
        received = Received(cob_id, data, t_ns, dt_ns)
        for call in calls:
            try:
                call(received)
            except Exception as error:  # noqa: BLE001 - it must not make the line deaf, nor keep it from others
                self._listeners.report(error)

    def pass_by(self, length: int) -> None:
        """Another frame, of so many bytes, has arrived."""
        self.counters.received += 1
        self._load.add(self.clock.now_ns(), length)

    def fail(self, adapter: CanAdapter, cause: Exception) -> LinkError:
        """Note a failure; returns the error for whoever caused or awaits something."""
        error = adapter.explain(cause)
        if not isinstance(error, LinkLost):
            return error
        error.what += self.counters.hint()
        with self._failing:
            if self.lost is not None or self._adapter is not adapter:
                return error
            self.lost = error
        for flag in tuple(self._waiting):
            flag.set()
        for call in self._listeners.on_loss:
            call(error)
        return error

    def _require_adapter(self) -> CanAdapter:
        if self.lost is not None:
            raise LinkLost(self.lost.what, remedy=self.lost.remedy)
        if self._adapter is None:
            raise LinkLost("the CAN bus is closed", remedy="open the device first", moved="no")
        return self._adapter


_lines: weakref.WeakValueDictionary[tuple[int, str, str], CanLine] = weakref.WeakValueDictionary()


def shared_can_line(connection: CanConnection, *, clock: Clock, bus: Bus | None = None) -> CanLine:
    """The line of that interface and channel on that clock, closed until somebody opens it.

    Its frames can be listened to on the first `bus` that is given: see `CanTap`.

    Raises:
        ConfigError: another device of the rig wants another bit rate, or other options, of the same bus.
    """
    key = (id(clock), connection.interface, connection.channel)
    line = _lines.get(key)
    if line is None:
        line = _lines[key] = CanLine(connection, clock=clock)
    if line.tap is None and bus is not None:
        line.tap = CanTap(connection.channel, bus)
    for setting in ("bitrate", "options"):
        wanted, present = getattr(connection, setting), getattr(line.connection, setting)
        if wanted != present:
            raise ConfigError(
                f"another device on {connection.channel} has {setting} {present}, this one {wanted}",
                key=f"connection.{setting}", remedy=f"give all devices of a bus the same {setting}",
            )  # fmt: skip
    return line
