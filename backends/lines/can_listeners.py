"""Who listens for which frames on a CAN line, what has passed there, and what must not wait."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from functools import partial

import msgspec

from microdrivers.core.clock import Clock, ClockEvent
from microdrivers.core.errors import LinkLost
from microdrivers.core.units import NS_PER_MS, NS_PER_S

SILENCE_REMEDY = (
    "check power, the node id switches, the bit rate, the cable and its termination (60 Ω between CAN_H and CAN_L)"
)

_NEVER_NS = 1 << 63
_REMEMBERED_NS = 2 * NS_PER_S


class Received(msgspec.Struct, frozen=True, gc=False):
    """A data frame; `t_ns` ± `dt_ns` is when it had arrived on the bus, on the rig's clock."""

    cob_id: int
    data: bytes
    t_ns: int
    dt_ns: int


Listener = Callable[[Received], object]
LossListener = Callable[[LinkLost], object]


class Listening:
    """Something that goes on until it is cancelled."""

    def __init__(self, end: Callable[[], object]) -> None:
        self._end = end

    def cancel(self) -> None:
        """End it; idempotent."""
        end, self._end = self._end, lambda: None
        end()


class Awaited(msgspec.Struct):
    """The first frame that is accepted, as an answer. `found` is it, once `flag` is up."""

    accept: Callable[[bytes], bool]
    flag: ClockEvent
    found: Received | None = None

    def hear(self, received: Received) -> None:
        """A frame with the identifier of the answer."""
        if self.found is None and self.accept(received.data):
            self.found = received
            self.flag.set()


class CanCounters:
    """What has happened on a line since it was opened."""

    def __init__(self) -> None:
        self.sent = 0
        self.received = 0
        self.exchanges = 0
        self.timeouts = 0
        self.error_frames = 0
        self.garbled = 0
        self.refused = 0

    def hint(self) -> str:
        """What a message of something that failed may add: whether bit rate or adapter are to be suspected."""
        if self.refused:
            return f" (the adapter has refused {self.refused} frames: it is off the bus, or nobody acknowledges them)"
        if self.error_frames and not self.received:
            return f" ({self.error_frames} error frames and no sound one: is the bit rate right?)"
        return f" ({self.error_frames} error frames)" if self.error_frames else ""


class Lateness:
    """Whether this computer has been too busy of late: it then blames nobody else first."""

    REMEDY = (
        "have this computer do less at once: end other programs, stream at lower rates; if that cannot be, allow more "
        "time in the rig file (heartbeat_ms, timeout_s)"
    )

    def __init__(self) -> None:
        self._until_ns = self._late_ns = 0

    def note(self, now_ns: int, late_ns: int) -> None:
        """Something that was due is done only now."""
        self._late_ns = max(late_ns, self._late_ns if now_ns < self._until_ns else 0)
        self._until_ns = now_ns + _REMEMBERED_NS

    def hint(self, now_ns: int) -> str:
        """What a message of something that failed may add; empty if the computer was in time."""
        if now_ns >= self._until_ns:
            return ""
        return f" (this computer is too busy: our heartbeat was {self._late_ns / NS_PER_MS:.0f} ms late)"


class Listeners:
    """Tables that may be changed from any thread while another one goes through them.

    Attributes:
        by_id: whom to call with a frame.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self.by_id: dict[int, tuple[Listener, ...]] = {}
        self._on_loss: tuple[LossListener, ...] = ()

    @property
    def cob_ids(self) -> Iterable[int]:
        """All that anybody has ever listened for."""
        return tuple(self.by_id)

    def report(self, error: Exception) -> None:
        """Have the clock hand an error of a listener on to the main program."""
        self._clock.call_at(self._clock.now_ns(), partial(_fail, error), name="CAN listener")

    @property
    def on_loss(self) -> tuple[LossListener, ...]:
        """Whom to tell of a lost adapter."""
        return self._on_loss

    def add(self, cob_id: int, call: Listener) -> bool:
        """Call with frames of that identifier from now on; tells whether nobody has listened for it before."""
        with self._lock:
            is_new = cob_id not in self.by_id
            self.by_id[cob_id] = (*self.by_id.get(cob_id, ()), call)
            return is_new

    def remove(self, cob_id: int, call: Listener) -> None:
        """Do not call any more. The identifier stays known."""
        with self._lock:
            self.by_id[cob_id] = tuple([each for each in self.by_id.get(cob_id, ()) if each != call])

    def add_loss(self, call: LossListener) -> None:
        """Call when the adapter is lost."""
        with self._lock:
            self._on_loss = (*self._on_loss, call)

    def remove_loss(self, call: LossListener) -> None:
        """Do not call any more."""
        with self._lock:
            self._on_loss = tuple(each for each in self._on_loss if each is not call)


def _fail(error: Exception) -> None:
    raise error


class Upkeep:
    """What has to be done in time also while an exchange waits where timers then stand still: on a simulated clock."""

    def __init__(self, *, needed: bool) -> None:
        self._calls: tuple[Callable[[], int], ...] = ()
        self._start_ns = 0 if needed else _NEVER_NS
        self._next_ns = self._start_ns

    def add(self, call: Callable[[], int]) -> None:
        """Have it called when it is due; it returns when that is, ns."""
        self._calls = (*self._calls, call)
        self._next_ns = self._start_ns

    def remove(self, call: Callable[[], int]) -> None:
        """Do not call any more."""
        self._calls = tuple(each for each in self._calls if each is not call)

    def do(self, now_ns: int) -> int:
        """Do what is due; returns when something is due again."""
        if now_ns >= self._next_ns:
            self._next_ns = max(now_ns + 1, min((call() for call in self._calls), default=_NEVER_NS))
        return self._next_ns
