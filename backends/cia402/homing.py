"""Finding the reference of one axis, by the drive's own homing mode."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence

from microdrivers.backends.cia402 import objects
from microdrivers.backends.cia402.axis_watch import Reading
from microdrivers.backends.cia402.drive import Drive
from microdrivers.backends.cia402.drives import Drives
from microdrivers.backends.cia402.states import Control, State, Status
from microdrivers.core.clock import Clock
from microdrivers.core.errors import DeviceFault, LinkError, MoveCancelled, NotReached, UnsafeError
from microdrivers.core.units import seconds_to_ns

_POLL_S = 0.02
_BEGIN_S = 0.3
"""How long a drive may go on showing the end of its last search, or that of none, after a new one has begun."""


def refuse_other_order(axes: Sequence[str], *, order: Sequence[str], referenced: Mapping[str, bool]) -> None:
    """Let pass only if every axis that comes before these in the rig file is referenced, or comes before them here too.

    Raises:
        UnsafeError: one is not.
    """
    for place, axis in enumerate(axes):
        if axis not in order:
            return  # who checks the names says so
        before = order[: order.index(axis)]
        late = [other for other in before if other in axes[place:]]
        missing = [other for other in before if not referenced[other] and other not in axes]
        if missing or late:
            raise UnsafeError(
                f"axis {axis} must not be referenced before {', '.join(missing or late)}: the rig file's "
                f"reference_order is {', '.join(order)}",
                remedy=f"reference({[other for other in order if other in {*axes, *missing}]!r})",
            )


class ReferenceSearch:
    """The search for the reference of one axis.

    Args:
        drives: of the stage.
        axis: whose reference is searched.
        clock: to wait on.
        timeout_s: how long the search may take.
        stop: stops the whole stage; is told by whom and why.
        check: raises what stands against going on: a fault, or a drive that has gone.
    """

    def __init__(
        self, drives: Drives, axis: str, *, clock: Clock, timeout_s: float, stop: Callable[[str, str], None],
        check: Callable[[], object],
    ) -> None:  # fmt: skip
        self._drives = drives
        self._drive: Drive = drives.by_axis[axis]
        self._clock = clock
        self._timeout_s = timeout_s
        self._stop = stop
        self._check = check

    def run(self) -> None:
        """Move the axis as its homing method says, and return when the drive knows its reference.

        Raises:
            DeviceFault: the drive is at fault, or has not found its reference.
            MoveCancelled: it was stopped. NotReached: it took too long, and was stopped.
        """
        drives, drive = self._drives, self._drive
        stops = drives.stops
        drives.prepare([drive.axis], objects.HOMING, stops)
        drive.referenced = False
        drive.watch.homing()
        try:
            drives.start({drive.axis: Control.START_HOMING}, stops)
            self._await_end(stops)
        except MoveCancelled as cancelled:
            raise self._cancelled() from cancelled
        except (DeviceFault, LinkError):
            with contextlib.suppress(LinkError):
                self._stop("driver", f"axis {drive.axis} did not find its reference")
            raise
        drive.control(Control.ENABLE)  # takes the start bit back: the next search needs its edge
        drive.watch.homed()
        drive.referenced = True

    def _await_end(self, stops: int) -> None:
        drive, clock = self._drive, self._clock
        begun_ns = clock.now_ns()
        idle_since_ns: int | None = begun_ns
        while True:
            self._drives.look()
            self._check()
            if self._drives.stops != stops:
                raise self._cancelled()
            now_ns, reading = clock.now_ns(), drive.reading
            if reading is not None and reading.mode == objects.HOMING:
                self._refuse_error(reading)
                running = not reading.has(Status.TARGET_REACHED)
                attained = reading.has(Status.HOMED)
                if running:
                    idle_since_ns = None
                elif idle_since_ns is None and attained:
                    return
                elif idle_since_ns is None:
                    idle_since_ns = now_ns
                elif now_ns - idle_since_ns > seconds_to_ns(_BEGIN_S):
                    if attained:  # a method that does not move has nothing to show in between
                        return
                    raise self._not_found("the drive has given the search up")
            if now_ns - begun_ns > seconds_to_ns(self._timeout_s):
                self._stop("supervision", f"axis {drive.axis} did not find its reference")
                raise NotReached(
                    f"{drive.name} has not found its reference in {self._timeout_s:g} s; stopped",
                    remedy="check the switches and the way, or allow more reference_timeout_s in the rig file",
                )
            clock.sleep(_POLL_S)

    def _refuse_error(self, reading: Reading) -> None:
        if reading.has(Status.HOMING_ERROR):
            raise self._not_found("the drive reports a homing error")
        if reading.state is not State.OPERATION_ENABLED:
            raise self._not_found(f"the drive is in {reading.state.value if reading.state else 'an unknown state'}")

    def _not_found(self, why: str) -> DeviceFault:
        method = self._drive.settings.homing_method
        return DeviceFault(
            f"{self._drive.name} has not found its reference (homing method {method}): {why}", moved="yes",
            remedy="check the switches, the way, and homing_method of the axis in the rig file; then clear_fault()",
        )  # fmt: skip

    def _cancelled(self) -> MoveCancelled:
        return MoveCancelled(
            f"the reference search of {self._drive.name} was stopped",
            remedy=f"check why the stop was requested, then reference([{self._drive.axis!r}])",
        )
