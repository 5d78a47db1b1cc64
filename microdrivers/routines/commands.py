"""Remedies for the terminal: what an error of the library says in calls, said in commands."""

from __future__ import annotations

import ast
import re
import shlex
from pathlib import Path

from microdrivers.core.errors import ErrorTree, MicrodriversError

_CALL = re.compile(r"\b(reference|clear_fault|retract|stop|move_by)\((\[[^\]]*\]|d\w+=[^)]*)?\)")
_SHIFT = re.compile(r"d(\w+)_(um|deg)=([^,]+)")


def as_commands(remedy: str, file: Path, device: str) -> str:
    """A remedy with `clear_fault()`, `reference([…])`, `retract()`, `stop()` and `move_by(…)` replaced by commands.

    Args:
        remedy: of an error.
        file: of the rig.
        device: the one that the error is about; without it only `stop()` can be said.
    """
    rig, name = shlex.quote(str(file)), shlex.quote(device)

    def command(call: re.Match[str]) -> str:
        what, axes = call.groups()
        if what == "stop":
            return f"`microdrivers stop {rig}`"
        if not device:
            return call.group()
        if what == "reference":
            named = f" --axes {','.join(ast.literal_eval(axes))}" if axes else ""
            return f"`microdrivers reference {rig} --device {name}{named}`"
        if what == "move_by":
            options = " ".join(f"--{axis}-{unit} {way}" for axis, unit, way in _SHIFT.findall(axes or ""))
            return f"`microdrivers move {rig} {name} --by {options}`"
        if what == "retract":
            return f"`microdrivers move {rig} {name} --retract`"
        return f"`microdrivers clear-fault {rig} {name}`"

    return _CALL.sub(command, remedy)


def name_commands(error: MicrodriversError, file: Path) -> None:
    """Say the remedies of an error, and of all that it consists of, in commands."""
    error.remedy = as_commands(error.remedy, file, error.device)
    for part in error.errors if isinstance(error, ErrorTree) else ():
        name_commands(part, file)
