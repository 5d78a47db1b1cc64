"""The force sensor on a channel of an analogue-input module."""

from __future__ import annotations

from collections.abc import Mapping

from microdrivers.backends.lines.serial_line import SerialLine
from microdrivers.backends.modbus.master import ModbusMaster, framing_of
from microdrivers.backends.modbus.rtu import LengthMarks, RtuTiming
from microdrivers.backends.modbus_analogue.models import CHANNELS
from microdrivers.backends.modbus_analogue.module import AnalogueModule, Reading
from microdrivers.backends.modbus_analogue.settings import ModbusForceSettings
from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.core.samples import ForceSample
from microdrivers.core.units import seconds_to_ns
from microdrivers.devices.base import DeviceInfo
from microdrivers.devices.force_sensor import DISCONNECTED, SATURATED, ForceSensor
from microdrivers.devices.wire_tap import WireTap

_ABSENT_AFTER_NS = seconds_to_ns(0.5)
_MARGIN_S = 0.00025
_REMEDY = {
    "rtu": "compare unit_id, baudrate and parity with the module's settings (factory: unit 1, 9600 baud, 8N1), and "
    "check its power and the wires A and B; an ADAM leaves the factory speaking ASCII: set it to Modbus first",
    "tcp": "compare unit_id with the module's, and check the gateway's serial side, the wires A and B, and the power",
}


class ModbusForceSensor(ForceSensor):
    """A force sensor with a voltage output on a Modbus analogue-input module.

    A sample costs one exchange of one register: 5 ms at 115200 baud. The module converts at its own rate; when
    exactly, it does not tell: `dt_ns` includes half of its conversion period. SATURATED: the converter is at the end of
    its range, or the force beyond the sensor's. DISCONNECTED: less than the live zero of a 1–5 V range; or 0 V for
    half a second from a sensor that can give no 0 V.
    """

    def __init__(self, name: str, settings: ModbusForceSettings, *, clock: Clock, bus: Bus) -> None:
        super().__init__(name, clock=clock, bus=bus)
        self._adopt(settings)
        self._settings = settings
        connection = settings.connection
        timing = RtuTiming(silent_s=0.0, gap_s=settings.silence_s + _MARGIN_S)
        # These modules need not know function 08h; a channel is read alone, so longer reads are marks.
        framing = framing_of(connection, timing, LengthMarks(0, range(2, CHANNELS + 1)))
        self._line = SerialLine(connection, clock=clock, gap_s=framing.gap_s, tap=WireTap(name, bus))
        remedy = _REMEDY[connection.framing]
        modbus = ModbusMaster(self._line, framing, unit_id=settings.unit_id, silence_remedy=remedy)
        self._module = AnalogueModule(modbus, settings, name=name)
        self._no_voltage_since_ns: int | None = None

    @property
    def line_counters(self) -> Mapping[str, int]:
        """What has happened on the line since it was opened."""
        return vars(self._line.counters)

    def _connect(self) -> None:
        self._line.open()
        self._no_voltage_since_ns = None

    def _identify(self) -> DeviceInfo:
        return self._module.identify()

    def _close(self) -> None:
        self._line.close()

    def _read(self) -> ForceSample:
        with self.clock.transaction():
            reading = self._module.read()
            volts = self._settings.module.volts(reading.register, self._settings.range_V)
            return self._sample(
                self._settings.force_uN(volts),
                t_ns=reading.t_ns,
                dt_ns=reading.dt_ns,
                t_source="midpoint",
                flags=self._flags(reading, volts),
            )

    def _flags(self, reading: Reading, volts: float) -> frozenset[str]:
        module, range_V = self._settings.module, self._settings.range_V
        if volts < range_V.min or self._gives_no_voltage(reading, volts):
            return frozenset({DISCONNECTED})
        return frozenset({SATURATED}) if module.at_the_end(reading.register, range_V) else frozenset()

    def _gives_no_voltage(self, reading: Reading, volts: float) -> bool:
        """Whether there has been 0 V for so long, where the sensor itself can give no 0 V, that there is none."""
        settings = self._settings
        impossible = settings.force_uN(0.0) not in self.range_uN
        if not impossible or abs(volts) > settings.module.step_V(settings.range_V):
            self._no_voltage_since_ns = None
            return False
        if self._no_voltage_since_ns is None:
            self._no_voltage_since_ns = reading.t_ns
        return reading.t_ns - self._no_voltage_since_ns >= _ABSENT_AFTER_NS
