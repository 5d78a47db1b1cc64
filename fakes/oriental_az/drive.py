"""What an AZ drive does: inputs, outputs, motion, alarms, monitors (Oriental Motor HM-60262E, HP-5142E)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.fakes.modbus import (
    Function,
    ModbusException,
    diagnose,
    read_registers,
    read_write_registers,
    write_register,
    write_registers,
)
from microdrivers.fakes.modbus.functions import ILLEGAL_ADDRESS
from microdrivers.fakes.oriental_az import alarms
from microdrivers.fakes.oriental_az import register_map as reg
from microdrivers.fakes.oriental_az.alarms import Alarms, DriveError
from microdrivers.fakes.oriental_az.monitors import motor_monitors
from microdrivers.fakes.oriental_az.motor import Motor
from microdrivers.fakes.world.axis import Axis

_START, _ZHOME, _STOP, _FREE, _ALARM_RESET_INPUT = 1 << 3, 1 << 4, 1 << 5, 1 << 6, 1 << 7
_SELECTION, _ECHOED_INPUTS = 0x7, 0xF
_HOME_END, _READY, _ALARM, _BUSY, _MOVE, _IN_POSITION = 1 << 4, 1 << 5, 1 << 7, 1 << 8, 1 << 13, 1 << 14

_NV_WRITE_NS = 100 * NS_PER_MS
_POWER_ON_NS = NS_PER_S
"""From switching on to the first query that is heard."""

_NEVER_NS = -(10**18)
_ZHOME_SPEED_HZ, _ZHOME_RATE = 5000.0, 1_000_000.0


class AzDrive:
    """What lies behind the drive's RS-485 port; a `ModbusDevice`.

    At first it is excited and its coordinates are established. HOME-END tells at all times, also in motion, whether
    they are.

    Attributes:
        functions: the Modbus functions that it has.
        log: what concerned motion, as (t_ns, text): "move 8500" (target in steps), "zhome", "start data 0",
            "stop", "free", "excite", "alarm 4A", "alarm reset", "preset", "power on".

    Args:
        axis: the motor's shaft in the world; unit: motor step.
        software_limits_steps: beyond them the motor stops with alarm 67h; never, by default.
    """

    def __init__(self, axis: Axis, *, seed: int, software_limits_steps: tuple[int, int] = reg.INT32) -> None:
        self.functions: Mapping[int, Function] = {
            0x03: partial(read_registers, self.read),
            0x06: partial(write_register, self.write),
            0x08: diagnose,
            0x10: partial(write_registers, self.write),
            0x17: partial(read_write_registers, self.read, self.write),
        }
        self.log: list[tuple[int, str]] = []
        self._motor = Motor(axis, seed=seed)
        self._limits_steps = software_limits_steps
        self._as_set_up = {address: initial for address, (_, _, initial) in reg.WRITABLE.items()}
        self._coordinates = True
        self._alarms = Alarms(len(reg.ALARM_HISTORY))
        self._stop_rate = _ZHOME_RATE
        self._leaves_limits_ns: int | None = None
        self._awake_ns = _NEVER_NS
        self._start_up()
        self._monitors: dict[int, Callable[[int], float]] = motor_monitors(self._motor, seed=seed + 2) | {
            reg.OUTPUT: self._outputs,
            reg.PRESENT_ALARM: lambda _: self._alarms.present,
            reg.COMMUNICATION_ERROR: lambda _: self._error,
            reg.SELECTED_DATA: lambda _: self._values[reg.INPUT] & _SELECTION,
        }

    # ------------------------------------------------------------------ what happens to the drive

    @property
    def alarm(self) -> int:
        """Present alarm, 0 if there is none."""
        return self._alarms.present

    def set_up(self, parameter: int, value: int) -> None:
        """Somebody sets a parameter with the maker's software: it holds at once, and for good."""
        self._as_set_up[parameter] = self._values[parameter] = value
        self._order = self._values[reg.BYTE_WORD_ORDER]

    def lose_coordinates(self, t_ns: int) -> None:
        """The absolute position is lost: counting begins at 0 wherever the shaft is."""
        self._coordinates = False
        self._motor.define_position(t_ns, 0)

    def raise_alarm(self, t_ns: int, code: int) -> None:
        """Brake and refuse motion until the alarm is reset; a present alarm stays the first one."""
        self.advance(t_ns)
        self._raise_alarm(t_ns, code)

    def _raise_alarm(self, t_ns: int, code: int) -> None:
        if self._alarms.happen(code):
            self._log(t_ns, f"alarm {code:02X}")
            self._halt(t_ns)

    def power_cycle(self, t_ns: int) -> None:
        """Off and on again: every alarm is over, the absolute encoder still knows where it is.

        For a second the drive hears nothing. Registers are as it was set up: what a host has written was never put
        into the non-volatile memory, for which this emulator has no command.
        """
        self.advance(t_ns)
        self._halt(t_ns)
        self._alarms.switch_off()
        self._start_up()
        self._awake_ns = t_ns + _POWER_ON_NS
        self._log(t_ns, "power on")

    def _start_up(self) -> None:
        self._values = dict(self._as_set_up)
        self._order = self._values[reg.BYTE_WORD_ORDER]
        self._error = 0
        self._frames_lost = 0
        self._heard_ns: int | None = None
        self._busy_until_ns = _NEVER_NS

    # ------------------------------------------------------------------ time

    def advance(self, t_ns: int) -> None:
        """Let what falls due by itself happen: a software limit, the communication time-out."""
        while (due_ns := self.next_event_ns()) is not None and due_ns <= t_ns:
            if due_ns == self._leaves_limits_ns:
                self._raise_alarm(due_ns, alarms.OUTSIDE_SOFTWARE_LIMITS)
                self._leaves_limits_ns = None
            else:
                self._heard_ns = None
                self._raise_alarm(due_ns, alarms.RS485_TIMEOUT)

    def next_event_ns(self) -> int | None:
        """When that is."""
        times = [] if self._leaves_limits_ns is None else [self._leaves_limits_ns]
        timeout_ms = self._values[reg.RESPONSE_TIMEOUT_MS]
        if timeout_ms and self._heard_ns is not None:
            times.append(self._heard_ns + timeout_ms * NS_PER_MS)
        return min(times, default=None)

    # ------------------------------------------------------------------ communication

    def hears(self, t_ns: int) -> bool:
        """Not while it starts up."""
        return t_ns >= self._awake_ns

    def frame_received(self, t_ns: int) -> None:
        """A sound frame for this drive: the time-out starts anew and lost frames are forgotten."""
        self.advance(t_ns)
        self._heard_ns = t_ns
        self._frames_lost = 0

    def frame_lost(self, t_ns: int) -> None:
        """Alarm 84h after as many lost frames in a row as 138Ch says (0: never)."""
        self.advance(t_ns)
        self._error = alarms.RS485_ERROR
        self._frames_lost += 1
        if self._frames_lost == self._values[reg.ERRORS_TO_ALARM]:
            self._raise_alarm(t_ns, alarms.RS485_ERROR)

    def request_refused(self, t_ns: int, exception: ModbusException) -> None:
        """Keep the reason in 00ACh."""
        self.advance(t_ns)
        self._error = alarms.communication_error(exception)

    def read(self, address: int, count: int, t_ns: int) -> list[int]:
        """Words at `t_ns`; both halves of a pair belong to one reading."""
        self.advance(t_ns)
        words: list[int] = []
        for even in range(address & ~1, address + count, 2):
            words += reg.to_words(self._pair(even, t_ns), self._order)
        return words[address & 1 :][:count]

    def _pair(self, even: int, t_ns: int) -> int:
        if even in self._monitors:
            return round(self._monitors[even](t_ns))
        if even in self._values:
            return self._values[even]
        if even in reg.ALARM_HISTORY:
            return self._alarms.history[reg.ALARM_HISTORY.index(even)]
        raise ModbusException(ILLEGAL_ADDRESS)

    def write(self, address: int, values: Sequence[int], t_ns: int) -> None:
        """Check everything, then store, then act. With 1392h = 0, exception 04 is hidden behind a normal reply."""
        self.advance(t_ns)
        try:
            self._write(self._merge(address, values), t_ns)
        except DriveError as error:
            if self._values[reg.ERROR_ANSWERS]:
                raise
            self.request_refused(t_ns, error)

    def _write(self, new: dict[int, int], t_ns: int) -> None:
        armed = self._values[reg.TRIGGER]
        starts = new.get(reg.TRIGGER) == 1 or (armed < 0 and reg.TRIGGER + 2 * armed in new)
        rising = {even for even, value in new.items() if value == 1 and self._values[even] == 0}
        self._check(t_ns, new, starts, rising)
        inputs = self._values[reg.INPUT]
        self._values.update(new)
        if starts:
            self._values[reg.TRIGGER] = min(0, new.get(reg.TRIGGER, 0))
            self._start_direct_data(t_ns)
        if reg.PULSED_INPUT in new:
            self._values[reg.PULSED_INPUT] = 0
            self._apply_inputs(t_ns, inputs, inputs | new[reg.PULSED_INPUT])
            self._apply_inputs(t_ns, inputs | new[reg.PULSED_INPUT], inputs)
        self._apply_inputs(t_ns, inputs, self._values[reg.INPUT])
        self._maintain(t_ns, rising)

    def _check(self, t_ns: int, new: dict[int, int], starts: bool, rising: set[int]) -> None:
        if t_ns < self._busy_until_ns:
            raise DriveError(alarms.NV_MEMORY_BUSY)
        for even, value in new.items():
            lowest, highest, _ = reg.WRITABLE[even]
            if not lowest <= value <= highest:
                raise DriveError(alarms.OUT_OF_RANGE)
        writes_nv = bool(rising & {reg.PRESET_POSITION, reg.CONFIGURE})
        if (starts and not self._may_move()) or (writes_nv and self._motor.moving(t_ns)):
            raise DriveError(alarms.NOT_EXECUTABLE)

    def _merge(self, address: int, values: Sequence[int]) -> dict[int, int]:
        """New signed values of the pairs that a write touches; the untouched half of a pair stays."""
        words = dict(enumerate(values, address))
        new = {}
        for even in range(address & ~1, address + len(values), 2):
            if even not in self._values:
                raise ModbusException(ILLEGAL_ADDRESS)
            old = reg.to_words(self._values[even], self._order)
            new[even] = reg.from_words(words.get(even, old[0]), words.get(even + 1, old[1]), self._order)
        return new

    # ------------------------------------------------------------------ inputs, outputs, maintenance

    def _outputs(self, t_ns: int) -> int:
        moving = self._motor.moving(t_ns)
        busy = t_ns < self._busy_until_ns
        bits = self._values[reg.INPUT] & _ECHOED_INPUTS
        for bit, on in (
            (_HOME_END, self._coordinates),
            (_READY, not moving and not busy and self._may_move()),
            (_ALARM, bool(self._alarms.present)),
            (_BUSY, busy),
            (_MOVE, moving),
            (_IN_POSITION, self._motor.in_position(t_ns)),
        ):
            bits |= bit if on else 0
        return bits

    def _apply_inputs(self, t_ns: int, before: int, after: int) -> None:
        on, off = after & ~before, before & ~after
        if on & _STOP:
            self._log(t_ns, "stop")
            self._halt(t_ns)
        if on & _FREE:
            self._log(t_ns, "free")
            self._halt(t_ns)
        if off & _FREE:
            self._log(t_ns, "excite")
        if on & _ALARM_RESET_INPUT:
            self._reset_alarm(t_ns)
        if self._may_move() and not after & (_STOP | _FREE) and not self._motor.moving(t_ns):
            if on & _ZHOME:
                self._return_home(t_ns)
            elif on & _START:
                self._start_stored_data(t_ns, after & _SELECTION)

    def _maintain(self, t_ns: int, rising: set[int]) -> None:
        if reg.ALARM_RESET in rising:
            self._reset_alarm(t_ns)
        if reg.CLEAR_HISTORY in rising:
            self._alarms.clear_history()
        if reg.PRESET_POSITION in rising:
            self._coordinates = True
            self._motor.define_position(t_ns, 0)
            self._log(t_ns, "preset")
        if reg.CONFIGURE in rising:
            self._order = self._values[reg.BYTE_WORD_ORDER]
        if rising & {reg.CLEAR_HISTORY, reg.PRESET_POSITION, reg.CONFIGURE}:
            self._busy_until_ns = t_ns + _NV_WRITE_NS

    def _reset_alarm(self, t_ns: int) -> None:
        if self._alarms.reset():
            self._frames_lost = 0
            self._log(t_ns, "alarm reset")

    # ------------------------------------------------------------------ motion

    def _may_move(self) -> bool:
        return not self._alarms.present and not self._values[reg.INPUT] & (_STOP | _FREE)

    def _halt(self, t_ns: int) -> None:
        self._leaves_limits_ns = None
        self._motor.stop(t_ns, stop_rate=self._stop_rate)

    def _return_home(self, t_ns: int) -> None:
        if not self._coordinates:
            self._raise_alarm(t_ns, alarms.COORDINATES_UNKNOWN)
            return
        self._log(t_ns, "zhome")
        self._move(t_ns, 0, _ZHOME_SPEED_HZ, _ZHOME_RATE, _ZHOME_RATE)

    def _start_stored_data(self, t_ns: int, number: int) -> None:
        """The emulated registers do not reach stored data, so it is as new: an increment of 0 steps."""
        self._log(t_ns, f"start data {number}")

    def _start_direct_data(self, t_ns: int) -> None:
        values = self._values
        if values[reg.SPEED] == 0:
            self._raise_alarm(t_ns, alarms.BAD_OPERATION_DATA)
            return
        if values[reg.TYPE] == 1 and not self._coordinates:
            self._raise_alarm(t_ns, alarms.COORDINATES_UNKNOWN)
            return
        base = {1: lambda _: 0, 2: self._motor.command_steps, 3: self._motor.feedback_steps}[values[reg.TYPE]]
        target = base(t_ns) + values[reg.POSITION]
        self._log(t_ns, f"move {target}")
        self._move(t_ns, target, abs(values[reg.SPEED]), values[reg.START_RATE], values[reg.STOP_RATE])

    def _move(self, t_ns: int, target: int, speed_hz: float, start_rate: float, stop_rate: float) -> None:
        self._stop_rate = stop_rate
        self._motor.move(t_ns, target, speed_hz=speed_hz, start_rate=start_rate, stop_rate=stop_rate)
        self._leaves_limits_ns = self._motor.time_outside(*self._limits_steps)

    def _log(self, t_ns: int, text: str) -> None:
        self.log.append((t_ns, text))
