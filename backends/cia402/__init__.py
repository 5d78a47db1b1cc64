"""Fine stages of three CiA 402 servo drives on a CAN bus."""

from __future__ import annotations

from microdrivers.backends.cia402.settings import FineStageSettings
from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.devices.drivers import Driver
from microdrivers.devices.fine_stage import FineStage


def _create(name: str, settings: FineStageSettings, clock: Clock, bus: Bus) -> FineStage:
    from microdrivers.backends.cia402.fine_stage import Cia402FineStage

    return Cia402FineStage(name, settings, clock=clock, bus=bus)


DRIVER = Driver(kind=FineStage, settings=FineStageSettings, create=_create)

__all__ = ["DRIVER", "FineStageSettings"]
