"""Rig files and worlds that ship with the package."""

from importlib.resources import files
from pathlib import Path


def shipped_rig(name: str = "workstation") -> Path:
    """Path of a rig file that ships with the package."""
    return Path(str(files(__name__))) / f"{name}.yaml"
