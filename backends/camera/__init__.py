"""Cameras fed by a frame source."""

from __future__ import annotations

from typing import TYPE_CHECKING

from microdrivers.backends.camera.settings import CameraDeviceSettings
from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.devices.camera import Camera
from microdrivers.devices.drivers import Driver

if TYPE_CHECKING:
    from microdrivers.backends.camera.source_camera import SourceCamera

__all__ = ["DRIVER", "CameraDeviceSettings"]


def _create(name: str, settings: CameraDeviceSettings, clock: Clock, bus: Bus) -> SourceCamera:
    from microdrivers.backends.camera.source_camera import SourceCamera

    return SourceCamera(name, settings, clock=clock, bus=bus)


DRIVER = Driver(kind=Camera, settings=CameraDeviceSettings, create=_create)
