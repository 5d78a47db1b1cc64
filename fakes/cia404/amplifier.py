"""A measuring amplifier with one channel (CiA 404): the voltage of a force probe becomes a process value."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass

from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.fakes.canopen import (
    AbortCode,
    CanOpenNode,
    Entry,
    Identity,
    Loss,
    PdoDefaults,
    SdoAbort,
    Temper,
)
from microdrivers.fakes.canopen.data_types import I32, REAL32, U8, U16, U32, Value
from microdrivers.fakes.canopen.emergency import HEARTBEAT_LOST

AMPLIFIER = 0x00020194
"""1000h of a device with an analogue-input block."""

SENSOR_FAULT = 0x7300
NANONEWTON, MICRONEWTON, MILLINEWTON, NEWTON = 0xF7210000, 0xFA210000, 0xFD210000, 0x00210000
"""6131h: SI prefix as a power of ten, and the newton (CiA 303-2)."""

VALID, NOT_VALID, OVERFLOW, UNDERFLOW = 0x00, 0x01, 0x03, 0x05
"""6150h."""

_AUTOZERO = int.from_bytes(b"zero", "little")
_AUTOZERO_SAMPLES = 8
_NORMAL_OPERATION = 1
_STRAIN_LINK = 70
_SAMPLES_HZ = 10_000
_SAMPLE_NS = NS_PER_S // _SAMPLES_HZ
_FLOATING_V = 0.005
_INT32 = (1 << 31) - 1
_LARGEST_FACTOR = 1e12
_MOST_DIGITS = 6
_PRODUCT_CODE = 0x0404
_SERIAL_NUMBERS = 4_040_000

_TRANSMIT = (
    PdoDefaults([(0x9130, 1), (0x6150, 1)], transmission=1),
    PdoDefaults([(0x6130, 1), (0x6150, 1)], transmission=1, valid=False),
)


@dataclass(frozen=True)
class InputSpec:
    """The amplifier's input, as it is set up for a probe.

    Attributes:
        zero_V, sensitivity_uN_per_V: of the probe, as its certificate says.
        input_V: beyond it the converter overflows.
        resolution_V: its smallest step.
    """

    zero_V: float
    sensitivity_uN_per_V: float
    input_V: tuple[float, float]
    resolution_V: float


class Amplifier:
    """A node on the bus, and the probe behind it.

    It samples 10 000 times a second; objects and PDOs show the newest sample. 6130h is 6100h (V) times 6126h plus
    6127h, less what "zero" in 6125h has found to be zero: the mean of the 8 ms after it was written. 9130h is the same
    with 6132h digits after the point. Values are in nN at first. With no probe the input floats near its zero: the
    values look well, the status (6150h) and an emergency do not.

    Attributes:
        node: what is attached to a bus.
        log: "tare", "sensor off", "sensor on", "restart", as (t_ns, text).

    Args:
        voltage_at: the probe's output, V; asked in the order of time.
        seed: of all delays, and of the floating input.
    """

    def __init__(
        self,
        voltage_at: Callable[[int], float],
        spec: InputSpec,
        *,
        node_id: int,
        seed: int,
        name: str = "Emulated measuring amplifier",
        device_type: int = AMPLIFIER,
        temper: Temper | None = None,
    ) -> None:
        self.log: list[tuple[int, str]] = []
        self._voltage_at = voltage_at
        self._spec = spec
        self._random = random.Random(seed)
        self._phase_ns = self._random.randrange(_SAMPLE_NS)
        self._connected = True
        self._sampled_ns = -1
        self._volts = spec.zero_V
        self._status = VALID
        self._zero = 0.0
        self._zeroing: list[float] = []
        self._zeroing_ns: int | None = None
        self._entries = self._make_entries()
        self.node = CanOpenNode(
            node_id,
            Identity(device_type, _PRODUCT_CODE, _SERIAL_NUMBERS + node_id, name),
            (entry for channel in self._entries.values() for entry in channel),
            self,
            transmit=_TRANSMIT,
            receive=(),
            seed=seed + 1,
            temper=temper,
            changes_are_events=False,
        )

    def _make_entries(self) -> dict[int, tuple[Entry, Entry]]:
        """By index: sub-index 0, the number of channels, and sub-index 1."""
        factor = self._spec.sensitivity_uN_per_V * 1000.0
        channels = [
            Entry(0x6100, 1, REAL32, "ro", mapping="tpdo", read=lambda t_ns: self._sample(t_ns)[0]),
            Entry(0x6110, 1, U16, "rw", _STRAIN_LINK, allowed=(_STRAIN_LINK,)),
            Entry(0x6112, 1, U8, "rw", _NORMAL_OPERATION, allowed=(0, _NORMAL_OPERATION)),
            Entry(0x6114, 1, U32, "ro", _SAMPLES_HZ),
            Entry(0x6125, 1, U32, "wo", write=self._zero_written),
            Entry(0x6126, 1, REAL32, "rw", factor, low=-_LARGEST_FACTOR, high=_LARGEST_FACTOR),
            Entry(0x6127, 1, REAL32, "rw", -self._spec.zero_V * factor, low=-_LARGEST_FACTOR, high=_LARGEST_FACTOR),
            Entry(0x6130, 1, REAL32, "ro", mapping="tpdo", read=self.process_value_at),
            Entry(0x6131, 1, U32, "rw", NANONEWTON, allowed=(NANONEWTON, MICRONEWTON, MILLINEWTON, NEWTON)),
            Entry(0x6132, 1, U8, "rw", 0, high=_MOST_DIGITS),
            Entry(0x6150, 1, U8, "ro", mapping="tpdo", read=lambda t_ns: self._sample(t_ns)[1]),
            Entry(0x9130, 1, I32, "ro", mapping="tpdo", read=self._integer_at),
        ]
        return {entry.index: (Entry(entry.index, 0, U8, "const", 1), entry) for entry in channels}

    # ------------------------------------------------------------------ from outside

    def power_cycle(self, t_ns: int) -> None:
        """Off and on again: the zero that was found is forgotten."""
        self.node.power_cycle(t_ns)

    def disconnect_sensor(self, t_ns: int) -> None:
        """The probe's cable is pulled."""
        with self.node.disturbing(t_ns) as now_ns:
            self._connected, self._sampled_ns = False, -1
            self.node.emergencies.happen(SENSOR_FAULT, now_ns)
            self.log.append((now_ns, "sensor off"))

    def connect_sensor(self, t_ns: int) -> None:
        """It is put back."""
        with self.node.disturbing(t_ns) as now_ns:
            self._connected, self._sampled_ns = True, -1
            self.node.emergencies.pass_by(now_ns, SENSOR_FAULT)
            self.log.append((now_ns, "sensor on"))

    def inject_fault(self, t_ns: int, code: int, *, info: bytes = b"") -> None:
        """Let the device tell of an error; its values stay as they are."""
        with self.node.disturbing(t_ns) as now_ns:
            self.node.emergencies.happen(code, now_ns, info=info)

    # ------------------------------------------------------------------ what the node asks (Application)

    def next_event_ns(self) -> int | None:
        """See `Application`."""
        return self._zeroing_ns

    def advance(self, t_ns: int) -> None:
        """See `Application`."""
        while self._zeroing_ns is not None and self._zeroing_ns <= t_ns:
            self._zeroing.append(self._untared_at(self._zeroing_ns))
            self._zeroing_ns += NS_PER_MS
            if len(self._zeroing) == _AUTOZERO_SAMPLES:
                self._zero = sum(self._zeroing) / _AUTOZERO_SAMPLES
                self.log.append((t_ns, "tare"))
                self._zeroing_ns = None

    def restart(self, t_ns: int) -> None:
        """See `Application`."""
        self._zero, self._zeroing_ns = 0.0, None
        self.log.append((t_ns, "restart"))
        if not self._connected:
            self.node.emergencies.happen(SENSOR_FAULT, t_ns)

    def communication_lost(self, loss: Loss, t_ns: int) -> None:
        """See `Application`: an amplifier has nothing to stop."""

    def communication_back(self, t_ns: int) -> None:
        """See `Application`."""
        self.node.emergencies.pass_by(t_ns, HEARTBEAT_LOST)

    # ------------------------------------------------------------------ measuring

    def process_value_at(self, t_ns: int) -> float:
        """6130h, in the unit of 6131h."""
        return self._untared_at(t_ns) - self._zero

    def _untared_at(self, t_ns: int) -> float:
        volts, _ = self._sample(t_ns)
        return volts * float(self._value(0x6126)) + float(self._value(0x6127))

    def _integer_at(self, t_ns: int) -> int:
        scaled = self.process_value_at(t_ns) * 10.0 ** int(self._value(0x6132))
        return round(min(max(scaled, -_INT32), _INT32))

    def _sample(self, t_ns: int) -> tuple[float, int]:
        """Voltage and status of the newest sample at `t_ns`."""
        sampled_ns = t_ns - (t_ns - self._phase_ns) % _SAMPLE_NS
        if sampled_ns > self._sampled_ns:
            self._sampled_ns = sampled_ns
            self._convert(sampled_ns)
        return self._volts, self._status

    def _convert(self, t_ns: int) -> None:
        if self._value(0x6112) != _NORMAL_OPERATION:
            self._status = NOT_VALID
            return
        if not self._connected:
            self._volts = self._spec.zero_V + self._random.gauss(0.0, _FLOATING_V)
            self._status = NOT_VALID
            return
        volts, (low, high) = self._voltage_at(t_ns), self._spec.input_V
        self._status = OVERFLOW if volts >= high else UNDERFLOW if volts <= low else VALID
        step = self._spec.resolution_V
        self._volts = step * round(min(max(volts, low), high) / step)

    def _value(self, index: int) -> Value:
        return self._entries[index][1].value

    def _zero_written(self, value: Value, t_ns: int) -> None:
        if value != _AUTOZERO:
            raise SdoAbort(AbortCode.VALUE_RANGE)
        if self._sample(t_ns)[1] != VALID:
            raise SdoAbort(AbortCode.PRESENT_STATE)
        self._zeroing, self._zeroing_ns = [], t_ns + NS_PER_MS
