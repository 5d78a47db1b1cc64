"""What a controller is asked when the stage is opened: is it that of the rig file, and how far may it travel?

Nothing here moves an axis or switches a servo.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from typing import NamedTuple

from microdrivers.backends.pi_gcs.axis_map import AxisMap, by_axis
from microdrivers.backends.pi_gcs.error_codes import STOPPED, meaning_of
from microdrivers.backends.pi_gcs.protocol import UNINTELLIGIBLE_REMEDY, Gcs
from microdrivers.backends.pi_gcs.settings import GcsStageSettings
from microdrivers.core.errors import ConfigError, LinkTimeout, OutOfRange, ProtocolError
from microdrivers.core.units import Range
from microdrivers.devices.base import DeviceInfo

_COPYRIGHT = re.compile(r"^\(c\)\s*\d{4}\s*", re.IGNORECASE)

_WRONG_UNIT = Range(500.0, 2000.0)
"""A ratio of travels in this range (or its inverse) is a factor of a thousand between units, not a limit."""

_log = logging.getLogger(__name__)


class Opened(NamedTuple):
    """What opening found: who answered, the axes with their limits, their places in the status reply."""

    info: DeviceInfo
    axes: dict[str, AxisMap]
    status_index: dict[str, int]


def inspect(gcs: Gcs, settings: GcsStageSettings, axes: Mapping[str, AxisMap], *, name: str) -> Opened:
    """Identify the controller and adopt its limits.

    Args:
        gcs: the protocol on an open line.
        settings: the stage in the rig file.
        axes: those that this controller drives, as the rig file describes them, by x, y, theta.
        name: of the device, for messages.

    Raises:
        LinkTimeout, ProtocolError: silence, garbage or another device.
        ConfigError: an axis, stage name, unit or limit of the rig file contradicts the controller.
    """
    info = _identify(gcs, settings, _wanted_serial_number(gcs, settings, axes))
    code = gcs.error()
    if code:
        # Every orderly end of use stops the controller, which it remembers as an error.
        level = logging.INFO if code == STOPPED else logging.WARNING
        _log.log(level, "%s: error %d (%s) was pending from earlier use; cleared", name, code, meaning_of(code))
    status_index = _find_axes(gcs, axes, name)
    _check_stage_names(gcs, settings, axes, name)
    low, high, acceleration = (
        by_axis(axes, gcs.numbers(command), command=command) for command in ("TMN?", "TMX?", "ACC?")
    )
    found = {}
    for axis, axis_map in axes.items():
        if acceleration[axis] <= 0:
            raise ProtocolError(f"ACC? gives {acceleration[axis]:g} for axis {axis_map.id}, not an acceleration")
        found[axis] = axis_map.restricted(
            travel=_common_travel(axis_map, low[axis], high[axis], key=f"{name}.axes.{axis}"),
            acceleration=axis_map.magnitude(acceleration[axis]),
        )
    return Opened(info, found, status_index)


def _wanted_serial_number(gcs: Gcs, settings: GcsStageSettings, axes: Mapping[str, AxisMap]) -> str | None:
    if gcs.address is None:
        return settings.serial_number
    (axis,) = axes
    serial_number: str | None = getattr(settings.axes, axis).serial_number
    return serial_number


def _identify(gcs: Gcs, settings: GcsStageSettings, wanted_serial_number: str | None) -> DeviceInfo:
    port, baudrate = settings.connection.port, settings.connection.baudrate
    try:
        identity = gcs.identify()
    except (LinkTimeout, ProtocolError) as error:
        baud = (
            f"check power, cable and baud rate: a wrong rate looks like garbage or silence; the rig file says "
            f"{baudrate}, the controller's DIP switches or parameters say which it uses; "
            "or another device is behind this port"
        )
        special = isinstance(error, ProtocolError) and error.remedy != UNINTELLIGIBLE_REMEDY
        error.remedy = f"{error.remedy}; {baud}" if special else baud
        raise
    fields = [field.strip() for field in identity.split(",")]
    if settings.controller not in identity or len(fields) < 4:
        raise ProtocolError(
            f"another device behind the port: {identity[:80]!r} on {port} is no {settings.controller}",
            sent=gcs.request("*IDN?"), received=identity.encode("latin-1"),
            remedy="check connection.port and controller in the rig file",
        )  # fmt: skip
    vendor, model, serial_number, firmware = fields[-4:]
    if wanted_serial_number is not None and wanted_serial_number != serial_number:
        raise ProtocolError(
            f"another device behind the port: {model} on {port} has serial number {serial_number}, "
            f"not {wanted_serial_number}",
            sent=gcs.request("*IDN?"), received=identity.encode("latin-1"),
            remedy="check connection.port and serial_number in the rig file",
        )  # fmt: skip
    return DeviceInfo(
        driver=settings.driver, vendor=_COPYRIGHT.sub("", vendor), model=model, serial_number=serial_number,
        firmware=firmware,
    )  # fmt: skip


def _find_axes(gcs: Gcs, axes: Mapping[str, AxisMap], name: str) -> dict[str, int]:
    """Each axis' place in the status reply, which follows the order of the controller's axes."""
    listed = gcs.names("SAI?")
    for axis, axis_map in axes.items():
        if axis_map.id not in listed:
            raise ConfigError(
                f"the controller has no axis {axis_map.id!r}; it has {', '.join(listed)}",
                key=f"{name}.axes.{axis}.id",
                remedy="correct the id, or configure the axis in the controller",
            )
    words = len(gcs.status())
    if words != len(listed):
        listed = gcs.names("SAI? ALL")  # deactivated axes may keep their place in the register
    if words != len(listed):
        raise ProtocolError(f"the status reply has {words} registers for the axes {', '.join(listed)}")
    return {axis: listed.index(axis_map.id) for axis, axis_map in axes.items()}


def _check_stage_names(gcs: Gcs, settings: GcsStageSettings, axes: Mapping[str, AxisMap], name: str) -> None:
    reported = by_axis(axes, gcs.texts("CST?"), command="CST?")
    for axis in axes:
        wanted = getattr(settings.axes, axis).stage
        if wanted is not None and wanted != reported[axis]:
            raise ConfigError(
                f"the controller is set up for stage {reported[axis]!r}, the rig file says {wanted!r}",
                key=f"{name}.axes.{axis}.stage",
                remedy="connect the right stage, or load its parameters into the controller (PIMikroMove)",
            )


def _common_travel(axis_map: AxisMap, low: float, high: float, *, key: str) -> Range:
    """The travel that controller and rig file both allow, in rig units."""
    if not low < high:
        raise ConfigError(
            f"the controller reports no travel: from {low:g} to {high:g} {axis_map.native_unit}",
            key=key, remedy="load the stage's parameters into the controller (PIMikroMove)",
        )  # fmt: skip
    spec = axis_map.spec
    offered, wanted = axis_map.travel(low, high), Range(spec.min_position, spec.max_position)
    ratio = (offered.max - offered.min) / (wanted.max - wanted.min)
    both = (
        f"the controller's travel is {low:g} to {high:g} {axis_map.native_unit}, i.e. {offered} {spec.unit} "
        f"in the rig's direction; the rig file's is {wanted} {spec.unit}"
    )
    if ratio in _WRONG_UNIT or 1 / ratio in _WRONG_UNIT:
        raise ConfigError(
            f"the unit is probably wrong, by a factor of {ratio:.4g}: {both}",
            key=key, remedy=f"give the travel in {spec.unit}, or check the controller's parameters",
        )  # fmt: skip
    try:
        return offered.intersect(wanted)
    except OutOfRange:
        raise ConfigError(
            f"no position is allowed by both: {both}",
            key=key, remedy="correct travel or direction of the axis in the rig file",
        ) from None  # fmt: skip
