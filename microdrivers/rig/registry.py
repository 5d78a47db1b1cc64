"""Finds drivers, emulators and worlds among the installed entry points."""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from microdrivers.core.errors import UnsupportedError
from microdrivers.devices.drivers import Driver, Emulator, WorldType

LoadedT = TypeVar("LoadedT")


@cache
def _group(group: str) -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=group)}


def known_drivers() -> list[str]:
    """Names of all installed drivers."""
    return sorted(_group("microdrivers.drivers"))


def find_driver(name: str) -> Driver[Any] | None:
    """The driver of that name, if it is installed."""
    return _load("microdrivers.drivers", name, Driver)


def find_emulator(driver_name: str) -> Emulator | None:
    """The emulator of that driver's device, if there is one."""
    return _load("microdrivers.emulators", driver_name, Emulator)


def find_world(name: str) -> WorldType[Any] | None:
    """The world of that name, if it is installed."""
    return _load("microdrivers.worlds", name, WorldType)


def _load(group: str, name: str, expected: type[LoadedT]) -> LoadedT | None:
    entry = _group(group).get(name)
    if entry is None:
        return None
    loaded: object = entry.load()
    if not isinstance(loaded, expected):
        raise UnsupportedError(
            f"entry point {name!r} of {group} is a {type(loaded).__name__}, not a {expected.__name__}",
            remedy=f"report it to the authors of {entry.value.partition(':')[0]}",
        )
    return loaded
