"""Emulator of a Modbus analogue-input module whose one wired channel reads a capacitive force probe."""

from microdrivers.fakes.modbus_analogue.emulator import EMULATOR, WorldWithForces
from microdrivers.fakes.modbus_analogue.models import MODELS, InputRange, ModuleModel
from microdrivers.fakes.modbus_analogue.module import AnalogueModule
from microdrivers.fakes.modbus_analogue.port import AnaloguePort
from microdrivers.fakes.modbus_analogue.probe import ForceProbe

__all__ = [
    "EMULATOR",
    "MODELS",
    "AnalogueModule",
    "AnaloguePort",
    "ForceProbe",
    "InputRange",
    "ModuleModel",
    "WorldWithForces",
]
