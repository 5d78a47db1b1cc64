"""Every error that microdrivers raises on purpose: what happened, to which device, what to do next.

One small hierarchy. `moved` tells whether hardware may have moved because of the refused or failed call: a
`RefusedError` promises that nothing did.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

Moved = Literal["no", "maybe", "yes"]


class MicrodriversError(Exception):
    """Root of all errors raised on purpose.

    Args:
        what: what happened, in one sentence, with values and units.
        remedy: what the user can do about it.
        device: name of the device in the rig file, where there is one.
        moved: whether hardware moved because of the call that failed.
    """

    default_moved: Moved = "no"

    def __init__(self, what: str, *, remedy: str = "", device: str = "", moved: Moved | None = None) -> None:
        super().__init__(what)
        self.what = what
        self.remedy = remedy
        self.device = device
        self.moved: Moved = moved if moved is not None else self.default_moved

    def __str__(self) -> str:
        where = f"{self.device}: " if self.device else ""
        todo = f"\n  to do: {self.remedy}" if self.remedy else ""
        return f"{where}{self.what}{todo}"


class ConfigError(MicrodriversError):
    """A rig, world or data file is wrong. Carries the place: file, line and column (1-based) and the key."""

    def __init__(
        self, what: str, *, remedy: str = "", file: str = "", line: int = 0, column: int = 0, key: str = ""
    ) -> None:
        super().__init__(what, remedy=remedy)
        self.file = file
        self.line = line
        self.column = column
        self.key = key

    def __str__(self) -> str:
        place = ":".join(str(part) for part in (self.file, self.line, self.column) if part)
        key = f"{self.key}: " if self.key else ""
        todo = f"\n  to do: {self.remedy}" if self.remedy else ""
        return f"{place + ': ' if place else ''}{key}{self.what}{todo}"


class ErrorTree(MicrodriversError):
    """Several failures at once, each kept whole in `errors`."""

    def __init__(self, what: str, errors: Sequence[MicrodriversError], *, remedy: str = "") -> None:
        super().__init__(what, remedy=remedy)
        self.errors = tuple(errors)

    def __str__(self) -> str:
        lines = [self.what]
        for error in self.errors:
            first, *rest = str(error).splitlines()
            lines.append(f"  - {first}")
            lines.extend(f"    {line}" for line in rest)
        if self.remedy:
            lines.append(f"  to do: {self.remedy}")
        return "\n".join(lines)


class ConfigErrors(ErrorTree, ConfigError):
    """All mistakes of one configuration file."""

    def __init__(self, what: str, errors: Sequence[ConfigError], *, remedy: str = "") -> None:
        ErrorTree.__init__(self, what, errors, remedy=remedy)
        first = errors[0]
        self.file, self.line, self.column, self.key = first.file, first.line, first.column, first.key


class ConnectError(ErrorTree):
    """One or more devices could not be opened; `errors` holds every failure."""


class LinkError(MicrodriversError):
    """The exchange with a device failed; whether a command was carried out is not known."""

    default_moved: Moved = "maybe"


class LinkTimeout(LinkError):
    """The device did not answer in time."""


class LinkLost(LinkError):
    """The port is gone: unplugged, closed or switched off."""


class ProtocolError(LinkError):
    """The device answered something that its protocol does not allow here."""

    def __init__(
        self,
        what: str,
        *,
        sent: bytes = b"",
        received: bytes = b"",
        remedy: str = "",
        device: str = "",
        moved: Moved | None = None,
    ) -> None:
        detail = "".join(f"; {label} {data!r}" for label, data in (("sent", sent), ("received", received)) if data)
        super().__init__(what + detail, remedy=remedy, device=device, moved=moved)
        self.sent = sent
        self.received = received


class DeviceFault(MicrodriversError):
    """The device itself reports a fault, with its own code and text."""

    default_moved: Moved = "maybe"

    def __init__(
        self,
        what: str,
        *,
        code: int = 0,
        text: str = "",
        remedy: str = "",
        device: str = "",
        moved: Moved | None = None,
    ) -> None:
        super().__init__(what, remedy=remedy, device=device, moved=moved)
        self.code = code
        self.text = text


class RefusedError(MicrodriversError):
    """Refused before anything moved."""


class OutOfRange(RefusedError):
    """A value lies outside its limits or is not finite."""


class NotReferenced(RefusedError):
    """An absolute move was asked of an axis whose reference is not known."""


class BusyError(RefusedError):
    """The device is doing something that excludes the request."""


class UnsafeError(RefusedError):
    """A safety rule of the rig forbids the request."""


class UnsupportedError(RefusedError):
    """The device, its driver or this installation cannot do that."""


class MotionError(MicrodriversError):
    """A move began and did not end as asked."""

    default_moved: Moved = "yes"


class NotReached(MotionError):
    """The target was not reached in the time that the distance, speed and settling allow."""


class WrongDirection(MotionError):
    """The axis moved away from its target."""


class ReferenceLost(MotionError):
    """The reference was lost while the axis moved."""


class MoveSuperseded(MotionError):
    """A newer move replaced this one."""


class MoveCancelled(MotionError):
    """The move was stopped or cancelled."""


class DataError(MicrodriversError):
    """The data does not allow what was asked."""


class StaleData(DataError):
    """The newest sample is older than allowed."""


class SaturatedData(DataError):
    """The sensor is at the end of its range."""


class TargetLost(DataError):
    """The target is not, or not wholly, in view."""


class NoContact(DataError):
    """The tool met nothing, or the record shows no contact."""


class CalibrationError(MicrodriversError):
    """A calibration cannot be computed or used."""


class StaleCalibration(CalibrationError):
    """The calibration belongs to other settings (camera, binning, ROI, objective, zoom)."""


class IllConditioned(CalibrationError):
    """The measurements do not determine the parameters."""
