"""Emulated CiA 404 measuring amplifier with a capacitive force probe."""

from microdrivers.fakes.cia404.amplifier import Amplifier, InputSpec
from microdrivers.fakes.cia404.emulator import EMULATOR

__all__ = ["EMULATOR", "Amplifier", "InputSpec"]
