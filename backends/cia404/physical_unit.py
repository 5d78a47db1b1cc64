"""The unit in which an amplifier counts: object 6131h, coded as CiA 303-2 has it."""

from __future__ import annotations

_NEWTON = 0x21
_MICRO = -6
_PREFIXES = {0: "N", -3: "mN", -6: "µN", -9: "nN"}
"""SI prefixes that a force may have here, by their power of ten."""


def uN_per_unit(code: int) -> float | None:
    """How many µN the unit is; None if it is no unit of force that is known here.

    Bits 31–24 are the prefix as a signed power of ten, 23–16 the numerator, 15–8 the denominator.
    """
    exponent = code >> 24 & 0xFF
    exponent -= 256 if exponent > 127 else 0
    if code & 0xFFFFFF != _NEWTON << 16 or exponent not in _PREFIXES:
        return None
    return float(10.0 ** (exponent - _MICRO))


KNOWN_UNITS = ", ".join(f"{name} ({exponent & 0xFF:02X}{_NEWTON:02X}0000h)" for exponent, name in _PREFIXES.items())
"""For messages."""
