"""What only the whole rig file can show to be wrong: sections that name, share or contradict each other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from microdrivers.core.errors import ConfigError
from microdrivers.devices.base import Device
from microdrivers.devices.camera import Camera
from microdrivers.devices.fine_stage import FineStage, Vector
from microdrivers.devices.fine_stage_settings import ToolCarrierSettings
from microdrivers.devices.force_sensor import ForceSensor
from microdrivers.devices.force_sensor_settings import ForceSensorSettings
from microdrivers.devices.stage import Stage
from microdrivers.devices.xytheta_stage import XYThetaStage
from microdrivers.devices.zoom_motor import ZoomMotor
from microdrivers.rig.safety_geometry import depth_um, distance_um
from microdrivers.rig.safety_keep_out import MARGIN_UM
from microdrivers.rig.sections import DeviceEntry, RigFile
from microdrivers.rig.validation import suggest
from microdrivers.rig.yaml_file import Document, Location

_ROLES: Mapping[str, Mapping[str, type[Device[Any]]]] = {
    "microscope": {"sample_stage": XYThetaStage, "zoom": ZoomMotor, "camera": Camera},
    "probe": {"stage": FineStage, "force": ForceSensor, "camera": Camera},
}
_AXES = ("x", "y", "z")
_LEVEL = 0.1
"""Share of a way: a holder that is off by 6° makes no way sideways one that leads down."""


def check_devices_together(
    rig: RigFile, devices: Mapping[str, DeviceEntry], document: Document
) -> Iterator[ConfigError]:
    """Every contradiction between the sections of a rig file, except those of its safety section."""
    yield from _check_roles(rig, devices, document)
    yield from _check_claims(devices, document)
    yield from _check_shares(devices, document)
    for name, entry in devices.items():
        if isinstance(entry.settings, ForceSensorSettings):
            yield from _check_carrier(name, entry.settings, rig, devices, document)
        if isinstance(entry.settings, ToolCarrierSettings):
            yield from _check_retraction(name, entry.settings, rig, document)
            yield from _check_homing(name, entry.settings, rig, document)
    yield from _check_probe(rig, devices, document)


def _check_roles(rig: RigFile, devices: Mapping[str, DeviceEntry], document: Document) -> Iterator[ConfigError]:
    """The devices that the sections `microscope` and `probe` name must exist and be of the right kind."""
    for title, roles in _ROLES.items():
        section = getattr(rig, title)
        for role, kind in roles.items() if section is not None else ():
            yield from _check_name(getattr(section, role), kind, rig, devices, document, (title, role))
    if rig.microscope is None:
        return
    camera = devices.get(rig.microscope.camera)
    if camera is not None and getattr(camera.settings, "view", "top") != "top":
        yield document.error(
            f"{rig.microscope.camera} has view: {getattr(camera.settings, 'view', '')}: it does not look down on the "
            "plane of the sample stage",
            ("microscope", "camera"),
            remedy="name the camera behind the zoom, or correct its view",
        )


def _check_name(
    name: str, kind: type[Device[Any]], rig: RigFile, devices: Mapping[str, DeviceEntry], document: Document,
    where: Location,
) -> Iterator[ConfigError]:  # fmt: skip
    suitable = [other for other, entry in devices.items() if issubclass(entry.driver.kind, kind)]
    if name not in rig.devices:
        yield document.error(f"there is no device {name!r} in this file", where, remedy=suggest(name, suitable))
    elif name in devices and name not in suitable:
        found = devices[name].driver.kind.__name__
        others = f"name another device: {', '.join(suitable)}" if suitable else "add such a device, or leave it out"
        yield document.error(f"{name!r} is of kind {found}, not {kind.__name__}", where, remedy=others)


def _check_claims(devices: Mapping[str, DeviceEntry], document: Document) -> Iterator[ConfigError]:
    """A port or a node belongs to one device."""
    owners: dict[str, str] = {}
    for name, entry in devices.items():
        for claim in entry.settings.claims():
            owner = owners.setdefault(claim, name)
            if owner != name:
                yield document.error(
                    f"{claim} already belongs to {owner!r}", ("devices", name), remedy="give each device its own"
                )
    for name, entry in devices.items():
        for thing in entry.settings.shares():
            if thing in owners:
                yield document.error(
                    f"{thing} already belongs to {owners[thing]!r} alone", ("devices", name, "connection"),
                    remedy="give each its own port",
                )  # fmt: skip


def _check_shares(devices: Mapping[str, DeviceEntry], document: Document) -> Iterator[ConfigError]:
    """Devices on one bus must agree on it."""
    first: dict[str, tuple[str, Mapping[str, object]]] = {}
    for name, entry in devices.items():
        for thing, terms in entry.settings.shares().items():
            owner, agreed = first.setdefault(thing, (name, terms))
            for key, value in terms.items():
                if agreed.get(key) != value:
                    yield document.error(
                        f"{value!r} contradicts {owner!r}, which states {agreed.get(key)!r} for the same {thing}",
                        ("devices", name, *key.split(".")),
                        remedy=f"give all devices of a bus the same {key.rpartition('.')[2]}",
                    )


def _check_carrier(
    name: str, sensor: ForceSensorSettings, rig: RigFile, devices: Mapping[str, DeviceEntry], document: Document
) -> Iterator[ConfigError]:
    where = ("devices", name, "carried_by")
    # A part of a rig may be described without its stages.
    if sensor.carried_by is not None and any(issubclass(entry.driver.kind, Stage) for entry in devices.values()):
        yield from _check_name(sensor.carried_by, Stage, rig, devices, document, where)


def _check_retraction(name: str, stage: ToolCarrierSettings, rig: RigFile, document: Document) -> Iterator[ConfigError]:
    if stage.retract_um is None:
        return
    where = ("devices", name, "retract_um")
    for i, (axis, way) in enumerate(zip(_AXES, stage.retract_um, strict=True)):
        travel = stage.travel_um[axis]
        if abs(way) > travel.max - travel.min:
            yield document.error(
                f"{way:g} µm along {axis} are more than the whole travel of that axis, {travel} µm", (*where, i),
                remedy="choose a way that fits into the travel; check the unit, which is µm",
            )  # fmt: skip
    up = _upwards(rig)
    rise_um = up * stage.in_rig(stage.retract_um)[2]
    if rise_um < -_LEVEL * math.hypot(*stage.retract_um):
        yield document.error(
            f"this way leads down by {-rise_um:g} µm in the rig's frame (its z points {'up' if up > 0 else 'down'}), "
            "towards the sample",
            where,
            remedy="turn it round: the way must lead away from the sample; or correct axes_in_rig of the stage",
        )


def _check_homing(name: str, stage: ToolCarrierSettings, rig: RigFile, document: Document) -> Iterator[ConfigError]:
    """A search for references that ends at switches must not leave the tip in a box."""
    ends_um = stage.homing_ends_um
    if not set(_AXES) <= set(ends_um):
        return
    tip = stage.tip_um((ends_um["x"], ends_um["y"], ends_um["z"]))
    if tip is None:
        return
    for box in rig.safety.keep_out:
        if depth_um(tip, box.min_um, box.max_um) > 0.0:
            yield document.error(
                f"a search for references ends at the limit switches ({_listed(ends_um)} µm), which takes the tip to "
                f"({', '.join(f'{each:g}' for each in tip)}) µm of the rig's frame, into the keep-out box {box.name!r}",
                ("devices", name),
                remedy="let the axes search at the other switch (homing_method), or correct the box or origin_um of "
                f"{name}",
            )


def _listed(position_um: Mapping[str, float]) -> str:
    return ", ".join(f"{axis} {position_um[axis]:g}" for axis in _AXES)


def _upwards(rig: RigFile) -> int:
    """+1 if the rig's z axis points up, −1 if down, 0 if the rig file says so in other words."""
    word = rig.frames.z.strip().lower().partition(" ")[0].strip(",;.")
    return {"up": 1, "upwards": 1, "down": -1, "downwards": -1}.get(word, 0)


def _check_probe(rig: RigFile, devices: Mapping[str, DeviceEntry], document: Document) -> Iterator[ConfigError]:
    """Who presses must carry the sensor, begin where it can be, and be taken away from what it presses on."""
    probe = rig.probe
    stage = devices.get(probe.stage) if probe is not None else None
    if probe is None or stage is None or not issubclass(stage.driver.kind, FineStage):
        return
    settings = stage.settings
    sensor = devices[probe.force].settings if probe.force in devices else None
    if isinstance(sensor, ForceSensorSettings) and sensor.carried_by != probe.stage:
        yield document.error(
            f"{probe.force} is not carried by {probe.stage}"
            + (f" but by {sensor.carried_by}" if sensor.carried_by else ", as far as this file says"),
            ("probe", "force"),
            remedy=f"name the sensor on {probe.stage}, or state carried_by: {probe.stage} in the section of "
            f"{probe.force}",
        )
        return
    if not isinstance(settings, ToolCarrierSettings):
        return  # a driver with settings of its own kind
    if probe.ready_um is not None:
        yield from _check_ready(probe.ready_um, probe.stage, settings, rig, document)
    if isinstance(sensor, ForceSensorSettings) and settings.retract_um is not None:
        way_out = settings.in_rig(settings.retract_um)
        if sum(a * b for a, b in zip(way_out, sensor.axis, strict=True)) < -_LEVEL * math.hypot(*way_out):
            yield document.error(
                f"this way leads towards what the probe presses on, against the axis of {probe.force} in the rig's "
                f"frame, [{', '.join(f'{each:g}' for each in sensor.axis)}]",
                ("devices", probe.stage, "retract_um"),
                remedy=f"turn it round, or correct the axis of {probe.force}: the one along which a push on the tip "
                "reads positive",
            )


def _check_ready(
    ready_um: Vector, name: str, stage: ToolCarrierSettings, rig: RigFile, document: Document
) -> Iterator[ConfigError]:
    where = ("probe", "ready_um")
    outside = [i for i, axis in enumerate(_AXES) if ready_um[i] not in stage.travel_um[axis]]
    for i in outside:
        axis = _AXES[i]
        yield document.error(
            f"{ready_um[i]:g} µm are outside {name}'s travel along {axis}, {stage.travel_um[axis]} µm", (*where, i),
            remedy=f"give the place in the axes of {name}, within their travel; not in the rig's frame",
        )  # fmt: skip
    tip = stage.tip_um(ready_um)
    if outside or tip is None:
        return
    for box in rig.safety.keep_out:
        if distance_um(tip, box.min_um, box.max_um) < MARGIN_UM:
            yield document.error(
                f"the tip would be at ({', '.join(f'{each:g}' for each in tip)}) µm of the rig's frame, in the "
                f"keep-out box {box.name!r} or nearer to it than {MARGIN_UM:g} µm",
                where,
                remedy=f"choose a place outside the box, or correct the box or origin_um of {name}",
            )
