"""Emulated CiA 402 servo drives: profile position and homing on an axis of the world."""

from microdrivers.fakes.cia402.drive import ServoDrive
from microdrivers.fakes.cia402.emulator import EMULATOR, FineStageWorld
from microdrivers.fakes.cia402.motion import AxisSpec, Motion
from microdrivers.fakes.cia402.orders import AT_ONCE, Reaction

__all__ = ["AT_ONCE", "EMULATOR", "AxisSpec", "FineStageWorld", "Motion", "Reaction", "ServoDrive"]
