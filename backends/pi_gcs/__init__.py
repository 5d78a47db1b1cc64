"""An XYθ stage on controllers that speak PI GCS 2.0: one for all axes (C-884 class) or three in a daisy chain."""

from __future__ import annotations

from microdrivers.backends.pi_gcs.settings import GcsStageSettings
from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.devices.drivers import Driver
from microdrivers.devices.xytheta_stage import XYThetaStage


def _create(name: str, settings: GcsStageSettings, clock: Clock, bus: Bus) -> XYThetaStage:
    from microdrivers.backends.pi_gcs.stage import (
        GcsXYThetaStage,
    )  # brings pyserial: only when a stage is made

    return GcsXYThetaStage(name, settings, clock=clock, bus=bus)


DRIVER = Driver(kind=XYThetaStage, settings=GcsStageSettings, create=_create)

__all__ = ["DRIVER", "GcsStageSettings"]
