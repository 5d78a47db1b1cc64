"""Faults reset and power stages switched off: what the stage does at rest."""

from __future__ import annotations

from microdrivers.backends.cia402.axis_watch import REST_NS
from microdrivers.backends.cia402.drive import Drive
from microdrivers.backends.cia402.drives import Drives
from microdrivers.backends.cia402.set_up import release
from microdrivers.backends.cia402.states import Control, State
from microdrivers.core.clock import Clock
from microdrivers.core.errors import DeviceFault, MicrodriversError
from microdrivers.core.units import NS_PER_S, seconds_to_ns

_REST_S = 1.0
_BLIND_REST_S = 0.3
_FAULT_RESET_S = 1.0


def rest(clock: Clock) -> None:
    """Wait until an axis that stands has been seen to: on a simulated clock nothing else happens meanwhile."""
    with clock.transaction():
        clock.sleep(1.1 * REST_NS / NS_PER_S)


def switch_off(drives: Drives) -> None:
    """Stop what moves, power off at rest, and have the drives not take our leaving for a fault.

    While their PDOs are not listened for, opening is under way: no power stage is on, and a drive cannot be looked at.

    Raises:
        LinkError: a drive does not answer; the others are off.
    """
    there = [drive for drive in drives.all if drive.watches_us and drive.node.alive]
    if not there:
        return
    failure: MicrodriversError | None = None
    try:
        if drives.pdos.listening:
            _come_to_rest(drives)
    except MicrodriversError as error:
        failure = error
        drives.stop()
        drives.clock.sleep(_BLIND_REST_S)
    for drive in there:
        drive.control(Control.DISABLE_VOLTAGE)
    for drive in there:
        try:
            release(drive)
        except MicrodriversError as error:
            failure = error
    if failure is not None:
        raise failure


def _come_to_rest(drives: Drives) -> None:
    deadline_ns = drives.clock.now_ns() + seconds_to_ns(_REST_S)
    drives.look()
    if any(drive.watch.moving and not drive.watch.braking for drive in drives.all):
        drives.stop()
    while any(drive.watch.moving for drive in drives.all) and drives.clock.now_ns() < deadline_ns:
        rest(drives.clock)
        drives.look()


def reset_faults(drives: Drives) -> None:
    """Reset all drives that are at fault; none is enabled.

    Raises:
        DeviceFault: the cause is still there. LinkError: a drive does not answer.
    """
    drives.look()
    faulty = [drive for drive in drives.all if _at_fault(drive)]
    for drive in faulty:
        drive.control(Control.DISABLE_VOLTAGE)
        drive.control(Control.FAULT_RESET)  # the bit's edge counts
    deadline_ns = drives.clock.now_ns() + seconds_to_ns(_FAULT_RESET_S)
    while still := [drive for drive in faulty if _at_fault(drive)]:
        if drives.clock.now_ns() > deadline_ns:
            raise DeviceFault(
                f"the fault of {still[0].name} cannot be cleared: its cause is still there", moved="no",
                remedy="remove the cause, or switch the drive off and on",
            )  # fmt: skip
        rest(drives.clock)
        drives.look()
    for drive in faulty:
        drive.control(Control.DISABLE_VOLTAGE)
    for drive in drives.all:
        if drive.reading is None or drive.reading.state is not State.OPERATION_ENABLED:
            drive.watch.switched_off()


def _at_fault(drive: Drive) -> bool:
    return drive.reading is not None and drive.reading.at_fault
