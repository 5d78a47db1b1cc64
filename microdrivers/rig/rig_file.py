"""The rig file: one YAML file that describes a rig, the same on hardware and on emulators."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from microdrivers.core.errors import ConfigError, UnsupportedError
from microdrivers.rig.cross_checks import check_devices_together
from microdrivers.rig.registry import find_driver, known_drivers
from microdrivers.rig.safety_checks import check_safety
from microdrivers.rig.sections import DeviceEntry, RigFile
from microdrivers.rig.validation import suggest, validate
from microdrivers.rig.yaml_file import Document, raise_all, read_document


@dataclass(frozen=True)
class RigDescription:
    """A rig file that has been read and checked completely."""

    file: Path
    rig: RigFile
    devices: Mapping[str, DeviceEntry]

    def restricted_to(self, names: Collection[str]) -> RigDescription:
        """The same rig with these devices alone.

        Raises:
            UnsupportedError: one of them is not in the file.
        """
        unknown = [name for name in names if name not in self.devices]
        if unknown:
            raise UnsupportedError(
                f"there is no device {', '.join(unknown)} in rig {self.rig.name!r}",
                remedy=f"name some of {', '.join(self.devices)}",
            )
        return replace(self, devices={name: entry for name, entry in self.devices.items() if name in names})

    @property
    def microscope_devices(self) -> tuple[str, ...]:
        """Names of the devices that make up the microscope; all devices if the file has no such section."""
        section = self.rig.microscope
        return tuple(self.devices) if section is None else (section.sample_stage, section.zoom, section.camera)

    @property
    def probe_devices(self) -> tuple[str, ...]:
        """Names of the devices that press on a specimen and see it, the microscope's zoom among them."""
        section, microscope = self.rig.probe, self.rig.microscope
        if section is None:
            return tuple(self.devices)
        zoom = () if microscope is None or section.camera != microscope.camera else (microscope.zoom,)
        return (section.stage, section.force, section.camera, *zoom)

    def as_data(self) -> dict[str, Any]:
        """The whole rig as plain data with all defaults filled in, as worlds and provenance need it."""
        data = self.rig.model_dump(mode="json", exclude={"devices"})
        data["devices"] = {name: entry.settings.model_dump(mode="json") for name, entry in self.devices.items()}
        return data


def load_rig_file(file: Path) -> RigDescription:
    """Read and check a rig file without touching hardware.

    Raises:
        ConfigError, ConfigErrors: every mistake, with file, line, column and what to do.
    """
    document = read_document(file)
    rig, errors = validate(RigFile, document.data, document)
    if rig is None:
        # Look into the devices even if the frame around them is wrong: all mistakes at once.
        sections = document.data.get("devices") if isinstance(document.data, dict) else None
        if isinstance(sections, dict):
            errors += _load_devices(sections, document)[1]
        raise_all(document, errors)
        raise AssertionError("unreachable: a rig that failed validation has errors")
    devices, errors = _load_devices(rig.devices, document)
    errors += check_devices_together(rig, devices, document)
    errors += check_safety(rig, devices, document)
    raise_all(document, errors)
    return RigDescription(file=file, rig=rig, devices=devices)


def _load_devices(sections: Mapping[str, Any], document: Document) -> tuple[dict[str, DeviceEntry], list[ConfigError]]:
    devices: dict[str, DeviceEntry] = {}
    errors: list[ConfigError] = []
    for name, section in sections.items():
        where = ("devices", name)
        if not isinstance(section, dict):
            continue  # which the whole file's model says
        driver_name = section.get("driver")
        if not isinstance(driver_name, str):
            remedy = f"add driver: one of {', '.join(known_drivers())}"
            errors.append(document.error("the device names no driver", where, remedy=remedy))
            continue
        driver = find_driver(driver_name)
        if driver is None:
            errors.append(
                document.error(
                    f"no driver {driver_name!r} is installed", (*where, "driver"),
                    remedy=f"{suggest(driver_name, known_drivers())} Or install the package that provides it",
                )
            )  # fmt: skip
            continue
        settings, found = validate(driver.settings, section, document, where)
        errors += found
        if settings is not None:
            devices[name] = DeviceEntry(name, driver_name, driver, settings)
    return devices, errors
