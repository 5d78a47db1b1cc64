"""The modules that can be emulated, as tables: registers, ranges and how fast they convert.

Sources: Waveshare, "Modbus RTU Analog Input 8CH", development protocol V2; Advantech, ADAM-4100 series user's manual,
appendix B.1, and ADAM-4000 series user's manual, appendix G. What they do not state is marked as a choice.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple

from microdrivers.core.units import NS_PER_MS

CHANNELS = 8
READ_HOLDING, READ_INPUTS = 0x03, 0x04

_LAST_WORD = 0xFFFF


class InputRange(NamedTuple):
    """One setting of a channel.

    Attributes:
        signal_V: what it is meant for.
        span_V: what the converter covers.
        words: what the register would show at both ends of it; it ends at FFFFh.
    """

    signal_V: tuple[float, float]
    span_V: tuple[float, float]
    words: tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class ModuleModel:
    """A maker's module with eight inputs.

    Attributes:
        resolution_bits: the converter's; it has 2 to that many steps.
        ranges: by range code.
        default_range: the code for signals that no range is meant for but that this one takes.
        input_functions: function codes that read the inputs, at 0000h to 0007h.
        first_range_code: address of channel 1's range code; the others follow.
        address_register: holds the unit's address, if it can be changed by Modbus.
        mask_register: one bit for each channel that is converted, if that can be chosen.
        constants: other registers that can be read.
        conversion_ns: one conversion of one channel; the channels take turns.
    """

    resolution_bits: int
    ranges: Mapping[int, InputRange]
    default_range: int
    input_functions: Collection[int]
    first_range_code: int
    address_register: int | None = None
    mask_register: int | None = None
    constants: Mapping[int, int] = field(default_factory=dict)
    conversion_ns: int
    baudrates: Collection[int]

    def word(self, volts: float, code: int) -> int:
        """What the register shows in the range `code`, clipped at the ends of the converter's span."""
        span_V, words = self.ranges[code].span_V, self.ranges[code].words
        fraction = (volts - span_V[0]) / (span_V[1] - span_V[0])
        steps = 1 << self.resolution_bits
        step = round(min(max(fraction, 0.0), 1.0) * steps)
        return min(words[0] + round(step * (words[1] - words[0]) / steps), _LAST_WORD)

    def range_for(self, signal_V: tuple[float, float]) -> int | None:
        """The code of the range that is meant for a signal, else that of the default range if it takes it."""
        for code, meant in self.ranges.items():
            if meant.signal_V == signal_V:
                return code
        low_V, high_V = self.ranges[self.default_range].signal_V
        return self.default_range if low_V <= signal_V[0] and signal_V[1] <= high_V else None


_WAVESHARE_SPAN_V = (0.0, 5.0)
"""Also of the current ranges: 20 mA across the shunt, rounded to 250 Ω."""

_WAVESHARE_8CH = ModuleModel(
    resolution_bits=12,
    ranges=MappingProxyType(
        {
            0: InputRange((0.0, 5.0), _WAVESHARE_SPAN_V, (0, 5000)),
            1: InputRange((1.0, 5.0), _WAVESHARE_SPAN_V, (0, 5000)),
            2: InputRange((0.0, 5.0), _WAVESHARE_SPAN_V, (0, 20_000)),
            3: InputRange((1.0, 5.0), _WAVESHARE_SPAN_V, (0, 20_000)),
            4: InputRange((0.0, 5.0), _WAVESHARE_SPAN_V, (0, 4096)),
        }
    ),
    default_range=0,
    input_functions=(READ_INPUTS,),
    first_range_code=0x1000,
    address_register=0x4000,
    constants=MappingProxyType({0x8000: 0x00C8}),
    conversion_ns=1_250_000,  # a choice: all of them every 10 ms
    baudrates=(4800, 9600, 19200, 38400, 57600, 115200, 128000, 256000),
)
"""In mV and µA, but the last range in codes."""


def _symmetric(full_scale_V: float) -> InputRange:
    span_V = (-full_scale_V, full_scale_V)
    return InputRange(span_V, span_V, (0, 0x10000))


_ADAM_4117 = ModuleModel(
    resolution_bits=16,
    ranges=MappingProxyType(
        {
            0x08: _symmetric(10.0),
            0x09: _symmetric(5.0),
            0x0A: _symmetric(1.0),
            0x0B: _symmetric(0.5),
            0x0C: _symmetric(0.15),
            0x0D: _symmetric(2.5),  # ±20 mA across 125 Ω
        }
    ),
    default_range=0x08,
    input_functions=(READ_HOLDING, READ_INPUTS),
    first_range_code=0x00C8,
    mask_register=0x00DC,
    constants=MappingProxyType({0x00D2: 0x4117, 0x00D3: 0x0000, 0x00D4: 0xA200, 0x00D5: 0xB001}),
    conversion_ns=10 * NS_PER_MS,
    baudrates=(1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200),
)
"""In offset binary over the range, and in its fast mode of 100 conversions a second."""

MODELS: Mapping[str, ModuleModel] = MappingProxyType({"waveshare-8ch": _WAVESHARE_8CH, "adam-4117": _ADAM_4117})
