"""What the rig file's safety section must not say of these devices."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from microdrivers.core.errors import ConfigError
from microdrivers.devices.drivers import DeviceSettings
from microdrivers.devices.fine_stage import FineStage
from microdrivers.devices.fine_stage_settings import ToolCarrierSettings
from microdrivers.devices.force_sensor import ForceSensor
from microdrivers.devices.force_sensor_settings import ForceSensorSettings
from microdrivers.devices.stage import Stage
from microdrivers.rig.safety_section import NONE, UNSTATED, ForceGuardSettings, SafetySection
from microdrivers.rig.sections import DeviceEntry, RigFile
from microdrivers.rig.yaml_file import Document, Location

_LEAST_PERIODS = 2.0
_ASIDE = 0.1
"""Share of a way: less than this of it along a direction, and it is at right angles to that."""

_SECTION = "safety"


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


def unguarded(safety: SafetySection, devices: Mapping[str, DeviceEntry]) -> dict[str, str]:
    """The force sensors that no guard watches although a stage carries them, each with its stage."""
    guarded = {guard.sensor for guard in safety.force_guards}
    carriers = {name: _carrier(entry) for name, entry in devices.items() if name not in guarded}
    return {
        name: carrier
        for name, carrier in carriers.items()
        if carrier is not None and carrier in devices and issubclass(devices[carrier].driver.kind, Stage)
    }


def _must_be_stated(devices: Mapping[str, DeviceEntry], document: Document) -> list[ConfigError]:
    for name, carrier in unguarded(UNSTATED, devices).items():
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
                what = f"{name!r} is not a {kind.__name__}" if name in devices else f"there is no device {name!r} here"
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
    yield from _check_way_out(guard, devices, document)
    stage = devices[guard.stage].settings
    largest_um_s = stage.largest_speed_um_s if isinstance(stage, ToolCarrierSettings) else math.inf
    if guard.max_speed_um_s is not None and guard.max_speed_um_s > largest_um_s:
        yield document.error(
            f"a limit of {guard.max_speed_um_s:g} µm/s has no effect: {guard.stage} moves at {largest_um_s:g} µm/s at "
            "most",
            (*where, "max_speed_um_s"),
            remedy="state less, so that the tool stops soon enough, or leave it out",
        )
    if getattr(stage, "retract_um", None) is None:
        yield document.error(
            f"{guard.stage} has no way to take the tool away from what it presses on", ("devices", guard.stage),
            remedy="state retract_um: [x, y, z] of this stage in its own axes, the way that leads away from the sample",
        )  # fmt: skip


def _check_way_out(
    guard: ForceGuardSettings, devices: Mapping[str, DeviceEntry], document: Document
) -> Iterator[ConfigError]:
    """A tool that only goes aside goes on pressing; one that rises or goes back leaves what it presses on."""
    stage, sensor = devices[guard.stage].settings, devices[guard.sensor].settings
    if not isinstance(stage, ToolCarrierSettings) or not isinstance(sensor, ForceSensorSettings):
        return  # drivers with settings of their own kind
    if stage.retract_um is None:
        return
    way_out = stage.in_rig(stage.retract_um)
    back_um = sum(a * b for a, b in zip(way_out, sensor.axis, strict=True))
    if max(abs(back_um), abs(way_out[2])) < _ASIDE * math.hypot(*way_out):
        yield document.error(
            f"this way leads aside, at right angles to the axis of {guard.sensor} in the rig's frame, "
            f"[{', '.join(f'{each:g}' for each in sensor.axis)}]: the tool goes on pressing",
            ("devices", guard.stage, "retract_um"),
            remedy=f"let it lead back along that axis, or up; or correct the axis of {guard.sensor}: the one along "
            "which a push on the tip reads positive",
        )


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
            yield document.error(f"{name!r} is listed twice", (_SECTION, part, i, key), remedy="keep one of them")


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
