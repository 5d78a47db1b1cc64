"""The parameters of an axis that SPA and SPA? know, and the rules for changing them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple

from microdrivers.fakes.pi_gcs.codes import CommandError, ErrorCode

Value = float | int | str

_DECIMAL = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_INTEGER = re.compile(r"[+-]?\d+", re.ASCII)
_IDENTIFIER = re.compile(r"0[xX][0-9a-fA-F]+|\d+", re.ASCII)
_STAGE_NAME = re.compile(r"[\x21-\x7e]{1,20}")
_LARGEST_INTEGER = 2**31 - 1
_LONGEST_SETTLING_S = 100.0
_RATE_TOLERANCE = 1e-6
"""Relative: a rate that was rounded to the protocol's decimals is not over its maximum."""


class Parameter(IntEnum):
    """Identifiers that clients use."""

    P_TERM = 0x1
    I_TERM = 0x2
    D_TERM = 0x3
    I_LIMIT = 0x4
    MAX_VELOCITY = 0xA
    ACCELERATION = 0xB
    DECELERATION = 0xC
    COUNTS_NUMERATOR = 0xE
    COUNTS_DENOMINATOR = 0xF
    HAS_REFERENCE = 0x14
    MAX_TRAVEL = 0x15
    MIN_TRAVEL = 0x30
    HAS_NO_LIMITS = 0x32
    SETTLING_WINDOW = 0x36
    STAGE_NAME = 0x3C
    SETTLING_TIME = 0x3F
    VELOCITY = 0x49
    MAX_ACCELERATION = 0x4A
    MAX_DECELERATION = 0x4B
    REFERENCE_VELOCITY = 0x50
    REFERENCE_SIGNAL = 0x70


class Description(NamedTuple):
    """A row of HPA?; a protected parameter cannot be written."""

    kind: type[float] | type[int] | type[str]
    group: str
    text: str
    protected: bool = False


DESCRIPTIONS = {
    Parameter.P_TERM: Description(int, "Servo", "P-Term"),
    Parameter.I_TERM: Description(int, "Servo", "I-Term"),
    Parameter.D_TERM: Description(int, "Servo", "D-Term"),
    Parameter.I_LIMIT: Description(int, "Servo", "I-Limit"),
    Parameter.MAX_VELOCITY: Description(float, "Motion", "Maximum velocity", protected=True),
    Parameter.ACCELERATION: Description(float, "Motion", "Acceleration"),
    Parameter.DECELERATION: Description(float, "Motion", "Deceleration"),
    Parameter.COUNTS_NUMERATOR: Description(int, "Encoder", "Counts per unit, numerator", protected=True),
    Parameter.COUNTS_DENOMINATOR: Description(int, "Encoder", "Counts per unit, denominator", protected=True),
    Parameter.HAS_REFERENCE: Description(int, "Stage", "Has reference switch"),
    Parameter.MAX_TRAVEL: Description(float, "Stage", "Maximum travel in positive direction"),
    Parameter.MIN_TRAVEL: Description(float, "Stage", "Maximum travel in negative direction"),
    Parameter.HAS_NO_LIMITS: Description(int, "Stage", "Has NO limit switches"),
    Parameter.SETTLING_WINDOW: Description(int, "Servo", "Settling window"),
    Parameter.STAGE_NAME: Description(str, "Stage", "Stage name"),
    Parameter.SETTLING_TIME: Description(float, "Servo", "Settling time"),
    Parameter.VELOCITY: Description(float, "Motion", "Closed-loop velocity"),
    Parameter.MAX_ACCELERATION: Description(float, "Motion", "Maximum acceleration", protected=True),
    Parameter.MAX_DECELERATION: Description(float, "Motion", "Maximum deceleration", protected=True),
    Parameter.REFERENCE_VELOCITY: Description(float, "Motion", "Reference velocity"),
    Parameter.REFERENCE_SIGNAL: Description(int, "Stage", "Reference signal type"),
}

_MAXIMUM_OF = {
    Parameter.VELOCITY: Parameter.MAX_VELOCITY,
    Parameter.REFERENCE_VELOCITY: Parameter.MAX_VELOCITY,
    Parameter.ACCELERATION: Parameter.MAX_ACCELERATION,
    Parameter.DECELERATION: Parameter.MAX_DECELERATION,
}
_SWITCHES = (Parameter.HAS_REFERENCE, Parameter.HAS_NO_LIMITS)
_TRAVEL = (Parameter.MIN_TRAVEL, Parameter.MAX_TRAVEL)


def read_decimal(text: str) -> float:
    """A plain decimal, with sign and exponent if wanted.

    Raises:
        CommandError: INVALID_NUMBER.
    """
    if not _DECIMAL.fullmatch(text) or not math.isfinite(float(text)):
        raise CommandError(ErrorCode.INVALID_NUMBER)
    return float(text)


def read_integer(text: str) -> int:
    """A whole decimal number.

    Raises:
        CommandError: INVALID_NUMBER, or PARAMETER_OUT_OF_RANGE beyond 32 bits.
    """
    if not _INTEGER.fullmatch(text):
        raise CommandError(ErrorCode.INVALID_NUMBER)
    value = int(text)
    if abs(value) > _LARGEST_INTEGER:
        raise CommandError(ErrorCode.PARAMETER_OUT_OF_RANGE)
    return value


def read_switch(text: str) -> bool:
    """0 or 1.

    Raises:
        CommandError: INVALID_NUMBER, or PARAMETER_OUT_OF_RANGE.
    """
    value = read_integer(text)
    if value not in (0, 1):
        raise CommandError(ErrorCode.PARAMETER_OUT_OF_RANGE)
    return value == 1


def read_parameter(text: str) -> Parameter:
    """A parameter's identifier, decimal or 0x-hexadecimal.

    Raises:
        CommandError: PARAMETER_SYNTAX, or UNKNOWN_PARAMETER.
    """
    if not _IDENTIFIER.fullmatch(text):
        raise CommandError(ErrorCode.PARAMETER_SYNTAX)
    number = int(text, 16) if text[:2].lower() == "0x" else int(text)
    try:
        return Parameter(number)
    except ValueError:
        raise CommandError(ErrorCode.UNKNOWN_PARAMETER) from None


def check_rate(value: float, maximum: float, smallest: float, *, code: ErrorCode) -> float:
    """A velocity or acceleration between the smallest that the axis can do and its maximum.

    Raises:
        CommandError: with `code`.
    """
    if not smallest <= value <= maximum * (1.0 + _RATE_TOLERANCE):
        raise CommandError(code)
    return value


def check_parameter(
    parameter: Parameter, text: str, values: Mapping[Parameter, Value], travel: tuple[float, float]
) -> Value:
    """The value that SPA may write, given the axis' other values and its physical travel in controller units.

    Raises:
        CommandError: PROTECTED_PARAMETER, INVALID_NUMBER, PARAMETER_OUT_OF_RANGE or SOFT_LIMIT_OUT_OF_RANGE.
    """
    description = DESCRIPTIONS[parameter]
    if description.protected:
        raise CommandError(ErrorCode.PROTECTED_PARAMETER)
    if parameter in _SWITCHES:
        return int(read_switch(text))
    if description.kind is str:
        if not _STAGE_NAME.fullmatch(text):
            raise CommandError(ErrorCode.PARAMETER_OUT_OF_RANGE)
        return text
    value = read_integer(text) if description.kind is int else read_decimal(text)
    if parameter in _TRAVEL:
        limits = {name: values[name] for name in _TRAVEL} | {parameter: value}
        low, high = float(limits[Parameter.MIN_TRAVEL]), float(limits[Parameter.MAX_TRAVEL])
        if not travel[0] <= low < high <= travel[1]:
            raise CommandError(ErrorCode.SOFT_LIMIT_OUT_OF_RANGE)
    elif parameter in _MAXIMUM_OF:
        maximum = float(values[_MAXIMUM_OF[parameter]])
        check_rate(value, maximum, one_count(values), code=ErrorCode.PARAMETER_OUT_OF_RANGE)
    elif value < 0 or (parameter is Parameter.SETTLING_TIME and value > _LONGEST_SETTLING_S):
        raise CommandError(ErrorCode.PARAMETER_OUT_OF_RANGE)
    return value


def one_count(values: Mapping[Parameter, Value]) -> float:
    """Size of one encoder count in controller units."""
    return float(values[Parameter.COUNTS_DENOMINATOR]) / float(values[Parameter.COUNTS_NUMERATOR])


def format_decimal(value: float) -> str:
    """Seven decimals, without a negative zero."""
    return f"{round(value, 7) + 0.0:.7f}"


def format_value(value: Value) -> str:
    """A parameter as SPA? shows it."""
    return format_decimal(value) if isinstance(value, float) else str(value)
