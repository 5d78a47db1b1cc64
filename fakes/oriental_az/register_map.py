"""Addresses, ranges and word order of an AZ drive's registers (Oriental Motor HM-60262E, HP-5142E).

Everything is a pair of registers: 32 bits, signed where it makes sense, the even address in front.
"""

from __future__ import annotations

INT32 = (-(2**31), 2**31 - 1)

# Direct data operation: one item each, then the trigger.
DATA_NUMBER, TYPE, POSITION, SPEED, START_RATE, STOP_RATE, CURRENT = range(0x58, 0x66, 2)
TRIGGER, DESTINATION = 0x66, 0x68
PULSED_INPUT, INPUT, OUTPUT = 0x78, 0x7C, 0x7E
PRESENT_ALARM, COMMUNICATION_ERROR = 0x80, 0xAC
ALARM_HISTORY = range(PRESENT_ALARM + 2, PRESENT_ALARM + 22, 2)
SELECTED_DATA = 0xC2
COMMAND_POSITION, COMMAND_SPEED_RPM, COMMAND_SPEED_HZ = 0xC6, 0xC8, 0xCA
FEEDBACK_POSITION, FEEDBACK_SPEED_RPM, FEEDBACK_SPEED_HZ = 0xCC, 0xCE, 0xD0
DRIVER_TEMPERATURE, MOTOR_TEMPERATURE = 0xF8, 0xFA
ALARM_RESET, CLEAR_HISTORY, PRESET_POSITION, CONFIGURE = 0x180, 0x184, 0x18A, 0x18C
BYTE_WORD_ORDER, RESPONSE_TIMEOUT_MS, ERRORS_TO_ALARM, ERROR_ANSWERS = 0x1384, 0x138A, 0x138C, 0x1392

OPERATION_TYPES = (1, 2, 3)
"""Absolute, incremental from the command, incremental from the feedback position; no other is emulated."""

WRITABLE: dict[int, tuple[int, int, int]] = {
    DATA_NUMBER: (0, 255, 0),
    TYPE: (OPERATION_TYPES[0], OPERATION_TYPES[-1], 2),
    POSITION: (*INT32, 0),
    SPEED: (-4_000_000, 4_000_000, 1000),
    START_RATE: (1, 1_000_000_000, 1_000_000),
    STOP_RATE: (1, 1_000_000_000, 1_000_000),
    CURRENT: (0, 1000, 1000),
    TRIGGER: (-7, 1, 0),
    DESTINATION: (0, 0, 0),
    PULSED_INPUT: (*INT32, 0),
    INPUT: (*INT32, 0),
    ALARM_RESET: (0, 1, 0),
    CLEAR_HISTORY: (0, 1, 0),
    PRESET_POSITION: (0, 1, 0),
    CONFIGURE: (0, 1, 0),
    BYTE_WORD_ORDER: (0, 3, 0),
    RESPONSE_TIMEOUT_MS: (0, 10_000, 0),
    ERRORS_TO_ALARM: (0, 10, 3),
    ERROR_ANSWERS: (0, 1, 1),
}
"""Address of a pair: lowest, highest, initial value. A rate's unit, 0.001 kHz/s, is 1 step/s²."""


def to_words(pair: int, order: int) -> tuple[int, int]:
    """The registers at the even and the odd address of a 32-bit value.

    Args:
        pair: the value; if negative, its two's complement is meant.
        order: parameter 1384h: 0 upper word at the even address, 1 lower word there; 2 and 3 the same with the lower
            byte of each word in front on the wire.

    The manual's table shows the four orders of a pair. That a register on its own (function 06) follows them too is
    assumed.
    """
    upper, lower = pair >> 16 & 0xFFFF, pair & 0xFFFF
    if order & 2:
        upper, lower = _swap_bytes(upper), _swap_bytes(lower)
    return (lower, upper) if order & 1 else (upper, lower)


def from_words(even: int, odd: int, order: int) -> int:
    """The signed 32-bit value of two registers; see `to_words`."""
    upper, lower = (odd, even) if order & 1 else (even, odd)
    if order & 2:
        upper, lower = _swap_bytes(upper), _swap_bytes(lower)
    value = upper << 16 | lower
    return value - (1 << 32) if value >> 31 else value


def _swap_bytes(word: int) -> int:
    return word >> 8 | (word & 0xFF) << 8
