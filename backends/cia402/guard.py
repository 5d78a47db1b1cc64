"""Notices what drives do by themselves, stops the others, and says so: faults, restarts, silence."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from microdrivers.backends.canopen.emergency import Emergency, error_meaning
from microdrivers.backends.canopen.heartbeat import NmtState
from microdrivers.backends.cia402 import objects
from microdrivers.backends.cia402.drive import Drive
from microdrivers.backends.cia402.drives import Drives
from microdrivers.core.errors import DeviceFault, LinkError, LinkLost
from microdrivers.core.samples import EventKind

_FAULT_REMEDY = "find the cause, make sure that the way is free, then clear_fault()"

_HEARTBEAT_LOST = 0x8130
_MERE_WARNINGS = (0x8110, 0x8120, 0x8140, 0x8210, 0x8220)
"""Trouble on the bus that a drive reports and does not stop for."""

_log = logging.getLogger(__name__)


class Guard:
    """What is wrong with a stage's drives. `drives` is set once they are made.

    `emergency`, `heartbeat` and `silence` are called in the thread that receives: they take no lock and await nothing.

    Args:
        order: in which the axes are referenced.
        tell: publishes an event.
        faulted: is given each new fault, once.
        recover: has drives set up again, soon and elsewhere.

    Attributes:
        on_duty: whether the stage is open; before, drives may come and go.
    """

    drives: Drives

    def __init__(
        self, *, order: Sequence[str], tell: Callable[[EventKind, str], object],
        faulted: Callable[[DeviceFault], object], recover: Callable[[], object],
    ) -> None:  # fmt: skip
        self.on_duty = False
        self._order = order
        self._tell = tell
        self._faulted = faulted
        self._recover = recover
        self._faults: dict[str, DeviceFault] = {}
        self._to_raise: DeviceFault | None = None

    # ------------------------------------------------------------------ what comes by itself

    def emergency(self, drive: Drive, emergency: Emergency) -> None:
        """A drive has sent an emergency message."""
        if emergency.is_over:
            return
        if emergency.code in _MERE_WARNINGS:
            _log.warning("%s: %s", drive.name, emergency)
            return
        busy = self._busy if emergency.code == _HEARTBEAT_LOST else ""
        self._note(drive, f"{drive.name}: {emergency}{busy}", emergency.code, busy=bool(busy))

    def heartbeat(self, drive: Drive, state: int) -> None:
        """A drive has sent its heartbeat, or has started."""
        if state == NmtState.BOOT_UP:
            drive.boots += 1
            self._lose(drive, f"{drive.name} has restarted")
        elif drive.ready and state != NmtState.OPERATIONAL:
            self._lose(drive, f"{drive.name} has left the operational state")
        if not drive.ready and self.on_duty:
            self._recover()

    def silence(self, drive: Drive) -> None:
        """A drive's heartbeat has stopped."""
        if self.on_duty:
            self._lose(drive, f"{drive.name} is silent: its heartbeat has stopped{self.drives.line.doubts}")
            gone = [other.name for other in self.drives.all if other is drive or not other.node.alive]
            self._tell("link_lost", f"no heartbeat from {', '.join(gone)}{self.drives.line.doubts}")

    def lost(self, error: LinkLost) -> None:
        """The adapter is gone: nobody can be stopped, but drives miss our heartbeat. The stage has to be reopened."""
        for drive in self.drives.all:
            drive.forget()
        if self.on_duty:
            self._tell("link_lost", error.what)
        self.on_duty = False

    # ------------------------------------------------------------------ what readings show

    def examine(self) -> None:
        """Look at the newest readings; whether a fault is known by its code does not matter here."""
        for drive in self.drives.all:
            watch, reading = drive.watch, drive.reading
            if not (watch.at_fault or watch.dropped) or reading is None or drive.axis in self._faults:
                continue
            if watch.at_fault:
                self._note(drive, f"{drive.name} is at fault", 0)
            else:
                state = reading.state.value if reading.state else "an unknown state"
                self._note(drive, f"{drive.name} has left operation enabled by itself: it is in {state}", 0)

    def explain(self) -> None:
        """Ask drives for the code of a fault that no emergency message has explained."""
        for axis, fault in tuple(self._faults.items()):
            drive = self.drives.by_axis[axis]
            if fault.code or not (drive.ready and drive.reading is not None and drive.reading.at_fault):
                continue
            code = drive.node.sdo.read_optional(objects.ERROR_CODE)
            if code:
                _explain(fault, f"{drive.name}: {error_meaning(code)} (error code {code:04X}h)", code)

    # ------------------------------------------------------------------ what stands against a call

    @property
    def at_fault(self) -> bool:
        """Whether there is a fault that nobody has cleared."""
        return bool(self._faults)

    def raise_new(self) -> None:
        """Raise a fault that no caller has been told of.

        Raises:
            DeviceFault: there is one.
        """
        fault, self._to_raise = self._to_raise, None
        if fault is not None:
            raise fault

    def refuse(self) -> None:
        """Let pass only if all drives are there and sound.

        Raises:
            DeviceFault: one is at fault. LinkLost: one has restarted, or is silent.
        """
        self.examine()
        if self._faults:
            self._to_raise = None
            raise next(iter(self._faults.values()))
        self.require_alive()
        restarted = [drive.name for drive in self.drives.all if not drive.ready]
        if restarted:
            drives = (self.drives.by_axis[axis] for axis in self._order)
            unknown = [drive.axis for drive in drives if not (drive.ready and drive.referenced)]
            raise LinkLost(
                f"{', '.join(restarted)} {'has' if len(restarted) == 1 else 'have'} restarted",
                remedy=f"make sure that the way is free, then reference({unknown!r})",
            )

    def require_alive(self) -> None:
        """Let pass only if no drive is known to be silent.

        Raises:
            LinkLost: one is.
        """
        for drive in self.drives.all:
            if not drive.node.alive:
                remedy = self.drives.line.lateness.REMEDY if self._busy else "check the drive's power and cable"
                raise LinkLost(
                    f"{drive.name} is silent: its heartbeat has stopped{self.drives.line.doubts}",
                    remedy=f"{remedy}; it is set up again when it is back",
                )

    def told(self) -> None:
        """Whoever opens the stage finds its faults there: they need not be raised."""
        self._to_raise = None

    def cleared(self) -> None:
        """The faults have been cleared."""
        self._faults.clear()
        self._to_raise = None

    # ------------------------------------------------------------------ inside

    @property
    def _busy(self) -> str:
        """What a message adds if this computer may be to blame."""
        return self.drives.line.lateness.hint(self.drives.clock.now_ns())

    def _note(self, drive: Drive, what: str, code: int, *, busy: bool = False) -> None:
        known = self._faults.get(drive.axis)
        if known is not None:
            if code and not known.code:
                _explain(known, what, code)
            return
        fault = self._faults[drive.axis] = DeviceFault(
            what, code=code, text=error_meaning(code) if code else "",
            remedy=f"{self.drives.line.lateness.REMEDY}; then clear_fault()" if busy else _FAULT_REMEDY,
        )  # fmt: skip
        self._to_raise = fault
        self._stop_others(drive, what)
        drive.watch.forget_target()
        self._faulted(fault)

    def _lose(self, drive: Drive, reason: str) -> None:
        """What a drive was told, and where it is, is no longer known."""
        was_referenced, drive.referenced = drive.referenced, False
        drive.forget()
        self._stop_others(drive, reason)
        drive.watch.ended(self.drives.clock.now_ns())
        self.drives.pdos.pause()
        if was_referenced and self.on_duty:
            self._tell("reference_lost", reason)

    def _stop_others(self, drive: Drive, reason: str) -> None:
        """A path that one axis leaves is no path; axes at rest keep their power."""
        others = [other for other in self.drives.all if other is not drive]
        if not self.on_duty or not any(other.watch.moving for other in others):
            return
        try:
            self.drives.stop()
        except LinkError as error:
            _log.error("%s; the other axes could not be stopped: %s", reason, error)
        self._tell("stopped", reason)


def _explain(fault: DeviceFault, what: str, code: int) -> None:
    fault.what, fault.code, fault.text = what, code, error_meaning(code)
