"""Ranges and conversions. Units are always part of a name; conversions happen at the wire, nowhere else."""

from __future__ import annotations

import math
from numbers import Real
from typing import Literal, NamedTuple

from microdrivers.core.errors import OutOfRange

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
UM_PER_MM = 1000.0


class Range(NamedTuple):
    """A closed interval; both ends are required, so "no limit" cannot be expressed."""

    min: float
    max: float

    def __contains__(self, value: object) -> bool:
        return isinstance(value, (int, float)) and self.min <= value <= self.max

    def intersect(self, other: Range) -> Range:
        """The interval that lies in both.

        Raises:
            OutOfRange: they have no point in common.
        """
        both = Range(max(self.min, other.min), min(self.max, other.max))
        if both.min > both.max:
            raise OutOfRange(f"the ranges {self} and {other} have no value in common")
        return both

    def __str__(self) -> str:
        return f"{self.min:g} to {self.max:g}"


def check_range(
    value: float, limits: Range, *, what: str, unit: str, device: str = "", in_file: Literal["both", "max", ""] = "both"
) -> float:
    """Return `value` unchanged if it is finite and within `limits`, of which the rig file may state both or one.

    Raises:
        OutOfRange: it is not; the message names the value, the limits and the unit. Nothing is ever clipped.
    """
    given: object = value  # callers from notebooks have no type checker
    if isinstance(given, bool) or not isinstance(given, Real):
        raise OutOfRange(f"{what} is {value!r}, not a number", device=device, remedy=f"give {what} in {unit}")
    if not math.isfinite(value):
        raise OutOfRange(f"{what} is {value}, not a finite number", device=device, remedy=f"give {what} in {unit}")
    if value not in limits:
        correctable = in_file == "both" or (in_file == "max" and value > limits.max)
        raise OutOfRange(
            f"{what} = {value:g} {unit} is outside {limits} {unit}",
            device=device,
            remedy="choose a value inside the limits" + ", or correct the limits in the rig file" * correctable,
        )
    return value


def seconds_to_ns(seconds: float) -> int:
    """Seconds as whole nanoseconds, rounded to nearest."""
    return round(seconds * NS_PER_S)
