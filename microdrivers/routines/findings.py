"""What a check of a rig finds: facts, warnings and problems, each with what to try."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import msgspec

from microdrivers.core.errors import MicrodriversError
from microdrivers.devices.base import DeviceInfo
from microdrivers.routines.commands import as_commands

Level = Literal["ok", "warning", "problem"]


class Finding(msgspec.Struct, frozen=True):
    """One finding; `remedy` is empty if all is well."""

    level: Level
    what: str
    remedy: str = ""


class Found(msgspec.Struct, kw_only=True):
    """What was found; `figures` holds what was measured, units in the names."""

    name: str
    findings: list[Finding] = msgspec.field(default_factory=list)
    figures: dict[str, Any] = msgspec.field(default_factory=dict)

    def ok(self, what: str) -> None:
        """As it should be."""
        self.findings.append(Finding("ok", what))

    def warn(self, what: str, remedy: str) -> None:
        """Usable, with a consequence that the user should know."""
        self.findings.append(Finding("warning", what, remedy))

    def problem(self, what: str, remedy: str) -> None:
        """Not usable as it is."""
        self.findings.append(Finding("problem", what, remedy))

    def failed(self, error: MicrodriversError, doing: str = "") -> None:
        """An error as a problem."""
        self.problem(f"{doing}: {error.what}" if doing else error.what, error.remedy)

    def say_commands(self, file: Path) -> None:
        """Say the remedies in the commands of the terminal, for the rig in that file."""
        self.findings = [
            msgspec.structs.replace(each, remedy=as_commands(each.remedy, file, self.name)) for each in self.findings
        ]

    def judge(self, good: bool, what: str, remedy: str) -> None:
        """OK or a warning."""
        if good:
            self.ok(what)
        else:
            self.warn(what, remedy)


class DeviceDiagnosis(Found, kw_only=True):
    """What was found of one device."""

    driver: str
    info: DeviceInfo | None = None


class BusDiagnosis(Found, kw_only=True):
    """What was found of a bus that these devices share."""

    devices: list[str]


class Diagnosis(msgspec.Struct, kw_only=True):
    """What was found of a whole rig."""

    rig: str
    file: str
    fake: bool
    clock: Literal["simulated", "system"]
    devices: list[DeviceDiagnosis]
    buses: list[BusDiagnosis] = msgspec.field(default_factory=list)

    def count(self, level: Level) -> int:
        """Findings of a level."""
        return sum(finding.level == level for part in (*self.devices, *self.buses) for finding in part.findings)
