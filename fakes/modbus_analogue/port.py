"""The RS-485 port of an analogue-input module.

Source: Modbus over serial line V1.02, 2.5.1.1, for the silence between frames; the other times are choices.
"""

from __future__ import annotations

from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.fakes.modbus import RtuSlave, SlaveTiming
from microdrivers.fakes.modbus_analogue.module import AnalogueModule
from microdrivers.fakes.wire import Reply

_FAST_BAUDRATE, _FAST_SILENCE_NS = 19200, 1_750_000


class AnaloguePort(RtuSlave):
    """Answers under the module's address; after that has been written, from the next frame on under the new one."""

    def __init__(self, module: AnalogueModule, *, baudrate: int, bits_per_byte: int, seed: int) -> None:
        silence_ns = round(3.5 * bits_per_byte * NS_PER_S / baudrate)
        if baudrate > _FAST_BAUDRATE:
            silence_ns = _FAST_SILENCE_NS
        super().__init__(
            module,
            unit_id=module.unit_id,
            timing=SlaveTiming(
                silence_ns=silence_ns,
                pause_after_reply_ns=silence_ns,
                pause_after_broadcast_ns=10 * NS_PER_MS,
                waiting_ns=0,
                processing_ms=(0.2, 0.6),
                scatter_ms=0.3,
            ),
            baudrate=baudrate,
            bits_per_byte=bits_per_byte,
            seed=seed,
        )
        self.module = module

    def advance(self, t_ns: int) -> list[Reply]:
        """As every slave's."""
        replies = super().advance(t_ns)
        self.unit_id = self.module.unit_id
        return replies
