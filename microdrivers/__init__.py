"""Devices, wire-faithful fakes and on-line estimators for a micromanipulation rig."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from microdrivers.rig import open_rig

__all__ = ["open_rig"]
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """Import what needs pydantic only when it is used, so that `microdrivers --help` stays quick."""
    if name == "open_rig":
        from microdrivers.rig import open_rig

        return open_rig
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
