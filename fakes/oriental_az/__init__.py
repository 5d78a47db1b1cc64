"""Emulator of an Oriental Motor AZ stepper drive, as a Modbus RTU slave (manuals HM-60262E and HP-5142E)."""

from microdrivers.fakes.oriental_az.drive import AzDrive
from microdrivers.fakes.oriental_az.emulator import EMULATOR, ZoomWorld
from microdrivers.fakes.oriental_az.rtu import RtuSlave

__all__ = ["EMULATOR", "AzDrive", "RtuSlave", "ZoomWorld"]
