"""Rig-file settings of a force sensor on a Modbus analogue-input module."""

from __future__ import annotations

from typing import Literal

import pydantic

from microdrivers.backends.modbus.settings import ModbusConnection
from microdrivers.backends.modbus_analogue.models import CHANNELS, MODELS, ModelName, ModuleModel
from microdrivers.core.units import Range
from microdrivers.devices.force_sensor_settings import ForceSensorSettings

_BYTES_OF_AN_EXCHANGE = 8 + 7
_LEAST_SILENCE_S = 0.00175
_SILENT_CHARACTERS = 3.5
_FASTEST_NETWORK_HZ = 1000.0


class ModbusForceSettings(ForceSensorSettings):
    """A force sensor whose voltage an analogue-input module reads.

    `range_V` is the range to which the module's channel is set; opening compares it with the module's and writes
    nothing. `zero_V` is the reading without force, `sensitivity_uN_per_V` is printed on the sensor's certificate.
    `conversion_ms` is how long the module takes to renew the channel's value; null takes what is assumed of the model.
    """

    driver: Literal["modbus-force"] = "modbus-force"
    connection: ModbusConnection
    unit_id: int = pydantic.Field(default=1, ge=1, le=255)
    model: ModelName
    channel: int = pydantic.Field(ge=1, le=CHANNELS)
    range_V: Range
    zero_V: float
    sensitivity_uN_per_V: float = pydantic.Field(gt=0)
    conversion_ms: float | None = pydantic.Field(default=None, gt=0, le=10_000)
    rate_hz: float = pydantic.Field(default=30.0, gt=0)

    @pydantic.model_validator(mode="after")
    def _a_range_of_the_module(self) -> ModbusForceSettings:
        ranges = self.module.ranges_V.values()
        if self.range_V not in ranges:
            known = ", ".join(f"[{one.min:g}, {one.max:g}]" for one in ranges)
            raise ValueError(f"range_V {_written(self.range_V)} is none of {self.model}, which has {known}")
        return self

    @pydantic.model_validator(mode="after")
    def _forces_within_the_voltages(self) -> ModbusForceSettings:
        low_uN, high_uN = self.force_uN(self.range_V.min), self.force_uN(self.range_V.max)
        if self.range_uN.min < low_uN or self.range_uN.max > high_uN:
            raise ValueError(
                f"the module's {_written(self.range_V)} V show {low_uN:g} to {high_uN:g} µN, which does not cover "
                f"range_uN {_written(self.range_uN)}; check units and signs of zero_V ({self.zero_V:g} V), "
                f"sensitivity_uN_per_V ({self.sensitivity_uN_per_V:g} µN/V) and range_uN"
            )
        step_uN = self.module.step_V(self.range_V) * self.sensitivity_uN_per_V
        if self.resolution_uN < step_uN / 2:
            raise ValueError(
                f"resolution_uN {self.resolution_uN:g} is finer than a step of the module's {self.module.bits}-bit "
                f"converter, {step_uN:.3g} µN; check the sensitivity's unit, or state what the module can show"
            )
        return self

    @pydantic.model_validator(mode="after")
    def _time_for_the_exchanges(self) -> ModbusForceSettings:
        most_hz = self.fastest_rate_hz
        if self.rate_hz > most_hz:
            where = f"{self.connection.baudrate} baud" if self.connection.framing == "rtu" else "Modbus TCP"
            raise ValueError(
                f"rate_hz {self.rate_hz:g} is more than {where} can carry, {most_hz:.0f} readings a second"
            )
        return self

    @property
    def module(self) -> ModuleModel:
        """What is known of the model."""
        return MODELS[self.model]

    @property
    def silence_s(self) -> float:
        """Between two frames on the line ("MODBUS over Serial Line V1.02", section 2.5.1.1)."""
        connection = self.connection
        return max(_SILENT_CHARACTERS * connection.bits_per_byte / connection.baudrate, _LEAST_SILENCE_S)

    @property
    def fastest_rate_hz(self) -> float:
        """What the line can carry, if the module answers at once."""
        connection = self.connection
        if connection.framing == "tcp":
            return _FASTEST_NETWORK_HZ
        return 1.0 / (_BYTES_OF_AN_EXCHANGE * connection.bits_per_byte / connection.baudrate + 2 * self.silence_s)

    def force_uN(self, volts: float) -> float:
        """The force that a voltage stands for."""
        return (volts - self.zero_V) * self.sensitivity_uN_per_V

    def claims(self) -> tuple[str, ...]:
        """The port."""
        return (f"port {self.connection.port}",)


def _written(both: Range) -> str:
    return f"[{both.min:g}, {both.max:g}]"
