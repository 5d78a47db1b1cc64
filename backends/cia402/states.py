"""Status word, control word and the states of a drive (CiA 402-2)."""

from __future__ import annotations

from enum import Enum


class State(Enum):
    """State of the power drive system."""

    NOT_READY = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    OPERATION_ENABLED = "operation enabled"
    QUICK_STOP_ACTIVE = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"


class Status:
    """Bits of the status word beside the state; what bits 12 and 13 mean depends on the mode."""

    WARNING = 1 << 7
    REMOTE = 1 << 9
    TARGET_REACHED = 1 << 10
    INTERNAL_LIMIT = 1 << 11
    ACKNOWLEDGED = 1 << 12
    HOMED = 1 << 12
    FOLLOWING_ERROR = 1 << 13
    HOMING_ERROR = 1 << 13


class Control:
    """Values of the control word."""

    DISABLE_VOLTAGE = 0x0000
    QUICK_STOP = 0x0002
    SHUTDOWN = 0x0006
    SWITCH_ON = 0x0007
    ENABLE = 0x000F
    NEW_SET_POINT = 0x003F
    """Bit 4 takes the target over, bit 5 at once: a move under way is replaced."""
    START_HOMING = 0x001F
    FAULT_RESET = 0x0080


_WITHOUT_QUICK_STOP_BIT = {
    0x00: State.NOT_READY,
    0x40: State.SWITCH_ON_DISABLED,
    0x0F: State.FAULT_REACTION,
    0x08: State.FAULT,
}
_WITH_QUICK_STOP_BIT = {
    0x21: State.READY,
    0x23: State.SWITCHED_ON,
    0x27: State.OPERATION_ENABLED,
    0x07: State.QUICK_STOP_ACTIVE,
}


_STATES = tuple(_WITH_QUICK_STOP_BIT.get(word) or _WITHOUT_QUICK_STOP_BIT.get(word & 0x4F) for word in range(0x70))
"""By the bits of the status word that matter; some numbers cannot come up."""


def state_of(status_word: int) -> State | None:
    """The state that a status word shows; None if it shows none."""
    return _STATES[status_word & 0x6F]


def next_control_word(state: State | None) -> int | None:
    """What leads one step nearer to operation enabled; None if that is reached, or nothing leads there from here.

    Out of quick stop active the operation is enabled again, which not all drives do; then the voltage has to be
    disabled first.
    """
    return {
        State.SWITCH_ON_DISABLED: Control.SHUTDOWN,
        State.READY: Control.SWITCH_ON,
        State.SWITCHED_ON: Control.ENABLE,
        State.QUICK_STOP_ACTIVE: Control.ENABLE,
    }.get(state) if state is not None else None  # fmt: skip
