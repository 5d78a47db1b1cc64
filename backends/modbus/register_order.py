"""How a 32-bit value lies in two registers: the standard says nothing, so devices differ."""

from __future__ import annotations

from typing import Literal, NamedTuple

WordOrder = Literal["high-first", "low-first"]
ByteOrder = Literal["big", "little"]


class RegisterOrder(NamedTuple):
    """`words` tells which word the lower address holds, `bytes` which byte of a register is sent first."""

    words: WordOrder = "high-first"
    bytes: ByteOrder = "big"

    def to_registers(self, value: int) -> tuple[int, int]:
        """A signed or unsigned 32-bit value as the registers at the lower and the higher address."""
        high, low = self._in_order(value >> 16 & 0xFFFF), self._in_order(value & 0xFFFF)
        return (high, low) if self.words == "high-first" else (low, high)

    def from_registers(self, first: int, second: int) -> int:
        """The signed 32-bit value of the registers at the lower and the higher address."""
        high, low = (first, second) if self.words == "high-first" else (second, first)
        value = self._in_order(high) << 16 | self._in_order(low)
        return value - (1 << 32) if value & 1 << 31 else value

    def _in_order(self, word: int) -> int:
        return word if self.bytes == "big" else (word & 0xFF) << 8 | word >> 8
