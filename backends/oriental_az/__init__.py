"""A zoom motor on an Oriental Motor AZ stepper drive, over Modbus RTU or TCP."""

from __future__ import annotations

from typing import TYPE_CHECKING

from microdrivers.backends.oriental_az.settings import AzZoomSettings
from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.devices.drivers import Driver
from microdrivers.devices.zoom_motor import ZoomMotor

if TYPE_CHECKING:
    from microdrivers.backends.oriental_az.zoom import AzZoomMotor

__all__ = ["DRIVER", "AzZoomSettings"]


def _create(name: str, settings: AzZoomSettings, clock: Clock, bus: Bus) -> AzZoomMotor:
    from microdrivers.backends.oriental_az.zoom import AzZoomMotor

    return AzZoomMotor(name, settings, clock=clock, bus=bus)


DRIVER = Driver(kind=ZoomMotor, settings=AzZoomSettings, create=_create)
