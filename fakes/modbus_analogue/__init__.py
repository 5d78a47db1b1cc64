"""Emulator of a Modbus analogue-input module whose one wired channel reads a capacitive force probe."""

from microdrivers.fakes.modbus_analogue.emulator import EMULATOR
from microdrivers.fakes.modbus_analogue.models import MODELS, InputRange, ModuleModel
from microdrivers.fakes.modbus_analogue.module import AnalogueModule
from microdrivers.fakes.modbus_analogue.port import AnaloguePort

__all__ = [
    "EMULATOR",
    "MODELS",
    "AnalogueModule",
    "AnaloguePort",
    "InputRange",
    "ModuleModel",
]
