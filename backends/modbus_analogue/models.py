"""The analogue-input modules that the driver knows: their ranges, their coding, and how often they convert.

Sources: Waveshare wiki, "Modbus RTU Analog Input 8CH" and "(B)"; Advantech, "ADAM-4000 Series User's Manual",
appendix G, and "ADAM-4100 Series User's Manual", appendix B.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from microdrivers.core.units import Range

ModelName = Literal["waveshare-8ch", "waveshare-8ch-b", "adam-4117", "adam-4017+"]
Family = Literal["waveshare", "adam"]

CHANNELS = 8
_U16_MAX = 0xFFFF

ASSUMED_CONVERSION_S: Mapping[Family, float] = {"waveshare": 0.020, "adam": 0.100}
"""How long a module takes to renew a channel (ADAM: times the number of channels that it converts in turn).

ASSUMED: no manual at hand states it for Waveshare, and an ADAM-4117 may be set to convert ten times as fast. State
`conversion_ms` in the rig file where it is known; it is part of every sample's `dt_ns`.
"""


@dataclass(frozen=True)
class ModuleModel:
    """One model of module.

    Attributes:
        family: which registers it has.
        ranges_V: the voltage ranges by their code in the module.
        bits: of its converter.
    """

    family: Family
    vendor: str
    ranges_V: Mapping[int, Range]
    bits: int

    def step_V(self, range_V: Range) -> float:
        """The smallest difference that a reading can show."""
        return (range_V.max - range_V.min) / (1 << self.bits)

    def volts(self, register: int, range_V: Range) -> float:
        """A channel's register as a voltage: mV (Waveshare), or offset binary over the range (ADAM)."""
        if self.family == "waveshare":
            return register / 1000.0
        return range_V.min + (range_V.max - range_V.min) * register / _U16_MAX

    def at_the_end(self, register: int, range_V: Range) -> bool:
        """Whether the converter can show no lower or no higher value."""
        if self.family == "adam":
            return register in (0, _U16_MAX)
        highest_mV = math.floor(1000.0 * (range_V.max - self.step_V(range_V)))
        return register <= 1000.0 * range_V.min or register >= highest_mV


_ADAM_RANGES = {
    0x08: Range(-10.0, 10.0),
    0x09: Range(-5.0, 5.0),
    0x0A: Range(-1.0, 1.0),
    0x0B: Range(-0.5, 0.5),
    0x0C: Range(-0.15, 0.15),
}

MODELS: Mapping[ModelName, ModuleModel] = {
    "waveshare-8ch": ModuleModel("waveshare", "Waveshare", {0: Range(0.0, 5.0), 1: Range(1.0, 5.0)}, bits=12),
    "waveshare-8ch-b": ModuleModel("waveshare", "Waveshare", {0: Range(0.0, 10.0), 1: Range(2.0, 10.0)}, bits=12),
    "adam-4117": ModuleModel("adam", "Advantech", _ADAM_RANGES, bits=16),
    "adam-4017+": ModuleModel("adam", "Advantech", _ADAM_RANGES, bits=16),
}
