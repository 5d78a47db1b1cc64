"""Puts every emulator of a rig on a port of its own, for other programs to use."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NoReturn

import yaml

from microdrivers.core.bus import Bus
from microdrivers.core.clock import SystemClock
from microdrivers.core.errors import ConfigError, UnsupportedError
from microdrivers.devices.drivers import Endpoint, ServeRequest
from microdrivers.devices.wire_tap import WireTap
from microdrivers.recording.wire_log import WireLogWriter, describe_source
from microdrivers.rig.rig_file import RigDescription
from microdrivers.rig.simulation import Simulation, merge_settings

_MARK = "served on the endpoints below for as long as the serving process runs."
"""In the first line of every rig file written here: only such a file is overwritten."""

_WHY_PATIENT = (
    "# heartbeat_ms, timeout_s and stale_after_ms allow for a computer that emulates all this beside other work.\n"
    "# They are no example for hardware.\n"
)

_PATIENT_MS = 500.0
"""How old force readings of an emulated sensor may be: nothing breaks if an emulated stage moves on for so long."""


def check_writable(file: Path, served: RigDescription) -> None:
    """Whether a rig file that points at endpoints may be written there; nothing is.

    Raises:
        ConfigError: it is the served rig file itself, or a file that was not written here; or there is no such folder.
    """
    if not file.exists():
        folder = file.parent
        if not (folder.is_dir() and os.access(folder, os.W_OK)):
            _refuse(file, "the folder does not exist or may not be written", remedy="choose another file, or make it")
        return
    if served.file.exists() and file.samefile(served.file):
        _refuse(file, "this is the rig file that is to be served")
    if not _written_here(file):
        _refuse(file, "the file exists and was not written by `microdrivers serve`")
    if not os.access(file, os.W_OK):
        _refuse(file, "the file may not be written")


def _refuse(file: Path, what: str, *, remedy: str = "choose another name for the file to write") -> NoReturn:
    raise ConfigError(what, file=str(file), remedy=remedy)


def _written_here(file: Path) -> bool:
    if not file.is_file():
        return False
    try:
        text = file.read_text(encoding="utf-8")
        data = yaml.safe_load(text)
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        return False
    first = text.partition("\n")[0]
    return first.startswith("#") and first.endswith(_MARK) and isinstance(data, dict) and data.get("emulated") is True


class ServedRig:
    """The emulators of a rig in real time, each on an endpoint. Close it to end them all.

    CAN buses stand behind a serial adapter (slcan) each, or on the existing SocketCAN interface `can_interface`. With
    `wire_log`, what passes on serial lines and CAN buses is written to that new file as their emulators see it.

    Raises:
        UnsupportedError: a driver has no emulator, or one that cannot be served; all such devices are named.
        ConfigError: the wire log exists, or cannot be made.
    """

    def __init__(
        self,
        description: RigDescription,
        *,
        seed: int = 0,
        world: Path | None = None,
        transport: Literal["pty", "tcp"] = "pty",
        bind: str = "127.0.0.1",
        can_interface: str | None = None,
        wire_log: Path | None = None,
    ) -> None:
        self.clock = SystemClock()
        self.description = description
        bus = Bus()
        self.simulation = Simulation(description, clock=self.clock, bus=bus, seed=seed, world_file=world)
        self._wire_log: WireLogWriter | None = None
        self._folder = tempfile.TemporaryDirectory(prefix="microdrivers-")
        request = ServeRequest(transport=transport, bind=bind, folder=Path(self._folder.name))
        if can_interface is not None:
            request = replace(request, can="socketcan", can_channel=can_interface)
        self.endpoints: dict[str, Endpoint] = {}
        mute = [name for name, emulation in self.simulation.emulations.items() if emulation.serve is None]
        try:
            if mute:
                raise UnsupportedError(
                    f"the emulator of {', '.join(mute)} cannot be served",
                    remedy="remove the device from the rig file that you serve",
                )
            if wire_log is not None:
                header = describe_source(description.as_data(), source="served", seed=seed)
                self._wire_log = WireLogWriter(
                    wire_log, header, bus=bus, devices=description.devices, start_ns=self.clock.now_ns()
                )
            for name, emulation in self.simulation.emulations.items():
                assert emulation.serve is not None
                self.endpoints[name] = emulation.serve(replace(request, tap=WireTap(name, bus)))
            if self._wire_log is not None:
                self._wire_log.listen_to_buses()
        except BaseException:
            self.close()
            raise

    def rig_data(self) -> dict[str, Any]:
        """The rig as plain data, pointing at the endpoints."""
        data = self.description.as_data() | {"emulated": True}
        for name, endpoint in self.endpoints.items():
            data["devices"][name] = merge_settings(data["devices"][name], _plain(endpoint.overrides))
        if self.description.rig.safety.force_guards:  # else they are `none` in so many words
            for guard in data["safety"]["force_guards"]:
                guard["stale_after_ms"] = max(guard["stale_after_ms"], _PATIENT_MS)
        return data

    def write(self, file: Path) -> None:
        """Write a rig file that points at the endpoints.

        Raises:
            ConfigError: it may not be written there, see `check_writable`, or cannot be.
        """
        check_writable(file, self.description)
        header = f"# {self.description.rig.name}, {_MARK}\n{_WHY_PATIENT}"
        text = header + yaml.safe_dump(self.rig_data(), sort_keys=False, allow_unicode=True)
        try:
            file.write_text(text, encoding="utf-8")
        except OSError as error:
            raise ConfigError(
                f"the rig file cannot be written there: {error.strerror}", file=str(file), remedy="choose another file"
            ) from error

    def close(self) -> None:
        """End all endpoints and emulators; idempotent."""
        for endpoint in self.endpoints.values():
            endpoint.close()
        self.endpoints.clear()
        self.simulation.close()
        self.clock.close()
        if self._wire_log is not None:
            self._wire_log.close()
        self._folder.cleanup()

    def __enter__(self) -> ServedRig:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _plain(overrides: Mapping[str, Any]) -> dict[str, Any]:
    return {key: _plain(value) if isinstance(value, Mapping) else value for key, value in overrides.items()}
