"""Error numbers of GCS 2.0 and the exception that carries one through a command."""

from __future__ import annotations

from enum import IntEnum


class ErrorCode(IntEnum):
    """What `ERR?` reports (PI manual MS249E, list of error codes); a controller never sends a negative number."""

    NONE = 0
    PARAMETER_SYNTAX = 1
    UNKNOWN_COMMAND = 2
    COMMAND_TOO_LONG = 3
    UNALLOWED_MOVE = 5
    POSITION_OUT_OF_LIMITS = 7
    VELOCITY_OUT_OF_LIMITS = 8
    STOPPED_BY_COMMAND = 10
    INVALID_AXIS_IDENTIFIER = 15
    PARAMETER_OUT_OF_RANGE = 17
    AXIS_LISTED_TWICE = 22
    WRONG_NUMBER_OF_PARAMETERS = 24
    INVALID_NUMBER = 25
    PARAMETER_MISSING = 26
    SOFT_LIMIT_OUT_OF_RANGE = 27
    NO_REFERENCE_SWITCH = 31
    NO_LIMIT_SWITCH = 32
    COMMAND_NOT_ALLOWED = 34
    REFERENCE_MODE_OFF = 50
    MOTION_IN_PROCESS = 53
    UNKNOWN_PARAMETER = 54
    INVALID_PASSWORD = 56
    PROTECTED_PARAMETER = 60
    MOTION_ERROR = 1024


class CommandError(Exception):
    """A command line that cannot run; nothing of it has run."""

    def __init__(self, code: ErrorCode) -> None:
        super().__init__(code.name)
        self.code = code
