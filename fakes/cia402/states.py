"""The state machine of a drive and the words that drive it and tell of it (CiA 402-2, 7 and 8)."""

from __future__ import annotations

from enum import IntEnum


class State(IntEnum):
    """The states; the value is what they put into the status word, before `ALWAYS`."""

    NOT_READY = 0x0000
    SWITCH_ON_DISABLED = 0x0040
    READY = 0x0021
    SWITCHED_ON = 0x0023
    OPERATION_ENABLED = 0x0027
    QUICK_STOP_ACTIVE = 0x0007
    FAULT_REACTION = 0x000F
    FAULT = 0x0008


class Status:
    """Other bits of the status word, 6041h; 12 and 13 depend on the mode."""

    VOLTAGE = 1 << 4
    REMOTE = 1 << 9
    TARGET_REACHED = 1 << 10
    INTERNAL_LIMIT = 1 << 11
    ACKNOWLEDGED = HOMED = 1 << 12
    FOLLOWING_ERROR = HOMING_ERROR = 1 << 13


ALWAYS = Status.VOLTAGE | Status.REMOTE


class Control:
    """Bits of the control word, 6040h; 4 to 6 depend on the mode."""

    SWITCH_ON = 1 << 0
    ENABLE_VOLTAGE = 1 << 1
    NO_QUICK_STOP = 1 << 2
    ENABLE_OPERATION = 1 << 3
    START = 1 << 4
    IMMEDIATELY = 1 << 5
    RELATIVE = 1 << 6
    FAULT_RESET = 1 << 7
    HALT = 1 << 8


class Mode(IntEnum):
    """Modes of operation, 6060h."""

    NONE = 0
    PROFILE_POSITION = 1
    HOMING = 6


SUPPORTED_MODES = 0x21
"""6502h: profile position and homing."""

_FAULTY = (State.NOT_READY, State.FAULT_REACTION, State.FAULT)


def commanded_state(state: State, word: int) -> State:
    """Where a control word leads from a state; the state itself if it leads nowhere.

    Operation enabled may be reached from ready in one step. Faults are left with an edge, which is not seen here, and
    what becomes of a quick stop is up to 605Ah.
    """
    if state in _FAULTY:
        return state
    if not word & Control.ENABLE_VOLTAGE:
        return State.SWITCH_ON_DISABLED
    if not word & Control.NO_QUICK_STOP:
        if state in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE):
            return State.QUICK_STOP_ACTIVE
        return State.SWITCH_ON_DISABLED
    if not word & Control.SWITCH_ON:
        return state if state is State.QUICK_STOP_ACTIVE else State.READY
    if state is State.SWITCH_ON_DISABLED:
        return state
    if word & Control.ENABLE_OPERATION:
        return State.OPERATION_ENABLED
    return state if state is State.QUICK_STOP_ACTIVE else State.SWITCHED_ON
