"""What the error numbers of `ERR?` mean, which error of microdrivers each becomes, and what to do about it.

Numbers and meanings: PI MS249E, C-863.12 user manual, p. 207 ff.
"""

from __future__ import annotations

from typing import NamedTuple

from microdrivers.core.errors import (
    BusyError,
    DeviceFault,
    MicrodriversError,
    MoveCancelled,
    NotReferenced,
    OutOfRange,
    ProtocolError,
    UnsupportedError,
)

NO_ERROR = 0
MOVE_NOT_ALLOWED = 5
POSITION_OUT_OF_LIMITS = 7
STOPPED = 10
REFERENCING_FAILED = 45


class _Meaning(NamedTuple):
    error: type[MicrodriversError]
    meaning: str
    remedy: str


_REPORT = "driver and controller disagree about the command language: check that it speaks GCS 2.0, and report this"
_AXIS = "compare the axis ids in the rig file with the answer to SAI?"
_PARAMETERS = "check the controller's stage parameters (PIMikroMove), then clear_fault()"
_SERVO = "check load, obstacles, servo parameters and cable, then clear_fault()"
_EMERGENCY = "release the emergency stop once the way is free, then clear_fault() and reference()"
_WAIT = "wait until the controller has finished, then try again"
_SWITCH = "choose another reference mode (FRF, FNL, FPL) for this axis in the rig file"

_MEANINGS: dict[int, _Meaning] = {
    1: _Meaning(ProtocolError, "parameter syntax error", _REPORT),
    2: _Meaning(ProtocolError, "unknown command", _REPORT),
    3: _Meaning(ProtocolError, "command too long or buffer overrun", _REPORT),
    5: _Meaning(
        NotReferenced, "unallowed move: axis not referenced or servo off",
        "make sure that the way is free, then reference()",
    ),
    7: _Meaning(OutOfRange, "position out of limits", "choose a target between TMN? and TMX?"),
    8: _Meaning(OutOfRange, "velocity out of limits", "lower the maximum speed of the axis in the rig file"),
    10: _Meaning(
        MoveCancelled, "stopped by command",
        "somebody stopped the controller (another program, a joystick, an input): find out why, then go on",
    ),
    15: _Meaning(ProtocolError, "invalid axis identifier", _AXIS),
    16: _Meaning(DeviceFault, "unknown stage name", _PARAMETERS),
    17: _Meaning(OutOfRange, "parameter out of range", "lower speed or target of the axis in the rig file"),
    22: _Meaning(ProtocolError, "axis listed twice", _AXIS),
    23: _Meaning(ProtocolError, "illegal axis", _AXIS),
    24: _Meaning(ProtocolError, "wrong number of parameters", _REPORT),
    25: _Meaning(ProtocolError, "invalid number", _REPORT),
    26: _Meaning(ProtocolError, "parameter missing", _REPORT),
    27: _Meaning(OutOfRange, "soft limit out of range", _PARAMETERS),
    31: _Meaning(UnsupportedError, "the axis has no reference switch", _SWITCH),
    32: _Meaning(UnsupportedError, "the axis has no limit switches", _SWITCH),
    34: _Meaning(UnsupportedError, "command not allowed for this stage", _PARAMETERS),
    45: _Meaning(DeviceFault, "referencing failed", _SERVO),
    49: _Meaning(DeviceFault, "move to the limit switch failed", _SERVO),
    50: _Meaning(DeviceFault, "reference move while the reference mode is off", "once more reference()"),
    51: _Meaning(BusyError, "the axis is under joystick control", "switch the joystick off"),
    53: _Meaning(BusyError, "a dynamic move is in process", _WAIT),
    54: _Meaning(ProtocolError, "unknown parameter", _REPORT),
    60: _Meaning(UnsupportedError, "protected by a password", _PARAMETERS),
    63: _Meaning(BusyError, "the controller initialises itself", _WAIT),
    200: _Meaning(DeviceFault, "no stage connected", "connect the stage with the controller switched off"),
    205: _Meaning(ProtocolError, "not allowed while the servo is on", _REPORT),
    216: _Meaning(DeviceFault, "the axis is on a limit switch", _SERVO),
    304: _Meaning(ProtocolError, "receive buffer overflow", "check that one program uses the line"),
    307: _Meaning(ProtocolError, "receive timeout", "check the cable, and that one program uses the line"),
    500: _Meaning(DeviceFault, "emergency stop", _EMERGENCY),
    501: _Meaning(DeviceFault, "emergency stop", _EMERGENCY),
    504: _Meaning(DeviceFault, "following error: the axis could not follow its set-point", _SERVO),
    505: _Meaning(DeviceFault, "sensor signal invalid", "check encoder and stage cable, then clear_fault()"),
    506: _Meaning(DeviceFault, "servo loop unstable", _SERVO),
    555: _Meaning(DeviceFault, "unknown error of the controller", "switch it off and on, then reference()"),
    1005: _Meaning(DeviceFault, "controller busy", _WAIT),
    1008: _Meaning(BusyError, "a macro is running", "stop the controller's macro, then try again"),
}  # fmt: skip

_UNLISTED = _Meaning(
    DeviceFault, "a number that is not in this driver's table", "look it up in the controller's manual"
)
_NEGATIVE = _Meaning(
    ProtocolError, "a code of PI's PC library, which no controller sends", "check what is behind the port"
)


def meaning_of(code: int) -> str:
    """The controller's error number in words."""
    return _entry(code).meaning


def is_fault(code: int) -> bool:
    """Whether the number stands for a fault of the device, not for a refused command."""
    return code != NO_ERROR and _entry(code).error is DeviceFault


def error_from(code: int, *, sent: bytes = b"") -> MicrodriversError:
    """The error, ready to be raised, that an answer to `ERR?` stands for.

    Args:
        code: the number, not 0.
        sent: the request that it answers, if any.
    """
    entry = _entry(code)
    answered = f" to {sent!r}" if sent else ""
    what = f"the controller reports error {code}{answered}: {entry.meaning}"
    if entry.error is ProtocolError:
        return ProtocolError(
            f"the controller reports error {code}: {entry.meaning}",
            sent=sent, received=b"%d\n" % code, remedy=entry.remedy,
        )  # fmt: skip
    if entry.error is DeviceFault:
        return DeviceFault(what, code=code, text=entry.meaning, remedy=entry.remedy)
    if entry.error is MoveCancelled:
        return MoveCancelled(what, remedy=entry.remedy, moved="maybe")
    return entry.error(what, remedy=entry.remedy)


def _entry(code: int) -> _Meaning:
    return _NEGATIVE if code < 0 else _MEANINGS.get(code, _UNLISTED)
