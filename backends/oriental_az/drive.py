"""The AZ drive's registers, and what can be asked of it.

Addresses, units and bits as the drive leaves the factory (Oriental Motor HP-5142E; AZ: bits of 007Dh and 007Fh). All
values have 32 bits, an even address and the odd one behind it; both words go in one query.
"""

from __future__ import annotations

import enum
import functools
from collections.abc import Sequence
from typing import NamedTuple

from microdrivers.backends.modbus.master import ModbusMaster, ModbusRefusal
from microdrivers.backends.modbus.register_order import RegisterOrder
from microdrivers.backends.oriental_az.alarms import alarm_fault
from microdrivers.core.errors import DeviceFault, MicrodriversError, Moved, RefusedError

DIRECT_DATA = 0x0058
"""Direct data operation: data no., type, position, speed, start rate, stop rate, current, trigger; 32 bits each."""
DRIVER_INPUT = 0x007C
"""Input words, upper (unused here) and lower; `Input`. Levels: a bit stays on until it is written off."""
DRIVER_OUTPUT = 0x007E
"""Output words, upper (unassigned) and lower; `Output`."""
PRESENT_ALARM = 0x0080
COMMUNICATION_ERROR = 0x00AC
MOTION = 0x00C6
"""Command position (step), command speed (r/min), command speed (step/s), feedback position (step); 32 bits each."""
_MOTION_REGISTERS = 8

FACTORY_ORDER = RegisterOrder("high-first", "big")

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


class AzDrive:
    """One AZ drive on a Modbus line.

    Attributes:
        communication_timeout_s: the drive's, as far as it is known; 0 if it does not watch the host.
    """

    def __init__(self, modbus: ModbusMaster, order: RegisterOrder = FACTORY_ORDER) -> None:
        self.communication_timeout_s = 0.0
        self._modbus = modbus
        self._order = order

    def read_status(self) -> Status:
        """The output word."""
        reply = self._modbus.read(DRIVER_OUTPUT, 2)
        return Status(_outputs(self._order, reply.values), reply.t_ns)

    def read_motion(self) -> Motion:
        """Command and feedback in one exchange."""
        values, t_ns, dt_ns = self._modbus.read(MOTION, _MOTION_REGISTERS)
        decoded = self._order.from_registers
        return Motion(
            command_position=decoded(values[0], values[1]),
            command_speed_hz=decoded(values[4], values[5]),
            feedback_position=decoded(values[6], values[7]),
            t_ns=t_ns,
            dt_ns=dt_ns,
        )

    def read_alarm(self) -> int:
        """Code of the present alarm, 0 if there is none."""
        return self.read_value(PRESENT_ALARM)

    def read_communication_error(self) -> int:
        """Code of the latest communication error, 0 if there was none since power-on."""
        return self.read_value(COMMUNICATION_ERROR)

    def read_value(self, address: int) -> int:
        """One value."""
        return self._order.from_registers(*self._modbus.read(address, 2).values)

    def write_value(self, address: int, value: int) -> None:
        """Write one value.

        Raises:
            DeviceFault, RefusedError, LinkError: as for `start_absolute`.
        """
        self._write(address, self._order.to_registers(value))

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
        self._write(DIRECT_DATA, [register for item in items for register in self._order.to_registers(item)])

    def write_input(self, word: Input) -> None:
        """Write the input word.

        Raises:
            DeviceFault, RefusedError, LinkError: as for `start_absolute`.
        """
        self._write(*self._input_registers(word))

    def pulse_input(self, word: Input) -> None:
        """Turn inputs on and off again: an edge."""
        self.write_input(word)
        self.write_input(Input.NONE)

    def post_stop(self) -> None:
        """Turn STOP on, from any thread, as soon as the line is free. It stays on until the word is written again."""
        self._modbus.post(*self._input_registers(Input.STOP))

    def fault(self, alarm_code: int, *, moved: Moved, during: str = "") -> DeviceFault:
        """The error for an alarm of this drive that is on; `during` begins the sentence."""
        return alarm_fault(alarm_code, moved=moved, during=during, communication_timeout_s=self.communication_timeout_s)

    def _input_registers(self, word: Input) -> tuple[int, Sequence[int]]:
        """Address and registers of the input word; in an order that is not the factory's, never one of them alone."""
        if self._order == FACTORY_ORDER:
            return DRIVER_INPUT + 1, (word,)
        return DRIVER_INPUT, self._order.to_registers(word)

    def _write(self, address: int, registers: Sequence[int]) -> None:
        try:
            if len(registers) == 1:
                self._modbus.write(address, registers[0])
            else:
                self._modbus.write_block(address, registers)
        except ModbusRefusal as refusal:
            raise self._explain(refusal) from refusal

    def _explain(self, refusal: ModbusRefusal) -> MicrodriversError:
        """Exception 04 has many causes: ask the drive which."""
        if refusal.exception_code != _SLAVE_ERROR:
            return refusal
        alarm = self.read_alarm()
        if alarm:
            return self.fault(alarm, moved="no", during="the drive refused the command: ")
        code = self.read_communication_error()
        cause = _COMMUNICATION_ERRORS.get(code, "an unknown reason")
        return RefusedError(
            f"{refusal.what}. No alarm is on; communication error {code:02X}h: {cause}",
            remedy="check speed, acceleration, current and curve in the rig file; close the maker's software",
        )


@functools.lru_cache(maxsize=256)  # they change when a motion begins or ends
def _outputs(order: RegisterOrder, registers: tuple[int, int]) -> Output:
    return Output(order.from_registers(*registers) & 0xFFFF)
