"""An analogue-input module on Modbus: is it the one that the rig file means, and what does its channel show?

Nothing is ever written to it.
"""

from __future__ import annotations

from typing import NamedTuple

from microdrivers.backends.modbus.master import ModbusMaster, ModbusRefusal
from microdrivers.backends.modbus_analogue.models import ASSUMED_CONVERSION_S
from microdrivers.backends.modbus_analogue.settings import ModbusForceSettings
from microdrivers.core.errors import ConfigError, ProtocolError, UnsupportedError
from microdrivers.core.units import seconds_to_ns
from microdrivers.devices.base import DeviceInfo

_WAVESHARE_RANGES = 0x1000
_WAVESHARE_ADDRESS = 0x4000
_ADAM_RANGES = 200
_ADAM_NAME = 210
_ADAM_MASK = 220
_ADAM_NAMES = {0x4117: "adam-4117", 0x4017: "adam-4017+"}
_ANOTHER = "check connection, unit_id and model in the rig file"


class Reading(NamedTuple):
    """A channel's register, and the interval in which the module converted it: `t_ns` ± `dt_ns`."""

    register: int
    t_ns: int
    dt_ns: int


class AnalogueModule:
    """One channel of a module.

    Attributes:
        conversion_ns: how long the module takes to renew the channel's value.
    """

    def __init__(self, modbus: ModbusMaster, settings: ModbusForceSettings, *, name: str) -> None:
        self._modbus = modbus
        self._settings = settings
        self._name = name
        self._input = settings.channel - 1
        self.conversion_ns = self._conversion_ns(channels=1)

    def identify(self) -> DeviceInfo:
        """Compare what the module tells of itself with the rig file.

        Raises:
            UnsupportedError: another module, or none, answers. ConfigError: the channel is set up otherwise.
            LinkError: no sound answer.
        """
        try:
            info = self._identify_adam() if self._settings.module.family == "adam" else self._identify_waveshare()
            self._modbus.read_input(self._input, 1)
        except ModbusRefusal as refusal:
            raise UnsupportedError(f"this is no {self._settings.model}: {refusal.what}", remedy=_ANOTHER) from refusal
        return info

    def read(self) -> Reading:
        """The channel's newest value. It was converted up to `conversion_ns` before the module was asked.

        Raises:
            LinkError: no sound answer, or a refusal.
        """
        try:
            registers = self._modbus.read_input(self._input, 1)
        except ModbusRefusal as refusal:
            raise ProtocolError(refusal.what, remedy=refusal.remedy, moved="no") from refusal
        half_ns = -(-self.conversion_ns // 2)
        return Reading(registers.values[0], registers.t_ns - half_ns, registers.dt_ns + half_ns)

    # ------------------------------------------------------------------ inside

    def _identify_waveshare(self) -> DeviceInfo:
        address = self._holding(_WAVESHARE_ADDRESS)
        if self._settings.connection.framing == "rtu" and address != self._settings.unit_id:
            raise UnsupportedError(
                f"this is no {self._settings.model}: where that has its address, {self._settings.unit_id}, there is "
                f"{address} (register {_WAVESHARE_ADDRESS:04X}h)",
                remedy=_ANOTHER,
            )
        register = _WAVESHARE_RANGES + self._input
        self._check_range(self._holding(register), register)
        return self._info()

    def _identify_adam(self) -> DeviceInfo:
        name, name_end, version, version_end = self._modbus.read(_ADAM_NAME, 4).values
        if _ADAM_NAMES.get(name) != self._settings.model:
            raise UnsupportedError(
                f"this is no {self._settings.model}: it calls itself {name:04X}h {name_end:04X}h (register 40211)",
                remedy=f"write model: {_ADAM_NAMES[name]}" if name in _ADAM_NAMES else _ANOTHER,
            )
        register = _ADAM_RANGES + self._input
        self._check_range(self._holding(register), register)
        mask = self._holding(_ADAM_MASK)
        if not mask >> self._input & 1:
            raise self._misfit(
                "channel",
                f"the module does not convert channel {self._settings.channel}: its mask is {mask:02X}h "
                "(register 40221)",
                "enable the channel with the maker's utility",
            )
        self.conversion_ns = self._conversion_ns(channels=mask.bit_count())
        return self._info(firmware=f"{version:04X}{version_end:04X}")

    def _check_range(self, code: int, register: int) -> None:
        settings = self._settings
        found = settings.module.ranges_V.get(code)
        if found == settings.range_V:
            return
        wanted = next(key for key, range_V in settings.module.ranges_V.items() if range_V == settings.range_V)
        shown = f"{found.min:g} to {found.max:g} V" if found else "no voltage range that a force can be read with"
        either = f"write range_V: [{found.min:g}, {found.max:g}] into the rig file, or " if found else ""
        raise self._misfit(
            "range_V",
            f"channel {settings.channel} of the module is set to {shown} (code {code:02X}h in register "
            f"{register:04X}h), the rig file has {settings.range_V.min:g} to {settings.range_V.max:g} V",
            f"{either}set the channel to code {wanted:02X}h with the maker's utility",
        )

    def _conversion_ns(self, *, channels: int) -> int:
        if self._settings.conversion_ms is not None:
            return seconds_to_ns(self._settings.conversion_ms / 1000.0)
        return seconds_to_ns(channels * ASSUMED_CONVERSION_S[self._settings.module.family])

    def _holding(self, register: int) -> int:
        return self._modbus.read(register, 1).values[0]

    def _misfit(self, key: str, what: str, remedy: str) -> ConfigError:
        return ConfigError(what, key=f"{self._name}.{key}", remedy=remedy)

    def _info(self, *, firmware: str = "") -> DeviceInfo:
        return DeviceInfo(
            driver="modbus-force", vendor=self._settings.module.vendor, model=self._settings.model, firmware=firmware
        )
