"""A force sensor on a CiA 404 measuring amplifier, over CAN."""

from __future__ import annotations

from typing import TYPE_CHECKING

from microdrivers.backends.cia404.settings import Cia404ForceSettings
from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.devices.drivers import Driver
from microdrivers.devices.force_sensor import ForceSensor

if TYPE_CHECKING:
    from microdrivers.backends.cia404.sensor import Cia404ForceSensor

__all__ = ["DRIVER", "Cia404ForceSettings"]


def _create(name: str, settings: Cia404ForceSettings, clock: Clock, bus: Bus) -> Cia404ForceSensor:
    from microdrivers.backends.cia404.sensor import Cia404ForceSensor

    return Cia404ForceSensor(name, settings, clock=clock, bus=bus)


DRIVER = Driver(kind=ForceSensor, settings=Cia404ForceSettings, create=_create)
