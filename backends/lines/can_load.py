"""How busy a CAN bus is."""

from __future__ import annotations

from microdrivers.core.units import NS_PER_S

_WINDOW_NS = NS_PER_S


def longest_frame_bits(length: int) -> int:
    """Bits of a standard data frame with as many stuff bits as there can be, and the interframe space.

    44 + 8n bits, (33 + 8n) // 4 stuff bits and 3 of intermission for n bytes (ISO 11898-1).
    """
    return 44 + 8 * length + (33 + 8 * length) // 4 + 3


_BITS = tuple(longest_frame_bits(length) for length in range(65))


class LoadMeter:
    """Adds up frames, one second after the other."""

    def __init__(self, bitrate: int) -> None:
        self._bitrate = bitrate
        self._start_ns = 0
        self._bits = 0
        self._share = 0.0

    def add(self, t_ns: int, length: int) -> None:
        """A frame of so many bytes has passed."""
        if t_ns - self._start_ns >= _WINDOW_NS:
            self._turn(t_ns)
        self._bits += _BITS[length]

    def share(self, t_ns: int) -> float:
        """Share of time taken in the last whole second, or since the first frame if that is less."""
        if t_ns - self._start_ns >= _WINDOW_NS:
            self._turn(t_ns)
        return self._share

    def _turn(self, t_ns: int) -> None:
        elapsed_ns = t_ns - self._start_ns
        self._share = self._bits * NS_PER_S / (self._bitrate * elapsed_ns)
        self._start_ns, self._bits = t_ns, 0
