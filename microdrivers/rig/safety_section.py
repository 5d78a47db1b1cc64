"""The rig file's safety section: what it may say, and what it must not say of these devices."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any

import pydantic

from microdrivers.core.errors import ConfigError
from microdrivers.devices.drivers import DeviceSettings
from microdrivers.devices.fine_stage import FineStage
from microdrivers.devices.force_sensor import ForceSensor
from microdrivers.devices.force_sensor_settings import ForceSensorSettings
from microdrivers.devices.stage import Stage
from microdrivers.rig.yaml_file import Document, Location

if TYPE_CHECKING:
    from microdrivers.rig.rig_file import DeviceEntry, RigFile

NONE = "none"
_ZERO_SHARE = 0.1
_LEAST_PERIODS = 2.0
_AXES = ("x", "y", "z")
_SECTION = "safety"


def _explicit(value: Any) -> Any:
    if value == NONE:
        return ()
    if not isinstance(value, list) or not value:
        raise ValueError(f"a list is needed here; write {NONE} if none is meant")
    return _immutable(value)


def _immutable(value: Any) -> Any:
    """What comes through a validator of our own is no longer JSON, where lists pass for tuples."""
    if isinstance(value, list):
        return tuple(_immutable(item) for item in value)
    return {key: _immutable(item) for key, item in value.items()} if isinstance(value, dict) else value


def _three(value: Any) -> Any:
    if not isinstance(value, list | tuple) or len(value) != len(_AXES):
        raise ValueError("a point is needed here: [x, y, z] in µm, in the rig's frame")
    return value


def _nothing_at_all(value: Any) -> Any:
    if value == NONE:
        return {"force_guards": NONE, "keep_out": NONE}
    if not isinstance(value, dict):
        raise ValueError(f"force_guards and keep_out are needed here; write {NONE} if neither is meant")
    return value


def _or_none(items: tuple[Any, ...]) -> Any:
    return [item.model_dump(mode="json") for item in items] or NONE


Point = Annotated[tuple[float, float, float], pydantic.BeforeValidator(_three)]


class ForceGuardSettings(DeviceSettings):
    """A limit to the force on a tool.

    `stage` carries the sensor and is stopped and retracted when the force is larger than `max_force_uN`, of either
    sign. It moves only while force data come that are not older than `stale_after_ms`. A tare beyond ±`zero_within_uN`
    counts as load: so far may the amplifier's own zero be off; by default 10 % of the limit.
    """

    sensor: str
    stage: str
    max_force_uN: float = pydantic.Field(gt=0)
    stale_after_ms: float = pydantic.Field(default=50.0, ge=2.0, le=1000.0)
    zero_within_uN: float | None = pydantic.Field(default=None, ge=0)

    @property
    def zero_uN(self) -> float:
        """The largest tare that is a zero and not a load."""
        return _ZERO_SHARE * self.max_force_uN if self.zero_within_uN is None else self.zero_within_uN


class KeepOutBox(DeviceSettings):
    """A box in the rig's frame that no tool's tip may enter."""

    name: str = pydantic.Field(min_length=1)
    min_um: Point
    max_um: Point

    @pydantic.model_validator(mode="after")
    def _has_an_inside(self) -> KeepOutBox:
        for axis, low, high in zip(_AXES, self.min_um, self.max_um, strict=True):
            if not low < high:
                raise ValueError(f"along {axis} a box reaches from less to more, not from {low:g} to {high:g}")
        return self


class SafetySection(DeviceSettings):
    """Limits to force, and boxes that tools keep out of; either may be `none`, and so may the whole section."""

    force_guards: Annotated[
        tuple[ForceGuardSettings, ...], pydantic.BeforeValidator(_explicit), pydantic.PlainSerializer(_or_none)
    ]
    keep_out: Annotated[tuple[KeepOutBox, ...], pydantic.BeforeValidator(_explicit), pydantic.PlainSerializer(_or_none)]


SafetyKey = Annotated[SafetySection, pydantic.BeforeValidator(_nothing_at_all)]
"""The section as a key of the rig file."""

UNSTATED = SafetySection.model_validate({"force_guards": NONE, "keep_out": NONE})


def check_safety(rig: RigFile, devices: Mapping[str, DeviceEntry], document: Document) -> list[ConfigError]:
    """What is wrong with the section, or with its absence."""
    if _SECTION not in rig.model_fields_set:
        return _must_be_stated(devices, document)
    errors: list[ConfigError] = []
    for i, guard in enumerate(rig.safety.force_guards):
        errors += _check_guard(guard, rig, devices, document, (_SECTION, "force_guards", i))
    errors += _check_repetition([guard.sensor for guard in rig.safety.force_guards], "force_guards", "sensor", document)
    errors += _check_repetition([box.name for box in rig.safety.keep_out], "keep_out", "name", document)
    if rig.safety.keep_out:
        errors += _check_origins(devices, document)
    return errors


def _must_be_stated(devices: Mapping[str, DeviceEntry], document: Document) -> list[ConfigError]:
    for name, entry in devices.items():
        carrier = _carrier(entry)
        if carrier is None or carrier not in devices or not issubclass(devices[carrier].driver.kind, Stage):
            continue
        guard = f"{{sensor: {name}, stage: {carrier}, max_force_uN: …}}"
        return [
            document.error(
                f"{carrier} carries a force sensor, and the rig file does not say what keeps it from pressing too hard",
                ("devices", name, "carried_by"),
                remedy=f"add at the top level  safety: {{force_guards: [{guard}], keep_out: {NONE}}}  or, if that is "
                f"what you want,  safety: {NONE}",
            )
        ]
    return []


def _check_guard(
    guard: ForceGuardSettings, rig: RigFile, devices: Mapping[str, DeviceEntry], document: Document, where: Location
) -> Iterator[ConfigError]:
    wrong = False
    for key, name, kind in (("sensor", guard.sensor, ForceSensor), ("stage", guard.stage, FineStage)):
        suitable = [each for each, entry in devices.items() if issubclass(entry.driver.kind, kind)]
        if name not in suitable:
            wrong = True
            if name in devices or name not in rig.devices:  # what is there and was not understood has errors of its own
                what = f"{name!r} is no {kind.__name__}" if name in devices else f"there is no device {name!r} here"
                remedy = f"name one of {', '.join(suitable)}" if suitable else "leave the guard out"
                yield document.error(what, (*where, key), remedy=remedy)
    if wrong:
        return
    carrier = _carrier(devices[guard.sensor])
    if carrier != guard.stage:
        yield document.error(
            f"{guard.sensor} is not carried by {guard.stage}"
            + (f" but by {carrier}" if carrier else ", nor does its section say by what"),
            (*where, "stage"),
            remedy=f"name the stage that moves the tool, or state carried_by: {guard.stage} in the section of "
            f"{guard.sensor}",
        )
    yield from _check_figures(guard, devices[guard.sensor].settings, document, where)
    if getattr(devices[guard.stage].settings, "retract_um", None) is None:
        yield document.error(
            f"{guard.stage} has no way to take the tool away from what it presses on", ("devices", guard.stage),
            remedy="state retract_um: [x, y, z] of this stage in its own axes, the way that leads away from the sample",
        )  # fmt: skip


def _check_figures(
    guard: ForceGuardSettings, sensor: DeviceSettings, document: Document, where: Location
) -> Iterator[ConfigError]:
    if not isinstance(sensor, ForceSensorSettings):
        return  # a driver with settings of its own kind
    largest = max(-sensor.range_uN.min, sensor.range_uN.max)
    if not sensor.resolution_uN < guard.max_force_uN <= largest:
        yield document.error(
            f"a limit of {guard.max_force_uN:g} µN is outside what {guard.sensor} can tell: "
            f"{sensor.resolution_uN:g} to {largest:g} µN",
            (*where, "max_force_uN"),
            remedy="choose what the sample bears, below the end of the sensor's range_uN; check the unit",
        )
    if guard.zero_uN >= guard.max_force_uN:
        yield document.error(
            f"a zero within ±{guard.zero_uN:g} µN could hide the whole limit", (*where, "zero_within_uN"),
            remedy=f"choose less than max_force_uN, {guard.max_force_uN:g} µN",
        )  # fmt: skip
    least_ms = _LEAST_PERIODS * 1000.0 / sensor.rate_hz
    if guard.stale_after_ms < least_ms:
        yield document.error(
            f"{guard.stale_after_ms:g} ms are shorter than two readings of {guard.sensor} at {sensor.rate_hz:g} Hz",
            (*where, "stale_after_ms"),
            remedy=f"allow {least_ms:.0f} ms or more, or raise the sensor's rate_hz",
        )


def _check_repetition(names: list[str], part: str, key: str, document: Document) -> Iterator[ConfigError]:
    for i, name in enumerate(names):
        if name in names[:i]:
            yield document.error(f"{name!r} stands here twice", (_SECTION, part, i, key), remedy="keep one of them")


def _check_origins(devices: Mapping[str, DeviceEntry], document: Document) -> Iterator[ConfigError]:
    for name, entry in devices.items():
        if issubclass(entry.driver.kind, FineStage) and getattr(entry.settings, "origin_um", None) is None:
            yield document.error(
                f"it is not known where the tip of {name} is, so it cannot be kept out of the boxes in safety.keep_out",
                ("devices", name),
                remedy=f"state origin_um: [x, y, z], the tip in the rig's frame when all axes of {name} are at 0; or "
                f"state keep_out: {NONE}",
            )


def _carrier(entry: DeviceEntry) -> str | None:
    carrier: str | None = getattr(entry.settings, "carried_by", None)
    return carrier if issubclass(entry.driver.kind, ForceSensor) else None
