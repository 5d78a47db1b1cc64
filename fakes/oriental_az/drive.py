"""Registers, inputs, outputs and alarms of an AZ drive (Oriental Motor HM-60262E, HP-5142E; 32-bit pairs)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from microdrivers.core.units import NS_PER_MS
from microdrivers.fakes.oriental_az.motor import STEPS_PER_REVOLUTION, Motor
from microdrivers.fakes.oriental_az.rtu import (
    NOT_EXECUTABLE,
    NV_MEMORY_BUSY,
    OUT_OF_RANGE,
    RS485_ERROR,
    UNDEFINED_COMMAND,
    ModbusException,
)
from microdrivers.fakes.world.axis import Axis

INT32 = (-(2**31), 2**31 - 1)

# Direct data operation: one item each, then the trigger.
DATA_NUMBER, TYPE, POSITION, SPEED, START_RATE, STOP_RATE, CURRENT = range(0x58, 0x66, 2)
TRIGGER, DESTINATION = 0x66, 0x68
PULSED_INPUT, INPUT, OUTPUT = 0x78, 0x7C, 0x7E
PRESENT_ALARM, COMMUNICATION_ERROR = 0x80, 0xAC
ALARM_RESET, CLEAR_HISTORY, PRESET_POSITION, CONFIGURE = 0x180, 0x184, 0x18A, 0x18C
WORD_ORDER, RESPONSE_TIMEOUT_MS, ERRORS_TO_ALARM, ERROR_ANSWERS = 0x1384, 0x138A, 0x138C, 0x1392

_TYPES = (1, 3)
"""Absolute, incremental from the command, incremental from the feedback position; no other is emulated."""

_WRITABLE: dict[int, tuple[int, int, int]] = {
    DATA_NUMBER: (0, 255, 0),
    TYPE: (*_TYPES, 2),
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
    WORD_ORDER: (0, 0, 0),
    RESPONSE_TIMEOUT_MS: (0, 10_000, 0),
    ERRORS_TO_ALARM: (0, 10, 3),
    ERROR_ANSWERS: (0, 1, 1),
}
"""Address of the upper word: lowest, highest, initial value. A rate's unit, 0.001 kHz/s, is 1 step/s²."""

_START, _ZHOME, _STOP, _FREE, _ALARM_RESET_INPUT = 1 << 3, 1 << 4, 1 << 5, 1 << 6, 1 << 7
_SELECTION, _ECHOED_INPUTS = 0x7, 0xF
_HOME_END, _READY, _ALARM, _BUSY, _MOVE, _IN_POSITION = 1 << 4, 1 << 5, 1 << 7, 1 << 8, 1 << 13, 1 << 14

_ALARMS_UNTIL_POWER_OFF = frozenset({0x20, 0x28, 0x41, 0x42, 0xF0})
_HISTORY_PAIRS = range(PRESENT_ALARM + 2, PRESENT_ALARM + 22, 2)
_NV_WRITE_NS = 100 * NS_PER_MS
_ZHOME_SPEED_HZ, _ZHOME_RATE = 5000.0, 1_000_000.0
_DRIVER_TEMPERATURE, _MOTOR_TEMPERATURE = 352, 301


class AzDrive:
    """What lies behind the drive's RS-485 port. At first it is excited and its coordinates are established.

    HOME-END tells at all times, also in motion, whether they are.

    Attributes:
        log: what concerned motion, as (t_ns, text): "move 8500" (target in steps), "zhome", "start data 0",
            "stop", "free", "excite", "alarm 4A", "alarm reset", "preset".

    Args:
        axis: the motor's shaft in the world; unit: motor step.
        software_limits_steps: beyond them the motor stops with alarm 67h; never, by default.
    """

    def __init__(self, axis: Axis, *, seed: int, software_limits_steps: tuple[int, int] = INT32) -> None:
        self.log: list[tuple[int, str]] = []
        self._motor = Motor(axis, seed=seed)
        self._random = np.random.default_rng(seed + 2)
        self._limits_steps = software_limits_steps
        self._values = {address: initial for address, (_, _, initial) in _WRITABLE.items()}
        self._coordinates = True
        self._alarm = 0
        self._history = [0] * len(_HISTORY_PAIRS)
        self._error = 0
        self._frames_lost = 0
        self._stop_rate = _ZHOME_RATE
        self._busy_until_ns = -(10**18)
        self._heard_ns: int | None = None
        self._leaves_limits_ns: int | None = None
        self._monitors: dict[int, Callable[[int], float]] = {
            OUTPUT: self._outputs,
            PRESENT_ALARM: lambda _: self._alarm,
            COMMUNICATION_ERROR: lambda _: self._error,
            0xC2: lambda _: self._values[INPUT] & _SELECTION,
            0xC6: self._motor.command_steps,
            0xC8: lambda t_ns: self._motor.command_speed_hz(t_ns) * 60 / STEPS_PER_REVOLUTION,
            0xCA: self._motor.command_speed_hz,
            0xCC: self._motor.feedback_steps,
            0xCE: lambda t_ns: self._motor.feedback_speed_hz(t_ns) * 60 / STEPS_PER_REVOLUTION,
            0xD0: self._motor.feedback_speed_hz,
            0xF8: lambda _: self._temperature(_DRIVER_TEMPERATURE),
            0xFA: lambda _: self._temperature(_MOTOR_TEMPERATURE),
        }

    # ------------------------------------------------------------------ what happens to the drive

    @property
    def hides_slave_errors(self) -> bool:
        """Whether exception 04 is replaced by a normal reply (1392h = 0)."""
        return self._values[ERROR_ANSWERS] == 0

    @property
    def alarm(self) -> int:
        """Present alarm, 0 if there is none."""
        return self._alarm

    def lose_coordinates(self, t_ns: int) -> None:
        """The absolute position is lost: counting begins at 0 wherever the shaft is."""
        self._coordinates = False
        self._motor.define_position(t_ns, 0)

    def raise_alarm(self, t_ns: int, code: int) -> None:
        """Brake and refuse motion until the alarm is reset; a present alarm stays the first one."""
        self.advance(t_ns)
        self._raise_alarm(t_ns, code)

    def _raise_alarm(self, t_ns: int, code: int) -> None:
        if not self._alarm:
            self._alarm = code
            self._history = [code, *self._history[:-1]]
            self._log(t_ns, f"alarm {code:02X}")
            self._halt(t_ns)

    # ------------------------------------------------------------------ time

    def advance(self, t_ns: int) -> None:
        """Let what falls due by itself happen: a software limit, the communication time-out."""
        while (due_ns := self.next_event_ns()) is not None and due_ns <= t_ns:
            if due_ns == self._leaves_limits_ns:
                self._raise_alarm(due_ns, 0x67)
                self._leaves_limits_ns = None
            else:
                self._heard_ns = None
                self._raise_alarm(due_ns, 0x85)

    def next_event_ns(self) -> int | None:
        """When that is."""
        times = [] if self._leaves_limits_ns is None else [self._leaves_limits_ns]
        timeout_ms = self._values[RESPONSE_TIMEOUT_MS]
        if timeout_ms and self._heard_ns is not None:
            times.append(self._heard_ns + timeout_ms * NS_PER_MS)
        return min(times, default=None)

    # ------------------------------------------------------------------ communication

    def frame_received(self, t_ns: int) -> None:
        """A sound frame for this drive: the time-out starts anew and lost frames are forgotten."""
        self.advance(t_ns)
        self._heard_ns = t_ns
        self._frames_lost = 0

    def communication_error(self, t_ns: int, error: int, *, frame_lost: bool) -> None:
        """Keep the error; alarm 84h after as many lost frames in a row as 138Ch says (0: never)."""
        self.advance(t_ns)
        self._error = error
        if frame_lost:
            self._frames_lost += 1
            if self._frames_lost == self._values[ERRORS_TO_ALARM]:
                self._raise_alarm(t_ns, RS485_ERROR)

    def read(self, address: int, count: int, t_ns: int) -> list[int]:
        """Words at `t_ns`; both halves of a pair belong to one reading."""
        self.advance(t_ns)
        pairs = {}
        for even in range(address & ~1, address + count, 2):
            if even in self._monitors:
                pairs[even] = round(self._monitors[even](t_ns)) & 0xFFFFFFFF
            elif even in self._values:
                pairs[even] = self._values[even] & 0xFFFFFFFF
            elif even in _HISTORY_PAIRS:
                pairs[even] = self._history[_HISTORY_PAIRS.index(even)]
            else:
                raise ModbusException(2, UNDEFINED_COMMAND)
        return [_half(pairs[at & ~1], at) for at in range(address, address + count)]

    def write(self, address: int, values: Sequence[int], t_ns: int) -> None:
        """Check everything, then store, then act."""
        self.advance(t_ns)
        new = self._merge(address, values)
        armed = self._values[TRIGGER]
        starts = new.get(TRIGGER) == 1 or (armed < 0 and TRIGGER + 2 * armed in new)
        rising = {even for even, value in new.items() if value == 1 and self._values[even] == 0}
        self._check(t_ns, new, starts, rising)
        inputs = self._values[INPUT]
        self._values.update(new)
        if starts:
            self._values[TRIGGER] = min(0, new.get(TRIGGER, 0))
            self._start_direct_data(t_ns)
        if PULSED_INPUT in new:
            self._values[PULSED_INPUT] = 0
            self._apply_inputs(t_ns, inputs, inputs | new[PULSED_INPUT])
            self._apply_inputs(t_ns, inputs | new[PULSED_INPUT], inputs)
        self._apply_inputs(t_ns, inputs, self._values[INPUT])
        self._maintain(t_ns, rising)

    def _check(self, t_ns: int, new: dict[int, int], starts: bool, rising: set[int]) -> None:
        if t_ns < self._busy_until_ns:
            raise ModbusException(4, NV_MEMORY_BUSY)
        for even, value in new.items():
            lowest, highest, _ = _WRITABLE[even]
            if not lowest <= value <= highest:
                raise ModbusException(4, OUT_OF_RANGE)
        writes_nv = bool(rising & {PRESET_POSITION, CONFIGURE})
        if (starts and not self._may_move()) or (writes_nv and self._motor.moving(t_ns)):
            raise ModbusException(4, NOT_EXECUTABLE)

    def _merge(self, address: int, values: Sequence[int]) -> dict[int, int]:
        """New signed values of the pairs that a write touches; the untouched half of a pair stays."""
        words = dict(enumerate(values, address))
        new = {}
        for even in range(address & ~1, address + len(values), 2):
            if even not in self._values:
                raise ModbusException(2, UNDEFINED_COMMAND)
            old = self._values[even]
            upper, lower = (words.get(at, _half(old, at)) for at in (even, even + 1))
            value = upper << 16 | lower
            new[even] = value - (1 << 32) if value >> 31 else value
        return new

    # ------------------------------------------------------------------ inputs, outputs, maintenance

    def _outputs(self, t_ns: int) -> int:
        moving = self._motor.moving(t_ns)
        busy = t_ns < self._busy_until_ns
        bits = self._values[INPUT] & _ECHOED_INPUTS
        for bit, on in (
            (_HOME_END, self._coordinates),
            (_READY, not moving and not busy and self._may_move()),
            (_ALARM, bool(self._alarm)),
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
        if ALARM_RESET in rising:
            self._reset_alarm(t_ns)
        if CLEAR_HISTORY in rising:
            self._history = [0] * len(_HISTORY_PAIRS)
        if PRESET_POSITION in rising:
            self._coordinates = True
            self._motor.define_position(t_ns, 0)
            self._log(t_ns, "preset")
        if rising & {CLEAR_HISTORY, PRESET_POSITION, CONFIGURE}:
            self._busy_until_ns = t_ns + _NV_WRITE_NS

    def _reset_alarm(self, t_ns: int) -> None:
        if self._alarm and self._alarm not in _ALARMS_UNTIL_POWER_OFF:
            self._alarm = 0
            self._frames_lost = 0
            self._log(t_ns, "alarm reset")

    # ------------------------------------------------------------------ motion

    def _may_move(self) -> bool:
        return not self._alarm and not self._values[INPUT] & (_STOP | _FREE)

    def _halt(self, t_ns: int) -> None:
        self._leaves_limits_ns = None
        self._motor.stop(t_ns, stop_rate=self._stop_rate)

    def _return_home(self, t_ns: int) -> None:
        if not self._coordinates:
            self._raise_alarm(t_ns, 0x4A)
            return
        self._log(t_ns, "zhome")
        self._move(t_ns, 0, _ZHOME_SPEED_HZ, _ZHOME_RATE, _ZHOME_RATE)

    def _start_stored_data(self, t_ns: int, number: int) -> None:
        """The emulated registers do not reach stored data, so it is as new: an increment of 0 steps."""
        self._log(t_ns, f"start data {number}")

    def _start_direct_data(self, t_ns: int) -> None:
        values = self._values
        if values[SPEED] == 0:
            self._raise_alarm(t_ns, 0x70)
            return
        if values[TYPE] == 1 and not self._coordinates:
            self._raise_alarm(t_ns, 0x4A)
            return
        base = {1: lambda _: 0, 2: self._motor.command_steps, 3: self._motor.feedback_steps}[values[TYPE]]
        target = base(t_ns) + values[POSITION]
        self._log(t_ns, f"move {target}")
        self._move(t_ns, target, abs(values[SPEED]), values[START_RATE], values[STOP_RATE])

    def _move(self, t_ns: int, target: int, speed_hz: float, start_rate: float, stop_rate: float) -> None:
        self._stop_rate = stop_rate
        self._motor.move(t_ns, target, speed_hz=speed_hz, start_rate=start_rate, stop_rate=stop_rate)
        self._leaves_limits_ns = self._motor.time_outside(*self._limits_steps)

    def _temperature(self, tenths_c: int) -> int:
        return tenths_c + int(self._random.integers(-3, 4))

    def _log(self, t_ns: int, text: str) -> None:
        self.log.append((t_ns, text))


def _half(pair: int, address: int) -> int:
    """Upper word at the even address, lower word at the odd one."""
    return pair & 0xFFFF if address & 1 else pair >> 16 & 0xFFFF
