"""Alarms of an AZ drive and its communication error codes (Oriental Motor HP-5142E)."""

from __future__ import annotations

from microdrivers.fakes.modbus import ModbusException
from microdrivers.fakes.modbus.functions import ILLEGAL_VALUE, SLAVE_FAILURE

COORDINATES_UNKNOWN = 0x4A
OUTSIDE_SOFTWARE_LIMITS = 0x67
BAD_OPERATION_DATA = 0x70
RS485_ERROR = 0x84
RS485_TIMEOUT = 0x85

# RS-485 error above is a communication error code as well.
UNDEFINED_COMMAND = 0x88
NV_MEMORY_BUSY = 0x8A
OUT_OF_RANGE = 0x8C
NOT_EXECUTABLE = 0x8D

_UNTIL_POWER_OFF = frozenset({0x20, 0x28, 0x41, 0x42, 0xF0})


class DriveError(ModbusException):
    """Exception 04, for a reason that register 00ACh tells."""

    def __init__(self, error: int) -> None:
        super().__init__(SLAVE_FAILURE)
        self.error = error


def communication_error(exception: ModbusException) -> int:
    """The drive's own code for the refusal of a request."""
    if isinstance(exception, DriveError):
        return exception.error
    return OUT_OF_RANGE if exception.code == ILLEGAL_VALUE else UNDEFINED_COMMAND


class Alarms:
    """The present alarm, 0 if there is none, and the newest ones, the newest first."""

    def __init__(self, kept: int) -> None:
        self.present = 0
        self.history = [0] * kept

    def happen(self, code: int) -> bool:
        """Note an alarm; a present one stays the first. Tells whether this one is new."""
        if self.present:
            return False
        self.present = code
        self.history = [code, *self.history[:-1]]
        return True

    def reset(self) -> bool:
        """End the present alarm, unless only switching off does; tells whether one ended."""
        if not self.present or self.present in _UNTIL_POWER_OFF:
            return False
        self.present = 0
        return True

    def switch_off(self) -> None:
        """Without power there is no alarm; the history stays."""
        self.present = 0

    def clear_history(self) -> None:
        """Forget what happened before."""
        self.history = [0] * len(self.history)
