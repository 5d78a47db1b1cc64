"""The module behind the frames: eight inputs that are converted in turn, and registers that hold the results."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial

import numpy as np

from microdrivers.fakes.modbus import Function, ModbusException, read_registers, write_register, write_registers
from microdrivers.fakes.modbus_analogue.models import CHANNELS, READ_HOLDING, READ_INPUTS, ModuleModel

_ILLEGAL_ADDRESS, _ILLEGAL_VALUE = 2, 3
_UNIT_IDS = range(1, 248)
_MASKS = range(1 << CHANNELS)
_ALL_CHANNELS = _MASKS[-1]

_OPEN_INPUT_NOISE_V = 0.001
"""What an input that nothing is wired to picks up, standard deviation. A choice."""


class AnalogueModule:
    """A `ModbusDevice`: one channel has a signal, nothing is wired to the others.

    A register holds the last conversion of its channel, however often it is read.

    Args:
        signal_V: the voltage on the wired channel at an instant; asked once a conversion, in the order of time.
        channel: the wired one, 1 to 8.
        range_code: what all channels are set to at first.
        seed: of the conversions' phase and of what open inputs pick up.

    Attributes:
        functions: what it can do, by function code.
        powered: a test may switch it off; it then hears nothing.
    """

    def __init__(
        self,
        model: ModuleModel,
        signal_V: Callable[[int], float],
        *,
        unit_id: int,
        channel: int,
        range_code: int,
        seed: int,
    ) -> None:
        self.model = model
        self.powered = True
        self._signal_V = signal_V
        self._wired = channel - 1
        self._wire_broken = False
        self._random = np.random.default_rng((seed, 5))
        self._phase_ns = int(self._random.integers(model.conversion_ns * CHANNELS))
        self._converted_ns = [-(10**18)] * CHANNELS
        self._volts = [0.0] * CHANNELS
        self._range_addresses = range(model.first_range_code, model.first_range_code + CHANNELS)
        self._holding = {**model.constants, **dict.fromkeys(self._range_addresses, range_code)}
        self._allowed: dict[int, Collection[int]] = dict.fromkeys(self._range_addresses, model.ranges)
        self._fixed_unit_id = unit_id
        if model.address_register is not None:
            self._holding[model.address_register] = unit_id
            self._allowed[model.address_register] = _UNIT_IDS
        if model.mask_register is not None:
            # As a laboratory sets it up for one sensor; each further channel makes conversions rarer.
            self._holding[model.mask_register] = 1 << self._wired
            self._allowed[model.mask_register] = _MASKS
        self.functions: Mapping[int, Function] = {
            READ_HOLDING: partial(read_registers, self._read_holding),
            READ_INPUTS: partial(read_registers, self._read_inputs),
            0x06: partial(write_register, self._write),
            0x10: partial(write_registers, self._write),
        }

    # ------------------------------------------------------------------ bench

    @property
    def unit_id(self) -> int:
        """The address that it has been given."""
        register = self.model.address_register
        return self._fixed_unit_id if register is None else self._holding[register]

    @property
    def range_codes(self) -> list[int]:
        """Of channels 1 to 8."""
        return [self._holding[address] for address in self._range_addresses]

    def disconnect(self) -> None:
        """Break the wire: the wired input is pulled down to 0 V from the next conversion on."""
        self._wire_broken = True

    def reconnect(self) -> None:
        """Mend the wire."""
        self._wire_broken = False

    # ------------------------------------------------------------------ slave

    def hears(self, t_ns: int) -> bool:
        """Whether it is switched on."""
        del t_ns
        return self.powered

    def frame_received(self, t_ns: int) -> None:
        """It keeps no account of frames."""

    def frame_lost(self, t_ns: int) -> None:
        """It keeps no account of frames."""

    def request_refused(self, t_ns: int, exception: ModbusException) -> None:
        """It keeps no account of refusals."""

    def advance(self, t_ns: int) -> None:
        """Conversions are made up for when a register is read."""

    def next_event_ns(self) -> int | None:
        """Nothing happens by itself."""
        return None

    # ------------------------------------------------------------------ registers

    def _read_inputs(self, address: int, count: int, t_ns: int) -> list[int]:
        if address + count > CHANNELS:
            raise ModbusException(_ILLEGAL_ADDRESS)
        return [self._input(index, t_ns) for index in range(address, address + count)]

    def _read_holding(self, address: int, count: int, t_ns: int) -> list[int]:
        if READ_HOLDING in self.model.input_functions and address < CHANNELS:
            return self._read_inputs(address, count, t_ns)
        addresses = range(address, address + count)
        if not all(each in self._holding for each in addresses):
            raise ModbusException(_ILLEGAL_ADDRESS)
        return [self._holding[each] for each in addresses]

    def _write(self, address: int, values: Sequence[int], t_ns: int) -> None:
        del t_ns
        new = dict(enumerate(values, start=address))
        if not all(each in self._allowed for each in new):
            raise ModbusException(_ILLEGAL_ADDRESS)
        if not all(value in self._allowed[each] for each, value in new.items()):
            raise ModbusException(_ILLEGAL_VALUE)
        self._holding.update(new)

    # ------------------------------------------------------------------ conversion

    def _input(self, index: int, t_ns: int) -> int:
        converted_ns = self._last_conversion_ns(index, t_ns)
        if converted_ns is not None and converted_ns > self._converted_ns[index]:
            self._converted_ns[index] = converted_ns
            self._volts[index] = self._voltage(index, converted_ns)
        return self.model.word(self._volts[index], self.range_codes[index])

    def _last_conversion_ns(self, index: int, t_ns: int) -> int | None:
        """When a channel was converted last; None if it takes no turns, so that its register holds what it held."""
        register = self.model.mask_register
        mask = _ALL_CHANNELS if register is None else self._holding[register]
        if not mask >> index & 1:
            return None
        turn = (mask & ((1 << index) - 1)).bit_count()
        first_ns = self._phase_ns + turn * self.model.conversion_ns
        period_ns = mask.bit_count() * self.model.conversion_ns
        return t_ns - (t_ns - first_ns) % period_ns

    def _voltage(self, index: int, t_ns: int) -> float:
        if index != self._wired:
            return float(self._random.normal(0.0, _OPEN_INPUT_NOISE_V))
        return 0.0 if self._wire_broken else self._signal_V(t_ns)
