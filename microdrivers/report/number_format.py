"""Numbers for readers: the uncertainty with two digits, the value to match, a true minus sign."""

from __future__ import annotations

import math
import re
from typing import NamedTuple

MINUS = "−"
_MOST_DIGITS = 10
_EXPONENT = re.compile(r"(?<=\d)e([+-])0*(\d+)\b")
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


class Formatted(NamedTuple):
    """A value and the half-width of its 95 % interval as text; `plus_minus` is empty if it is not known."""

    value: str
    plus_minus: str
    decimals: int


def fixed(value: float, decimals: int, *, signed: bool = False) -> str:
    """`value` with that many decimals; a negative number of decimals rounds to tens or hundreds."""
    text = f"{round(value, decimals):.{max(decimals, 0)}f}"
    if float(text) == 0.0:
        return text.lstrip("-")
    if text.startswith("-"):
        return MINUS + text[1:]
    return f"+{text}" if signed else text


def significant(value: float, digits: int, *, signed: bool = False) -> str:
    """`value` with that many significant digits, never in exponential notation."""
    return fixed(value, digits - 1 - _exponent(value, digits), signed=signed)


def compact(value: float) -> str:
    """A setting as one would say it: at most four significant digits, no trailing zeros."""
    text = significant(value, 4)
    return text.rstrip("0").rstrip(".") if "." in text else text


def without_exponents(text: str) -> str:
    """A sentence with powers of ten in place of numbers such as 1.4e-05, and true minus signs before numbers."""

    def power(found: re.Match[str]) -> str:
        return "·10" + f"{found[1].strip('+')}{found[2]}".translate(_SUPERSCRIPTS)

    return re.sub(r"(?<![\w.])-(?=\d)", MINUS, _EXPONENT.sub(power, text))


def with_uncertainty(value: float, half_width: float | None) -> Formatted:
    """Two digits of the half-width, and the value to the same place.

    A half-width that is None, zero or infinite is not known: the value then has five significant digits.
    """
    if half_width is None or not (half_width > 0.0 and math.isfinite(half_width)):
        decimals = 4 - _exponent(value, 5)
        return Formatted(fixed(value, decimals), "", decimals)
    wanted = 1 - _exponent(half_width, 2)
    decimals = min(wanted, _MOST_DIGITS - 1 - _exponent(value, _MOST_DIGITS))
    if decimals < wanted:
        return Formatted(fixed(value, decimals), f"< {fixed(10.0**-decimals, decimals)}", decimals)
    return Formatted(fixed(value, decimals), fixed(half_width, decimals), decimals)


def _exponent(value: float, digits: int) -> int:
    """Decimal exponent of `value` once it is rounded to that many significant digits; 0 for 0."""
    return int(f"{value:.{digits - 1}e}".partition("e")[2]) if value else 0
