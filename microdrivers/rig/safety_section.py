"""The rig file's safety section: what it may say."""

from __future__ import annotations

from typing import Annotated, Any

import pydantic

from microdrivers.devices.drivers import DeviceSettings

NONE = "none"
_ZERO_SHARE = 0.1
_AXES = ("x", "y", "z")


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
    counts as load: so far may the amplifier's own zero be off; by default 10 % of the limit. Moves faster than
    `max_speed_um_s` are refused: until it stands, a stage goes on by what it does in a reading and while it brakes.
    """

    sensor: str
    stage: str
    max_force_uN: float = pydantic.Field(gt=0)
    stale_after_ms: float = pydantic.Field(default=50.0, ge=2.0, le=1000.0)
    zero_within_uN: float | None = pydantic.Field(default=None, ge=0)
    max_speed_um_s: float | None = pydantic.Field(default=None, gt=0)

    @property
    def zero_uN(self) -> float:
        """The largest tare that is a zero and not a load."""
        return _ZERO_SHARE * self.max_force_uN if self.zero_within_uN is None else self.zero_within_uN

    def zero_of_uN(self, tare_uN: float) -> float:
        """As much of a tare as is a zero; the rest is load."""
        return min(max(tare_uN, -self.zero_uN), self.zero_uN)


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
