"""What a device's present state is, in words and as plain data."""

from __future__ import annotations

import math
from typing import Any

import msgspec

from microdrivers.core.samples import ForceSample, PoseSample, Sample, ZoomSample
from microdrivers.devices.base import Device, DeviceInfo
from microdrivers.devices.camera import Camera
from microdrivers.devices.stage import Stage

_COMMON_FIELDS = frozenset(Sample.__struct_fields__) - {"t_ns", "dt_ns", "t_source", "flags"}


def identity_text(info: DeviceInfo) -> str:
    """Who answered: maker, model, serial number and firmware, as far as they are known."""
    parts = [f"{info.vendor} {info.model}".strip() or info.driver]
    if info.serial_number:
        parts.append(f"serial number {info.serial_number}")
    if info.firmware:
        parts.append(f"firmware {info.firmware}")
    return ", ".join(parts)


def unreferenced_axes(device: Device[Any]) -> list[str]:
    """The axes of a stage whose reference is not known, in the order to reference them; [] for other devices."""
    if not isinstance(device, Stage):
        return []
    known = device.referenced
    return [axis for axis in device.reference_order if not known[axis]]


def state_text(device: Device[Any], sample: Sample | None) -> str:
    """The state of a device that was just read, in one line; a camera needs no sample."""
    if isinstance(device, Camera):
        return _camera_text(device)
    if isinstance(sample, PoseSample):
        parts = [", ".join(_position_text(axis, value) for axis, value in sample.position.items())]
        unknown = unreferenced_axes(device)
        parts.append(f"NOT REFERENCED: {', '.join(unknown)}" if unknown else "referenced")
        parts.append(_motion_text(sample))
    elif isinstance(sample, ZoomSample):
        parts = [f"zoom {sample.zoom:.3f} ({sample.position_steps} steps)"]
        parts.append("referenced" if sample.referenced else "NOT REFERENCED")
        parts.append(_motion_text(sample))
    elif isinstance(sample, ForceSample):
        force = "no valid force" if math.isnan(sample.force_uN) else f"force {sample.force_uN:.3f} µN"
        parts = [f"{force} (raw {sample.raw_uN:.3f}, tare {sample.tare_uN:.3f})"]
    else:
        parts = [f"{key} {value}" for key, value in payload_of(sample).items()]
    if sample is not None and sample.flags:
        parts.append(f"flags {', '.join(sorted(sample.flags))}")
    return "; ".join(parts)


def state_data(device: Device[Any], sample: Sample | None) -> dict[str, Any]:
    """The same as plain data."""
    if isinstance(device, Camera):
        return msgspec.structs.asdict(device.settings)
    data = payload_of(sample)
    if isinstance(device, Stage):
        data["referenced"] = dict(device.referenced)
    return data


def payload_of(sample: Sample | None) -> dict[str, Any]:
    """The fields of a sample that describe the device and the time, without the bus's own."""
    if sample is None:
        return {}
    fields = msgspec.structs.asdict(sample)
    fields["flags"] = sorted(sample.flags)
    return {key: value for key, value in fields.items() if key not in _COMMON_FIELDS}


def _position_text(axis: str, value: float) -> str:
    return f"θ {value:.5f}°" if axis == "theta" else f"{axis} {value:.2f} µm"


def _motion_text(sample: PoseSample | ZoomSample) -> str:
    if sample.moving:
        return "moving"
    return "at rest, on target" if sample.on_target else "at rest"


def _camera_text(camera: Camera) -> str:
    settings = camera.settings
    left, top, width, height = settings.roi
    region = f"{width}×{height} px at ({left}, {top}) of {camera.sensor_size_px[0]}×{camera.sensor_size_px[1]}"
    return (
        f"exposure {settings.exposure_ms:g} ms, gain {settings.gain:g}, {settings.rate_hz:g} Hz, {region}, "
        f"binning {settings.binning}, {settings.pixel_format}"
    )
