"""What a drive is asked and told when the stage is opened, and again after it has restarted.

Nothing here moves an axis or switches a power stage on.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from typing import Any

from microdrivers.backends.canopen.aborts import SdoAbort
from microdrivers.backends.canopen.heartbeat import HOST_NODE_ID, NmtCommand, NmtState
from microdrivers.backends.canopen.node import Identity
from microdrivers.backends.canopen.objects import Entry
from microdrivers.backends.canopen.pdo import PDOS, configure_rpdo, configure_tpdo, disable_tpdo
from microdrivers.backends.cia402 import objects
from microdrivers.backends.cia402.drive import CONTROL_MAPPING, STATUS_MAPPING, Drive
from microdrivers.backends.cia402.states import Control, State, Status, state_of
from microdrivers.core.clock import Clock
from microdrivers.core.errors import BusyError, ConfigError, LinkTimeout, ProtocolError
from microdrivers.core.units import seconds_to_ns
from microdrivers.devices.base import DeviceInfo

HOLD_POSITION_AFTER_QUICK_STOP = 6
"""Option code: brake with the quick stop ramp, then stay in quick stop active."""

MISSED_HEARTBEATS = 1.5
"""After so many intervals without one a heartbeat is missed; looked at four times an interval, within 2 in all."""

HEARTBEATS_A_TIMEOUT = 4
"""So many of ours come in the time that drives allow for one: a busy computer may be three quarters of it late."""

_POLL_S = 0.01
_STATE_S = 1.0
_STANDSTILL_S = 0.02
_STANDSTILL_COUNTS = 2
_WINDOW_MS = 5

_SETTLED_STATES = (State.SWITCH_ON_DISABLED, State.READY, State.FAULT)

_log = logging.getLogger(__name__)


def identify_all(drives: Sequence[Drive], *, device: str) -> list[Identity]:
    """Ask all drives of a device, so that all that are missing can be named at once; errors as `identify`."""
    found: list[Identity] = []
    silent: dict[str, LinkTimeout] = {}
    for drive in drives:
        try:
            found.append(identify(drive, key=f"{device}.axes.{drive.axis}"))
        except LinkTimeout as error:
            silent[drive.name] = error
    if silent:
        last = list(silent.values())[-1]  # by then, the line knows most of what may be to blame
        if len(silent) > 1:
            last.what = f"{', '.join(silent)} do not answer; the last of them: {last.what}"
        raise last
    return found


def describe(found: Sequence[Identity], *, driver: str) -> DeviceInfo:
    """What the drives say of themselves: once where all say the same, else in the order of the axes."""

    def join(texts: Iterable[str]) -> str:
        all_texts = tuple(texts)
        return all_texts[0] if len(set(all_texts)) == 1 else "/".join(all_texts)

    return DeviceInfo(
        driver=driver,
        vendor=join(f"{each.vendor:08X}h" for each in found),
        model=join(each.name or f"{each.product:08X}h" for each in found),
        serial_number="/".join(str(each.serial_number) for each in found),
        firmware=join(each.software for each in found),
    )


def identify(drive: Drive, *, key: str) -> Identity:
    """Ask the drive who it is, and whether it can do what the rig file wants.

    Raises:
        LinkTimeout: nobody answers. ProtocolError: another device does.
        ConfigError: another node has the same id; or it is slower than the rig file says.
    """
    drive.node.require_alone(key=f"{key}.node_id")
    sdo, identity = drive.node.sdo, drive.node.identify()
    if identity.profile != objects.PROFILE_NUMBER:
        raise ProtocolError(
            f"{drive.name} is another device: its type is {identity.device_type:08X}h, profile {identity.profile}, "
            f"not {objects.PROFILE_NUMBER} (drives)", remedy="check node_id in the rig file and the node's switches",
        )  # fmt: skip
    modes = sdo.read_optional(objects.SUPPORTED_MODES)
    for mode, what in ((objects.PROFILE_POSITION, "profile position"), (objects.HOMING, "homing")):
        if modes is not None and not modes >> (mode - 1) & 1:
            raise ProtocolError(
                f"{drive.name} has no {what} mode (its modes are {modes:X}h)", remedy="use another drive"
            )
    fastest = sdo.read_optional(objects.MAX_PROFILE_VELOCITY)
    wanted = drive.map.rate(drive.map.spec.max_speed)
    if fastest is not None and 0 < fastest < wanted:
        raise ConfigError(
            f"{drive.name} allows {fastest / drive.map.counts_per_um:g} µm/s ({objects.MAX_PROFILE_VELOCITY}), "
            f"the rig file {drive.map.spec.max_speed:g} µm/s", key=f"{key}.max_speed_um_s",
            remedy="lower it, or raise the drive's: a path would not be straight",
        )  # fmt: skip
    return identity


def set_up(drive: Drive, *, heartbeat_ms: int, clock: Clock) -> None:
    """Switch its power stage off if it is on, write limits and PDOs, find out about its reference, start its PDOs.

    Raises:
        BusyError: it moves. SdoAbort: it refuses something that is needed. LinkError: see `SdoClient`.
    """
    boots, node = drive.boots, drive.node
    drive.forget()
    if node.state == NmtState.STOPPED:  # it would not answer
        node.command(NmtCommand.PRE_OPERATIONAL)
    _await_rest(drive, clock)
    node.command(NmtCommand.PRE_OPERATIONAL)
    _switch_off(drive, clock)
    _write_limits(drive)
    _write_homing(drive)
    _write_if_possible(drive, objects.QUICK_STOP_OPTION, HOLD_POSITION_AFTER_QUICK_STOP)
    _write_if_possible(drive, objects.POSITION_WINDOW, max(1, drive.map.tolerance))
    _write_if_possible(drive, objects.POSITION_WINDOW_TIME, _WINDOW_MS)
    for number in range(2, PDOS + 1):
        disable_tpdo(node.sdo, number)
    configure_rpdo(node.sdo, 1, drive.control_id, CONTROL_MAPPING)
    configure_tpdo(node.sdo, 1, drive.status_id, STATUS_MAPPING)
    drive.referenced = _knows_its_reference(drive, clock)
    drive.watches_us = True
    node.consume_heartbeat(HOST_NODE_ID, heartbeat_ms)
    node.command(NmtCommand.START)
    node.produce_heartbeat(heartbeat_ms, timeout_s=MISSED_HEARTBEATS * heartbeat_ms / 1000)
    drive.ready = drive.boots == boots


def release(drive: Drive) -> None:
    """Have it stop watching our heartbeat and sending PDOs; its power stage is switched off already."""
    drive.forget()
    drive.node.command(NmtCommand.PRE_OPERATIONAL)  # first: the answers behind it show that it was heard
    drive.node.consume_heartbeat(HOST_NODE_ID, 0)
    drive.node.produce_heartbeat(0, timeout_s=0)


def _await_rest(drive: Drive, clock: Clock) -> None:
    """A drive that moves was left moving by somebody else, or brakes because we have gone."""
    sdo = drive.node.sdo
    deadline_ns = clock.now_ns() + seconds_to_ns(_STATE_S)
    last = sdo.read(objects.POSITION)
    while state_of(sdo.read(objects.STATUS_WORD)) not in _SETTLED_STATES:
        clock.sleep(_STANDSTILL_S)
        position = sdo.read(objects.POSITION)
        if abs(position - last) <= _STANDSTILL_COUNTS:
            return
        if clock.now_ns() > deadline_ns:
            raise BusyError(
                f"{drive.name} is moving", remedy="find out who moves it; `microdrivers stop` stops it, also unopened"
            )
        last = position


def _switch_off(drive: Drive, clock: Clock) -> None:
    """Out of any state into one in which limits may be written. A fault stays: it is cleared on request only."""
    sdo = drive.node.sdo
    deadline_ns = clock.now_ns() + seconds_to_ns(_STATE_S)
    while (state := state_of(sdo.read(objects.STATUS_WORD))) not in _SETTLED_STATES:
        if clock.now_ns() > deadline_ns:
            raise ProtocolError(
                f"{drive.name} does not switch its power stage off; it is in {state.value if state else 'no state'}",
                remedy="switch the drive off and on",
            )
        if state in (State.OPERATION_ENABLED, State.SWITCHED_ON):
            sdo.write(objects.CONTROL_WORD, Control.SHUTDOWN)
        elif state is State.QUICK_STOP_ACTIVE:
            sdo.write(objects.CONTROL_WORD, Control.DISABLE_VOLTAGE)
        clock.sleep(_POLL_S)


def _write_limits(drive: Drive) -> None:
    """Have the drive refuse what lies outside the travel, and see that it does.

    It compares positions with limit − home offset (HP-5143E).
    """
    sdo = drive.node.sdo
    offset = sdo.read_optional(objects.HOME_OFFSET) or 0
    low = (objects.MIN_POSITION_LIMIT, drive.map.lowest + offset)
    high = (objects.MAX_POSITION_LIMIT, drive.map.highest + offset)
    rises = low[1] <= sdo.read(objects.MAX_POSITION_LIMIT)
    for entry, limit in (low, high) if rises else (high, low):  # never the lower limit above the higher one
        sdo.write(entry, limit)
        found = sdo.read(entry)
        if found != limit:
            raise ProtocolError(
                f"{drive.name} has taken {found} for {entry}, not {limit}: it would not keep to its travel",
                remedy="check the drive's limits, home offset and units",
            )


def _write_homing(drive: Drive) -> None:
    sdo, settings = drive.node.sdo, drive.settings
    sdo.write(objects.HOMING_METHOD, settings.homing_method)
    if settings.homing_speeds_um_s is not None:
        to_switch, to_zero = settings.homing_speeds_um_s
        sdo.write(objects.HOMING_SPEED_SWITCH, drive.map.rate(to_switch))
        sdo.write(objects.HOMING_SPEED_ZERO, drive.map.rate(to_zero))


def _write_if_possible(drive: Drive, entry: Entry[Any], value: int) -> None:
    """Some drives do without; what then differs is said where it matters."""
    try:
        drive.node.sdo.write(entry, value)
    except SdoAbort as abort:
        _log.info("%s keeps its own %s: %s", drive.name, entry, abort.what)


def _knows_its_reference(drive: Drive, clock: Clock) -> bool:
    """In homing mode the status word says whether the reference has been found since power-on. The drive is off."""
    sdo = drive.node.sdo
    drive.set_mode(objects.HOMING)
    deadline_ns = clock.now_ns() + seconds_to_ns(_STATE_S / 5)
    while sdo.read(objects.MODE_DISPLAY) != objects.HOMING:
        if clock.now_ns() > deadline_ns:
            return False
        clock.sleep(_POLL_S)
    word = sdo.read(objects.STATUS_WORD)
    return bool(word & Status.HOMED) and not word & Status.HOMING_ERROR
