"""An emulated camera on the simulated microscope."""

from microdrivers.devices.drivers import Emulator
from microdrivers.fakes.camera.emulation import attach

__all__ = ["EMULATOR"]

EMULATOR = Emulator(attach=attach)
