"""The three drives of a stage together: looked at by one SYNC, stopped at once, started together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

from microdrivers.backends.canopen.synced_pdos import PdosMissing, SyncedPdos, SyncSet
from microdrivers.backends.cia402 import objects
from microdrivers.backends.cia402.drive import Drive
from microdrivers.backends.cia402.states import Control, State, Status, next_control_word
from microdrivers.backends.lines.can_line import CanLine
from microdrivers.core.clock import Clock
from microdrivers.core.errors import LinkError, LinkTimeout, MoveCancelled, ProtocolError
from microdrivers.core.units import seconds_to_ns

_ENABLE_S = 2.0
"""A drive may have to release a brake."""

_RESEND_S = 0.1
_ACKNOWLEDGE_S = 0.3
_PAUSE_S = 0.002


class Drives:
    """All drives of a stage; nothing here waits for a motion to end.

    A stop is a quick stop (control word 0002h), sent to all drives before anything else is done with it: it ends a move
    for good, in every mode, where a halt (bit 8) would let it go on as soon as the bit is taken back.

    Args:
        line: the bus.
        drives: one for each axis.
        timeout_s: how long PDOs may take.
        on_set: called with each set of a stream; `on_lost` with the identifiers missing from one.
        check: raises what stands against a move: a fault, or a drive that has gone.

    Attributes:
        all: the drives, in the order of the axes.
        stops: changes before and after every stop that is sent.
        line: the bus.
    """

    def __init__(
        self, line: CanLine, drives: Sequence[Drive], *, timeout_s: float, on_set: Callable[[SyncSet], object],
        on_lost: Callable[[Sequence[int]], object], check: Callable[[], object],
    ) -> None:  # fmt: skip
        self.all: Sequence[Drive] = tuple(drives)
        self.by_axis: Mapping[str, Drive] = {drive.axis: drive for drive in drives}
        self.stops = 0
        self.pdos = SyncedPdos(line, [drive.status_id for drive in drives], on_set=on_set, on_lost=on_lost)
        self.clock: Clock = line.clock
        self.line = line
        self._timeout_s = timeout_s
        self._check = check

    def are_ready(self) -> bool:
        """Whether all are set up."""
        return all(drive.ready for drive in self.all)

    def are_braking(self) -> bool:
        """Whether one was told to stop, and has not been seen at rest since."""
        return any(drive.watch.braking for drive in self.all)

    # ------------------------------------------------------------------ looking

    def look(self) -> SyncSet:
        """What all drives report at one instant, from now on.

        Raises:
            LinkTimeout: a drive does not answer, by name. LinkLost, ProtocolError: see `SyncedPdos`.
        """
        try:
            found = self.pdos.take(self._timeout_s)
        except PdosMissing as error:
            names = ", ".join(drive.name for drive in self.all if drive.status_id in error.missing)
            raise LinkTimeout(f"{names or 'a drive'}: {error.what}", remedy=error.remedy) from error
        self.see(found)
        return found

    def see(self, found: SyncSet) -> None:
        """Take in a set."""
        t_ns = found.t_ns
        for drive, frame in zip(self.all, found.frames, strict=True):
            drive.reading = reading = drive.decode(frame.data)
            drive.watch.see(t_ns, reading)

    # ------------------------------------------------------------------ stopping

    def stop(self) -> None:
        """Have all drives brake now; from any thread, without a lock, awaiting nothing.

        Raises:
            LinkError: a drive could not be told; the others were.
        """
        self.stops += 1
        failure: LinkError | None = None
        for drive in self.all:
            try:
                drive.quick_stop()
            except LinkError as error:
                failure = error
        now_ns = self.clock.now_ns()
        for drive in self.all:
            drive.watch.ended(now_ns)
        self.stops += 1
        if failure is not None:
            raise failure

    def refuse_after_stop(self, stops: int) -> None:
        """Go on only if nobody has stopped the stage since `stops` was read.

        Raises:
            MoveCancelled: somebody has.
        """
        if self.stops != stops:
            raise MoveCancelled(
                "a stop was sent while the move was being prepared", moved="no",
                remedy="check why the stop was requested, then command a new move",
            )  # fmt: skip

    # ------------------------------------------------------------------ starting

    def prepare(self, axes: Iterable[str], mode: int, stops: int) -> None:
        """Bring these drives into a mode, holding their positions, with no set-point pending.

        Raises:
            LinkTimeout: a drive does not follow. MoveCancelled: a stop was sent meanwhile.
        """
        drives = [self.by_axis[axis] for axis in axes]
        self.look()
        self._check()
        for drive in drives:
            if drive.reading is None or drive.reading.mode != mode:
                drive.set_mode(mode)
        deadline_ns = self.clock.now_ns() + seconds_to_ns(_ENABLE_S)
        sent: dict[str, tuple[State | None, int]] = {}
        while waiting := [drive for drive in drives if not _is_prepared(drive, mode)]:
            now_ns = self.clock.now_ns()
            if now_ns > deadline_ns:
                raise LinkTimeout(
                    f"{_unprepared(waiting[0])} after {_ENABLE_S:g} s", moved="no",
                    remedy="check the drive's power supply, its enable and emergency stop inputs",
                )  # fmt: skip
            self.refuse_after_stop(stops)
            for drive in waiting:
                self._lead_on(drive, sent, now_ns)
            self._pause()
            self.look()
            self._check()
        for drive in drives:
            drive.watch.enabled()

    def _lead_on(self, drive: Drive, sent: dict[str, tuple[State | None, int]], now_ns: int) -> None:
        """Send what leads to the next state, once, and again only if nothing has come of it for a while."""
        state = None if drive.reading is None else drive.reading.state
        last_state, last_ns = sent.get(drive.axis, (None, -1))
        again = state is last_state and last_ns >= 0
        if again and now_ns - last_ns < seconds_to_ns(_RESEND_S):
            return
        if state is State.QUICK_STOP_ACTIVE and drive.watch.braking:
            return
        word = Control.ENABLE if state is State.OPERATION_ENABLED else next_control_word(state)
        if again and state is State.QUICK_STOP_ACTIVE:
            word = Control.DISABLE_VOLTAGE  # not all drives are enabled straight from here
        if word is not None:
            drive.control(word)
        sent[drive.axis] = (state, now_ns)

    def start(self, words: Mapping[str, int], stops: int) -> None:
        """Send these control words back to back.

        Raises:
            MoveCancelled: a stop was sent meanwhile; another one has followed what was started.
        """
        self.refuse_after_stop(stops)
        for axis, word in words.items():
            self.by_axis[axis].control(word)
        if self.stops != stops:
            self.stop()  # the other one may have come before the last word
            raise MoveCancelled("the move was stopped as it was being started")

    def await_acknowledgement(self, axes: Sequence[str], stops: int) -> None:
        """Wait until all drives have taken their set-points, then take the set-point bits back.

        Raises:
            ProtocolError: one has not. MoveCancelled: the stage was stopped.
        """
        deadline_ns = self.clock.now_ns() + seconds_to_ns(_ACKNOWLEDGE_S)
        waiting = [self.by_axis[axis] for axis in axes]
        while waiting:
            self.look()
            self._check()
            if self.stops != stops:
                raise MoveCancelled("the move was stopped as it began")
            waiting = [drive for drive in waiting if not _acknowledges(drive)]
            if waiting and self.clock.now_ns() > deadline_ns:
                limited = waiting[0].reading is not None and waiting[0].reading.has(Status.INTERNAL_LIMIT)
                reason = ": it says that an internal limit is active" if limited else ""
                raise ProtocolError(
                    f"{waiting[0].name} does not acknowledge its set-point{reason}",
                    remedy="check the drive's limits (607Dh, 607Fh) and its status",
                )
        for axis in axes:
            self.by_axis[axis].watch.acknowledged()
        self.start(dict.fromkeys(axes, Control.ENABLE), stops)

    def _pause(self) -> None:
        """Let the drives act; on a simulated clock nothing else happens meanwhile."""
        with self.clock.transaction():
            self.clock.sleep(_PAUSE_S)


def _is_prepared(drive: Drive, mode: int) -> bool:
    reading = drive.reading
    return (
        reading is not None
        and reading.state is State.OPERATION_ENABLED
        and reading.mode == mode
        and not (mode == objects.PROFILE_POSITION and reading.has(Status.ACKNOWLEDGED))
    )


def _acknowledges(drive: Drive) -> bool:
    reading = drive.reading
    return (
        reading is not None
        and reading.state is State.OPERATION_ENABLED
        and reading.mode == objects.PROFILE_POSITION
        and reading.has(Status.ACKNOWLEDGED)
    )


def _unprepared(drive: Drive) -> str:
    reading = drive.reading
    state = reading.state.value if reading is not None and reading.state is not None else "an unknown state"
    mode = reading.mode if reading is not None else 0
    return f"{drive.name} is not ready for a move (state: {state}, mode {mode})"
