"""Turns a rig file into its own simulator: every connection is replaced by its emulator."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.core.errors import ConfigError, UnsupportedError
from microdrivers.devices.drivers import (
    DeviceSettings,
    Emulation,
    EmulationRequest,
    Emulator,
    World,
    WorldRequest,
    WorldType,
    WorldWithEmulators,
)
from microdrivers.rig.registry import find_emulator, find_world
from microdrivers.rig.rig_file import RigDescription
from microdrivers.rig.validation import validate
from microdrivers.rig.yaml_file import Document, raise_all, read_document

DEFAULT_WORLD = "microscope"
REPLAY_WORLD = "wire-log"
_DEFAULT_FILE = Path("default world")
OVERRIDES = "world_overrides"
"""Stands for the file in errors about `world_overrides`."""


class Simulation:
    """The world and the emulators behind a rig.

    The world file is the one given, or `worlds/<rig file's name>` beside the rig file if it exists, or the default
    world's defaults; the figures of `world_overrides` stand in place of its own. With `wire_log` the world is what that
    wire log tells, and the log answers in place of the emulators.

    Raises:
        UnsupportedError: a driver has no emulator; all such devices are named.
        ConfigError: the world file or the wire log is wrong.
    """

    def __init__(
        self,
        description: RigDescription,
        *,
        clock: Clock,
        bus: Bus,
        seed: int,
        world_file: Path | None = None,
        world_overrides: Mapping[str, Any] | None = None,
        wire_log: Path | None = None,
    ) -> None:
        self._description = description
        self.seed = seed
        self.world_file = world_file or _beside(description.file)
        self._world_overrides = world_overrides or {}
        self.world = self._build_world(_replay_of(wire_log) if wire_log is not None else self._read_world(), clock, bus)
        own = self.world if isinstance(self.world, WorldWithEmulators) else None
        self.starts_anew = own.starts_anew if own is not None else True
        emulators = own.emulators if own is not None else self._find_emulators()
        self.emulations: dict[str, Emulation] = {}
        seeds = np.random.SeedSequence(seed).generate_state(len(emulators))
        for (name, emulator), own_seed in zip(emulators.items(), seeds, strict=True):
            settings = description.devices[name].settings.model_dump(mode="json")
            self.emulations[name] = emulator.attach(
                EmulationRequest(
                    name=name, settings=settings, world=self.world, seed=int(own_seed), clock=clock, bus=bus
                )
            )

    def settings_of(self, name: str) -> DeviceSettings:
        """A device's settings, pointing at its emulator."""
        entry = self._description.devices[name]
        merged = merge_settings(entry.settings.model_dump(mode="python"), self.emulations[name].overrides)
        settings: DeviceSettings = entry.driver.settings.model_validate(merged)
        return settings

    def close(self) -> None:
        """End all emulators and the world."""
        for emulation in self.emulations.values():
            emulation.close()
        self.world.close()

    def _find_emulators(self) -> dict[str, Emulator]:
        found: dict[str, Emulator] = {}
        missing = []
        for name, entry in self._description.devices.items():
            emulator = find_emulator(entry.driver_name)
            if emulator is None:
                missing.append(f"{name} (driver {entry.driver_name})")
            else:
                found[name] = emulator
        if missing:
            raise UnsupportedError(
                f"no emulator is installed for {', '.join(missing)}",
                remedy="run without --fake, remove the device, or install a package with an emulator for it",
            )
        return found

    def _read_world(self) -> Document:
        document = read_document(self.world_file) if self.world_file is not None else Document(_DEFAULT_FILE, {}, {})
        if not self._world_overrides or not isinstance(document.data, dict | None):
            return document
        return document._replace(data=merge_settings(document.data or {}, self._world_overrides))

    def _build_world(self, document: Document, clock: Clock, bus: Bus) -> World:
        name = document.data.get("world", DEFAULT_WORLD) if isinstance(document.data, dict) else DEFAULT_WORLD
        world_type: WorldType[Any] | None = find_world(str(name))
        if world_type is None:
            raise document.error(f"no world {name!r} is installed", ("world",), remedy=f"use {DEFAULT_WORLD!r}")
        settings, errors = validate(world_type.settings, document.data, document)
        raise_all(document, [self._blame_overrides(error) for error in errors])
        return world_type.build(
            WorldRequest(settings=settings, rig=self._description.as_data(), seed=self.seed, clock=clock, bus=bus)
        )

    def _blame_overrides(self, error: ConfigError) -> ConfigError:
        """The error without a place in the file if what is wrong does not stand there."""
        value: Any = self._world_overrides
        for part in error.key.split("."):
            if not isinstance(value, Mapping):
                break
            if part not in value:
                return error
            value = value[part]
        return ConfigError(error.what, remedy=error.remedy, file=OVERRIDES, key=error.key)


def _replay_of(wire_log: Path) -> Document:
    return Document(wire_log, {"world": REPLAY_WORLD, "log": str(wire_log)}, {})


def _beside(rig_file: Path) -> Path | None:
    candidate = rig_file.parent / "worlds" / rig_file.name
    return candidate if candidate.exists() else None


def merge_settings(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with the values of `over`, nested mappings merged."""
    merged = dict(base)
    for key, value in over.items():
        inner = merged.get(key)
        merged[key] = (
            merge_settings(inner, value) if isinstance(value, Mapping) and isinstance(inner, Mapping) else value
        )
    return merged
