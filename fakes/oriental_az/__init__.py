"""Emulator of an Oriental Motor AZ stepper drive, on RS-485 or behind a TCP gateway (HM-60262E and HP-5142E)."""

from microdrivers.fakes.oriental_az.drive import AzDrive
from microdrivers.fakes.oriental_az.emulator import EMULATOR, ZoomWorld
from microdrivers.fakes.oriental_az.port import az_port

__all__ = ["EMULATOR", "AzDrive", "ZoomWorld", "az_port"]
