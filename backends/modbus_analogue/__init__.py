"""A force sensor with a voltage output, on an analogue-input module that speaks Modbus RTU or TCP."""

from __future__ import annotations

from typing import TYPE_CHECKING

from microdrivers.backends.modbus_analogue.settings import ModbusForceSettings
from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.devices.drivers import Driver
from microdrivers.devices.force_sensor import ForceSensor

if TYPE_CHECKING:
    from microdrivers.backends.modbus_analogue.sensor import ModbusForceSensor

__all__ = ["DRIVER", "ModbusForceSettings"]


def _create(name: str, settings: ModbusForceSettings, clock: Clock, bus: Bus) -> ModbusForceSensor:
    from microdrivers.backends.modbus_analogue.sensor import ModbusForceSensor

    return ModbusForceSensor(name, settings, clock=clock, bus=bus)


DRIVER = Driver(kind=ForceSensor, settings=ModbusForceSettings, create=_create)
