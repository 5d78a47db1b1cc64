"""The AZ drive's registers, and what can be asked of it.

Addresses, units and bits as the drive leaves the factory (Oriental Motor HP-5142E; AZ: bits of 007Dh and 007Fh). A
32-bit value has its upper word at the even address, negative values in two's complement; both words go in one query.
"""

from __future__ import annotations

import enum
from typing import NamedTuple

from microdrivers.backends.oriental_az.alarms import alarm_fault
from microdrivers.backends.oriental_az.rtu import RtuMaster, RtuRefusal
from microdrivers.core.errors import MicrodriversError, RefusedError

DIRECT_DATA = 0x0058
"""Direct data operation: data no., type, position, speed, start rate, stop rate, current, trigger; 32 bits each."""
DRIVER_INPUT = 0x007D
"""Input word; `Input`. Levels: a bit stays on until it is written off."""
DRIVER_OUTPUT = 0x007E
"""Output words, upper (unassigned) and lower; `Output`."""
PRESENT_ALARM = 0x0080
COMMUNICATION_ERROR = 0x00AC
MOTION = 0x00C6
"""Command position (step), command speed (r/min), command speed (step/s), feedback position (step); 32 bits each."""
_MOTION_REGISTERS = 8

_DATA_NUMBER = 0
_ABSOLUTE = 1
_TRIGGER_ALL_DATA = 1

_SLAVE_ERROR = 4
_COMMUNICATION_ERRORS = {
    0x84: "a transmission error",
    0x88: "an undefined command",
    0x89: "another program (the maker's software) is using the drive",
    0x8A: "the drive is busy with its non-volatile memory",
    0x8C: "a setting is out of the drive's range",
    0x8D: "the command is not executable now",
}


class Input(enum.IntFlag):
    """Bits of the input word 007Dh as assigned at the factory. ZHOME and ALM_RST act when they turn on."""

    NONE = 0
    ZHOME = 1 << 4
    STOP = 1 << 5
    ALM_RST = 1 << 7


class Output(enum.IntFlag, boundary=enum.KEEP):
    """Bits of the output word 007Fh as assigned at the factory."""

    NONE = 0
    HOME_END = 1 << 4
    READY = 1 << 5
    INFO = 1 << 6
    ALM_A = 1 << 7
    SYS_BSY = 1 << 8
    MOVE = 1 << 13
    IN_POS = 1 << 14
    TLC = 1 << 15


COORDINATES_ESTABLISHED = Output.HOME_END
"""The output that tells of established coordinates. HOME-END turns on when the home position is reached or preset and
off when an operation starts; assign ABSPEN (177) to R-OUT4 instead to have it on as long as the coordinates hold."""


class Status(NamedTuple):
    """The drive's outputs, sampled at `t_ns`."""

    outputs: Output
    t_ns: int


class Motion(NamedTuple):
    """Command and feedback, sampled together at `t_ns` ± `dt_ns`."""

    command_position: int
    command_speed_hz: int
    feedback_position: int
    t_ns: int
    dt_ns: int


def to_words(value: int) -> tuple[int, int]:
    """A signed or unsigned 32-bit value as upper and lower word."""
    return value >> 16 & 0xFFFF, value & 0xFFFF


def from_words(upper: int, lower: int) -> int:
    """The signed 32-bit value of an upper and a lower word."""
    value = upper << 16 | lower
    return value - (1 << 32) if value & 1 << 31 else value


class AzDrive:
    """One AZ drive on a Modbus line."""

    def __init__(self, rtu: RtuMaster) -> None:
        self._rtu = rtu

    def read_status(self) -> Status:
        """The output word."""
        reply = self._rtu.read(DRIVER_OUTPUT, 2)
        return Status(Output(reply.values[1]), reply.t_ns)

    def read_motion(self) -> Motion:
        """Command and feedback in one exchange."""
        values, t_ns, dt_ns = self._rtu.read(MOTION, _MOTION_REGISTERS)
        return Motion(
            command_position=from_words(values[0], values[1]),
            command_speed_hz=from_words(values[4], values[5]),
            feedback_position=from_words(values[6], values[7]),
            t_ns=t_ns,
            dt_ns=dt_ns,
        )

    def read_alarm(self) -> int:
        """Code of the present alarm, 0 if there is none."""
        return self._read_code(PRESENT_ALARM)

    def read_communication_error(self) -> int:
        """Code of the latest communication error, 0 if there was none since power-on."""
        return self._read_code(COMMUNICATION_ERROR)

    def start_absolute(self, position_steps: int, *, speed_hz: int, rate_hz_s: int, current_permille: int) -> None:
        """Start an absolute positioning operation (direct data operation, all data at once).

        Args:
            position_steps: target.
            speed_hz: steps per second.
            rate_hz_s: both ramps, steps/s² (the drive's unit of 0.001 kHz/s).
            current_permille: current in 0.1 %.

        Raises:
            DeviceFault: refused, and an alarm is on. RefusedError: refused for another reason.
            LinkError: the reply did not come; the motor may move.
        """
        rates = (rate_hz_s, rate_hz_s)
        items = (_DATA_NUMBER, _ABSOLUTE, position_steps, speed_hz, *rates, current_permille, _TRIGGER_ALL_DATA)
        words = [word for item in items for word in to_words(item)]
        try:
            self._rtu.write_block(DIRECT_DATA, words)
        except RtuRefusal as refusal:
            raise self._explain(refusal) from refusal

    def write_input(self, word: Input) -> None:
        """Write the input word.

        Raises:
            DeviceFault, RefusedError, LinkError: as for `start_absolute`.
        """
        try:
            self._rtu.write(DRIVER_INPUT, word)
        except RtuRefusal as refusal:
            raise self._explain(refusal) from refusal

    def pulse_input(self, word: Input) -> None:
        """Turn inputs on and off again: an edge."""
        self.write_input(word)
        self.write_input(Input.NONE)

    def post_stop(self) -> None:
        """Turn STOP on, from any thread, as soon as the line is free. It stays on until the word is written again."""
        self._rtu.post(DRIVER_INPUT, Input.STOP)

    def _read_code(self, address: int) -> int:
        return from_words(*self._rtu.read(address, 2).values)

    def _explain(self, refusal: RtuRefusal) -> MicrodriversError:
        """Exception 04 has many causes: ask the drive which."""
        if refusal.exception_code != _SLAVE_ERROR:
            return refusal
        alarm = self.read_alarm()
        if alarm:
            return alarm_fault(alarm, moved="no", during="the drive refused the command: ")
        code = self.read_communication_error()
        cause = _COMMUNICATION_ERRORS.get(code, "an unknown reason")
        return RefusedError(
            f"{refusal.what}. No alarm is on; communication error {code:02X}h: {cause}",
            remedy="check speed, acceleration, current and curve in the rig file; close the maker's software",
        )
