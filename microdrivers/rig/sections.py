"""What a rig file may say: its sections as checked data, and its devices with their drivers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import pydantic

from microdrivers.devices.drivers import DeviceSettings, Driver, spelled
from microdrivers.rig.safety_section import UNSTATED, SafetyKey

DeviceName = Annotated[
    str, spelled(r"^[a-z][a-z0-9_]*\Z", "a device's name has small letters, digits and _, and begins with a letter")
]
RigName = Annotated[
    str, spelled(r"^[A-Za-z][A-Za-z0-9_-]*\Z", "a rig's name has letters, digits, _ and -, and begins with a letter")
]


class Frames(DeviceSettings):
    """Which way the world frame's axes point, and its handedness; all positions of the rig are in it."""

    x: str
    y: str
    z: str
    handedness: Literal["right", "left"]


class SquareTarget(DeviceSettings):
    """A square pattern; one of its corners is tracked."""

    kind: Literal["square"] = "square"
    side_um: float = pydantic.Field(gt=0)


class TextureTarget(DeviceSettings):
    """Natural texture; a fixed template is tracked."""

    kind: Literal["texture"]


class MicroscopeSection(DeviceSettings):
    """Which devices make up the microscope, and its fixed optics.

    `objective` and `adapter` multiply the zoom body's reading: magnification = zoom × objective × adapter.
    """

    sample_stage: DeviceName
    zoom: DeviceName
    camera: DeviceName
    objective: float = pydantic.Field(gt=0)
    adapter: float = pydantic.Field(default=1.0, gt=0)
    target: SquareTarget | TextureTarget = pydantic.Field(discriminator="kind")


class ProbeSection(DeviceSettings):
    """Which devices press on a specimen, feel it and see it, for `calibrate force`.

    `ready_um` is where the stage (its own axes x, y, z) holds the tip before the specimen, near it and not touching;
    without it the operator brings the tip there.
    """

    stage: DeviceName
    force: DeviceName
    camera: DeviceName
    ready_um: tuple[float, float, float] | None = None


class RigFile(DeviceSettings):
    """The whole file; each device's section is checked by its driver's own model.

    `emulated` says that emulators stand behind the ports, as in a rig file that `microdrivers serve` writes: results
    are then marked as simulated. `safety` may be left out only where no stage carries a force sensor.
    """

    schema_version: Literal[1]
    name: RigName
    description: str = ""
    emulated: bool = False
    frames: Frames
    microscope: MicroscopeSection | None = None
    probe: ProbeSection | None = None
    safety: SafetyKey = UNSTATED
    devices: dict[DeviceName, dict[str, Any]] = pydantic.Field(min_length=1)


@dataclass(frozen=True)
class DeviceEntry:
    """One device of a rig: its driver and its checked settings."""

    name: str
    driver_name: str
    driver: Driver[Any]
    settings: DeviceSettings
